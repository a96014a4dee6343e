"""The server as a process: it starts, says where, ends well on a signal, and says why when it cannot start."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
from service_world import json_request, wait_until

from viflow_anomaly.errors import CheckpointError, ConfigError
from viflow_anomaly_service import server as service_server
from viflow_anomaly_service.__main__ import main
from viflow_anomaly_service.settings import ServiceSettings

SERVE_BY_RULE = """
import sys, threading
sys.path.insert(0, {tests!r})
from rule_detector import RuleDetector
from viflow_anomaly_service.server import run
from viflow_anomaly_service.settings import load_settings

class SlowDetector(RuleDetector):
    def detect(self, pair, *, decode_ms=0.0):
        threading.Event().wait({delay_s})
        return super().detect(pair, decode_ms=decode_ms)

run(load_settings(port=0, shutdown_timeout_s=10), load_detector=lambda settings: SlowDetector())
"""


@contextlib.contextmanager
def serving_process(*, delay_s: float = 0.0) -> Iterator[tuple[subprocess.Popen[str], httpx.Client]]:
    code = SERVE_BY_RULE.format(tests=str(Path(__file__).parent), delay_s=delay_s)
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        listening: dict[str, Any] = {}
        while listening.get("event") != "listening":
            listening = json.loads(process.stderr.readline())
        with httpx.Client(base_url=f"http://127.0.0.1:{listening['port']}", timeout=20, trust_env=False) as client:
            wait_until(lambda: client.get("/readyz").status_code == 200, seconds=20)
            yield process, client
    finally:
        process.kill()
        process.wait()
        if process.stderr is not None:
            process.stderr.close()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_lets_running_requests_finish(number: signal.Signals) -> None:
    with serving_process(delay_s=0.7) as (process, client), ThreadPoolExecutor(max_workers=1) as clients:
        running = clients.submit(client.post, "/detect", json=json_request())
        time.sleep(0.3)
        process.send_signal(number)
        assert running.result().status_code == 200
        status = process.wait(timeout=10)
        assert status == (0 if number == signal.SIGINT else -signal.SIGTERM)
        assert process.stderr is not None
        lines = [json.loads(line) for line in process.stderr.read().splitlines()]
        assert [line["status"] for line in lines if line.get("path") == "/detect"] == [200]
        assert not [line for line in lines if line["level"] == "error"]


def run_module(**environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "viflow_anomaly_service"],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_wrong_settings_end_the_process_with_status_2() -> None:
    ended = run_module(VIFLOW_PORT="ninety")
    assert ended.returncode == 2
    assert "port" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_a_misspelt_variable_ends_the_process_with_status_2() -> None:
    ended = run_module(VIFLOW_PROT="8000")
    assert ended.returncode == 2
    assert "found VIFLOW_PROT; the closest known one is VIFLOW_PORT" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_a_port_in_use_ends_the_process_with_status_2() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        ended = run_module(VIFLOW_PORT=str(port))
    assert ended.returncode == 2
    assert f"127.0.0.1:{port}" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.fixture
def untouched_logging(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    root = logging.getLogger()
    level = root.level
    monkeypatch.setattr(root, "handlers", list(root.handlers))
    yield
    root.setLevel(level)


def test_run_ends_with_the_error_of_a_model_that_cannot_be_loaded(
    untouched_logging: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)

    def load(settings: ServiceSettings) -> Any:
        raise CheckpointError("model.safetensors: expected a checkpoint", code="checkpoint_truncated")

    with pytest.raises(CheckpointError, match=r"model\.safetensors"):
        service_server.run(ServiceSettings(port=0), load_detector=load)
    assert os.environ["OMP_WAIT_POLICY"] == "PASSIVE"


def test_bind_both_families_and_refuses_what_is_not_ours() -> None:
    with service_server.bind("127.0.0.1", 0) as listener:
        assert listener.family == socket.AF_INET
        with pytest.raises(ConfigError) as caught:
            service_server.bind(*listener.getsockname())
        assert (caught.value.code, caught.value.field) == ("address_unavailable", "port")
    for host in ("203.0.113.7", "no such host", "::ffff:203.0.113.7"):
        with pytest.raises(ConfigError, match="found"):
            service_server.bind(host, 0)


def test_importing_the_service_loads_no_torch() -> None:
    code = "import sys, viflow_anomaly_service.server; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0


def test_main_turns_errors_into_a_status(
    untouched_logging: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("VIFLOW_PORT", "-5")
    assert main() == 2
    assert capsys.readouterr().err.startswith("error: service settings: port")


def test_main_ends_with_status_0(monkeypatch: pytest.MonkeyPatch) -> None:
    served: list[ServiceSettings] = []
    monkeypatch.setenv("VIFLOW_PORT", "1234")
    monkeypatch.setattr("viflow_anomaly_service.__main__.run", served.append)
    assert main() == 0
    assert [settings.port for settings in served] == [1234]
