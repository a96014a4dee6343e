"""The service as a process of its own, with a detector that answers by rule as slowly as a test wants."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
from service_world import wait_until

SERVE_BY_RULE = """
import sys, time
sys.path.insert(0, {tests!r})
from rule_detector import RuleDetector
from viflow_anomaly_service.server import run
from viflow_anomaly_service.settings import load_settings

{setup}

class SlowDetector(RuleDetector):
    def detect(self, pair, *, decode_ms=0.0):
        time.sleep({delay_s})
        return super().detect(pair, decode_ms=decode_ms)

def load(settings):
    {before_load}
    return SlowDetector()

if __name__ == "__main__":
    run(load_settings(port=0, **{settings!r}), load_detector=load)
"""


@dataclass
class ServingProcess:
    """A started service and what it has logged so far; ``port`` is 0 until it says where it listens."""

    process: subprocess.Popen[str]
    port: int = 0
    log: list[dict[str, Any]] = field(default_factory=list)
    other_lines: list[str] = field(default_factory=list)

    def read_log(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            try:
                record = json.loads(line)
            except ValueError:
                self.other_lines.append(line)
                continue
            if record["event"] == "listening":
                self.port = record["port"]
            self.log.append(record)

    def events(self, event: str) -> list[dict[str, Any]]:
        return [record for record in self.log if record["event"] == event]

    def statuses(self) -> list[int]:
        """Of the requests to /detect, as they were logged."""
        return [record["status"] for record in self.events("request") if record["path"] == "/detect"]

    def client(self) -> httpx.Client:
        return httpx.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=30, trust_env=False)


@contextlib.contextmanager
def serving_process(
    *, delay_s: float = 0.0, before_load: str = "pass", setup: str = "pass", ready: bool = True, **settings: Any
) -> Iterator[ServingProcess]:
    """Start it, wait until it is ready (each of its processes), and make sure that it has ended afterwards.

    Args:
        delay_s: what every pair takes.
        before_load: a statement that every process executes before it has its detector.
        setup: statements that every process executes first of all; may give ``RuleDetector`` another meaning.
        ready: False: wait only until it listens.
        settings: of the service.
    """
    code = SERVE_BY_RULE.format(
        tests=str(Path(__file__).parent),
        delay_s=delay_s,
        before_load=before_load,
        setup=setup,
        settings={"warm_up": ""} | settings,
    )
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True, env=os.environ)
    serving = ServingProcess(process)
    reader = threading.Thread(target=serving.read_log)
    reader.start()
    try:
        wait_until(lambda: serving.port > 0 or process.poll() is not None, seconds=30)
        if ready:
            wait_until(lambda: len(serving.events("model_loaded")) == settings.get("workers", 1), seconds=30)
        yield serving
    finally:
        process.kill()
        process.wait()
        reader.join(timeout=20)
        assert not reader.is_alive(), "a process outlived the service"
        assert process.stderr is not None
        process.stderr.close()
