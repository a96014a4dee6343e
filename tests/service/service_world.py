"""A small world for the service's tests: images, IMU, requests, a detector that answers by rule, a live server."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import httpx
import numpy as np
import uvicorn
from fastapi import FastAPI

from viflow_anomaly_service.app import create_app
from viflow_anomaly_service.server import GracefulServer
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.socket_guard import socket_options

T0 = 1_403_715_273_262_142_976
INTERVAL_NS = 50_000_000
IMU_STEP_NS = 5_000_000


def gray_image(*, seed: int = 0, width: int = 96, height: int = 64) -> np.ndarray:
    """[H, W] uint8: smooth noise, and a bright square whose place the seed decides."""
    rng = np.random.default_rng(seed)
    noise = rng.integers(0, 256, (height, width), dtype=np.uint8)
    image = np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.0))
    x, y = int(rng.integers(0, width - 20)), int(rng.integers(0, height - 20))
    image[y : y + 18, x : x + 18] = 250
    return image


def png(image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".png", image)[1])


def jpeg(image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".jpg", image)[1])


def imu_part(*, stamped: bool = False) -> dict[str, Any]:
    stamps = list(range(T0 - 100_000_000, T0 + INTERVAL_NS + 100_000_000, IMU_STEP_NS))
    imu: dict[str, Any] = {
        "timestamps_ns": stamps,
        "gyro_rad_s": [[0.01, -0.02, 0.1]] * len(stamps),
        "accel_m_s2": [[0.1, 0.2, 9.8]] * len(stamps),
    }
    if stamped:
        imu |= {"source_timestamp_ns": T0, "target_timestamp_ns": T0 + INTERVAL_NS}
    return imu


def camera_part(*, width: int = 96, height: int = 64) -> dict[str, Any]:
    return {"fx": 70.0, "fy": 70, "cx": 47.5, "cy": 31.5, "width": width, "height": height}


def base64_text(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def json_request(*, seed: int = 0, **changes: Any) -> dict[str, Any]:
    """A good request; ``changes`` replace or add members."""
    request = {
        "source": {"timestamp_ns": T0, "image_base64": base64_text(png(gray_image(seed=seed)))},
        "target": {"timestamp_ns": T0 + INTERVAL_NS, "image_base64": base64_text(png(gray_image(seed=seed + 1)))},
        "imu": imu_part(),
    }
    return request | changes


Part = tuple[str | None, bytes | str, str] | tuple[str | None, bytes | str]


def form_request(*, seed: int = 0, **changes: Part | None) -> dict[str, Part]:
    """The parts of a good request; ``changes`` replace or add parts, or remove those that are None."""
    parts: dict[str, Part | None] = {
        "source": ("source.png", png(gray_image(seed=seed)), "image/png"),
        "target": ("target.png", png(gray_image(seed=seed + 1)), "image/png"),
        "imu": ("imu.json", json.dumps(imu_part(stamped=True)), "application/json"),
        **changes,
    }
    return {name: part for name, part in parts.items() if part is not None}


@dataclass
class LiveServer:
    """The application behind real sockets, in a thread of this process."""

    app: FastAPI
    port: int
    client: httpx.Client
    loop: asyncio.AbstractEventLoop

    def post_json(self, request: Any, **options: Any) -> httpx.Response:
        """NaN and Infinity are written as Python's json does."""
        headers = {"Content-Type": "application/json"} | options.pop("headers", {})
        return self.client.post("/detect", content=json.dumps(request), headers=headers, **options)

    def post_bytes(self, content: bytes, content_type: str = "application/json") -> httpx.Response:
        return self.client.post("/detect", content=content, headers={"Content-Type": content_type})

    def post_form(self, parts: dict[str, Part]) -> httpx.Response:
        return self.client.post("/detect", files=parts)


def wait_until(condition: Callable[[], bool], *, seconds: float = 10.0) -> None:
    """Poll, or fail the test."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "the condition did not come true in time"
        time.sleep(0.005)


@contextlib.contextmanager
def live_server(
    load_detector: Callable[[ServiceSettings], Any], *, ready: bool = True, **settings: Any
) -> Iterator[LiveServer]:
    """Serve on a free port of the loopback interface until the block ends.

    Args:
        load_detector: as for ``create_app``.
        ready: wait until the detector is there.
        settings: of the service.
    """
    app = create_app(ServiceSettings(**{"max_concurrent": 2, "warm_up": ()} | settings), load_detector=load_detector)
    sockets = socket_options(app.state.core.settings)
    config = uvicorn.Config(app, port=0, http="h11", lifespan="on", log_config=None, access_log=False, **sockets)
    server = GracefulServer(config, gate=app.state.core.gate, patience_s=10.0)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        wait_until(lambda: server.started)
        port = server.servers[0].sockets[0].getsockname()[1]
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=30, trust_env=False) as client:
            if ready:
                wait_until(lambda: client.get("/readyz").status_code == 200)
            yield LiveServer(app=app, port=port, client=client, loop=server.servers[0].get_loop())
    finally:
        server.should_exit = True
        thread.join(timeout=20)
    assert not thread.is_alive(), "the server did not end"


def problem_of(response: httpx.Response) -> dict[str, Any]:
    """The problem, after checking what every one of them must be."""
    assert response.headers["content-type"] == "application/problem+json"
    body: dict[str, Any] = response.json()
    assert body["status"] == response.status_code
    assert body["request_id"] == response.headers["x-request-id"]
    assert "Traceback" not in response.text
    assert ".py" not in response.text
    return body


def assert_problem(response: httpx.Response, status: int, code: str, place: str | None) -> None:
    body = problem_of(response)
    assert (body["status"], body["code"], body.get("field")) == (status, code, place), body
