"""A small world for who looks on: the bundled recording as calls of a stream, and the service as a real process."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
from service_world import wait_until

SAMPLE = Path(__file__).parents[2] / "service" / "dashboard" / "sample"
START_NS = 1_700_000_000_000_000_000


def sample_calls() -> list[dict[str, Any]]:
    """The parts of each POST /streams/{id}/frames that plays the bundled recording."""
    told = json.loads((SAMPLE / "recording.json").read_text(encoding="utf-8"))
    calls, sent_ns = [], -(10**18)
    for number, frame_ns in enumerate(told["frames_ns"]):
        until_ns = frame_ns + 5_000_000
        rows = [row for row, stamp in enumerate(told["imu"]["timestamps_ns"]) if sent_ns < stamp <= until_ns]
        imu = {name: [values[row] for row in rows] for name, values in told["imu"].items()}
        imu["timestamps_ns"] = [stamp + START_NS for stamp in imu["timestamps_ns"]]
        sent_ns = until_ns
        calls.append(
            {
                "frame": ("frame.jpg", (SAMPLE / f"{number}.jpg").read_bytes(), "image/jpeg"),
                "imu": (None, json.dumps(imu | {"frame_timestamp_ns": frame_ns + START_NS})),
                "request": (None, json.dumps({"camera": told["camera"]})),
            }
        )
    return calls


def sample_pair() -> dict[str, Any]:
    """Two of its frames as the parts of POST /detect and POST /inspect."""
    told = json.loads((SAMPLE / "recording.json").read_text(encoding="utf-8"))
    frames_ns, imu = told["frames_ns"], told["imu"]
    imu["timestamps_ns"] = [stamp + START_NS for stamp in imu["timestamps_ns"]]
    stamps = {"source_timestamp_ns": frames_ns[4] + START_NS, "target_timestamp_ns": frames_ns[5] + START_NS}
    return {
        "source": ("4.jpg", (SAMPLE / "4.jpg").read_bytes(), "image/jpeg"),
        "target": ("5.jpg", (SAMPLE / "5.jpg").read_bytes(), "image/jpeg"),
        "imu": ("imu.json", json.dumps(imu | stamps), "application/json"),
        "request": ("request.json", json.dumps({"camera": told["camera"]}), "application/json"),
    }


def feed(client: httpx.Client, stream_id: str = "drone7", *, calls: int = 10) -> None:
    """Play the recording."""
    for parts in sample_calls()[:calls]:
        answer = client.post(f"/streams/{stream_id}/frames", files=parts)
        assert answer.status_code == 200, answer.text


@dataclass
class RealService:
    """``python -m viflow_anomaly_service`` with the bundled model."""

    process: subprocess.Popen[str]
    port: int
    log: list[dict[str, Any]] = field(default_factory=list)

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def client(self, **headers: str) -> httpx.Client:
        return httpx.Client(base_url=self.address, timeout=60, trust_env=False, headers=headers)

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            with contextlib.suppress(ValueError):
                self.log.append(json.loads(line))

    def ready(self) -> bool:
        return any(record["event"] == "model_loaded" for record in self.log)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


@contextlib.contextmanager
def real_service(*, port: int | None = None, **variables: str) -> Iterator[RealService]:
    """Start it, wait until it is ready, and make sure that it has ended afterwards."""
    port = port or free_port()
    environment = os.environ | {"VIFLOW_PORT": str(port), "VIFLOW_WARM_UP": ""} | variables
    command = [sys.executable, "-m", "viflow_anomaly_service"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
    service = RealService(process, port)
    reader = threading.Thread(target=service._read)
    reader.start()
    try:
        wait_until(lambda: service.ready() or process.poll() is not None, seconds=120)
        assert service.ready(), "the service did not start"
        yield service
    finally:
        process.terminate()
        try:
            process.wait(timeout=40)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        reader.join(timeout=20)
        assert process.stderr is not None
        process.stderr.close()
