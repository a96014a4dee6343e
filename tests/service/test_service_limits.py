"""Bytes, pixels, samples and time: each limit holds, is exact where it can be, and is checked before the work."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator

import numpy as np
import pytest
from rule_detector import RuleDetector
from service_world import (
    LiveServer,
    assert_problem,
    form_request,
    gray_image,
    imu_part,
    json_request,
    live_server,
    png,
)

MAX_BODY = 40_000
MAX_IMAGE = 10_000


@pytest.fixture(scope="module")
def server() -> Iterator[LiveServer]:
    with live_server(
        lambda settings: RuleDetector(),
        max_body_bytes=MAX_BODY,
        max_image_bytes=MAX_IMAGE,
        max_image_pixels=96 * 64,
        max_imu_samples=50,
        body_timeout_s=0.5,
    ) as running:
        yield running


def raw_answer(port: int, request: bytes) -> bytes:
    """Everything the server sends back until it closes the connection."""
    received = b""
    with socket.create_connection(("127.0.0.1", port), timeout=3) as connection:
        connection.sendall(request)
        while chunk := connection.recv(65536):
            received += chunk
    return received


def padded(size: int) -> bytes:
    text = json.dumps(json_request()).encode()
    return text + b" " * (size - len(text))


def test_body_of_exactly_the_limit(server: LiveServer) -> None:
    assert server.post_bytes(padded(MAX_BODY)).status_code == 200


def test_announced_body_over_the_limit(server: LiveServer) -> None:
    assert_problem(server.post_bytes(padded(MAX_BODY + 1)), 413, "body_too_large", None)


def test_chunked_body_over_the_limit(server: LiveServer) -> None:
    def chunks() -> Iterator[bytes]:
        for _ in range(200):
            yield b" " * 8192

    response = server.client.post("/detect", content=chunks(), headers={"Content-Type": "application/json"})
    assert "content-length" not in response.request.headers
    assert_problem(response, 413, "body_too_large", None)
    assert server.post_json(json_request()).status_code == 200


def test_a_client_that_asks_first_is_refused_at_once(server: LiveServer) -> None:
    started = time.monotonic()
    head = (
        b"POST /detect HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        b"Content-Length: %d\r\nExpect: 100-continue\r\n\r\n" % 10**12
    )
    assert raw_answer(server.port, head).startswith(b"HTTP/1.1 413")
    assert time.monotonic() - started < 1.5


def test_slow_upload(server: LiveServer) -> None:
    head = b"POST /detect HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 100\r\n\r\n{"
    answer = raw_answer(server.port, head)
    assert answer.startswith(b"HTTP/1.1 408")
    assert b'"code": "body_timeout"' in answer


def test_an_upload_that_stalls_over_the_limit_is_answered_all_the_same(server: LiveServer) -> None:
    head = b"POST /detect HTTP/1.1\r\nHost: localhost\r\nContent-Type: text/plain\r\nContent-Length: 90000\r\n\r\n{"
    assert raw_answer(server.port, head).startswith(b"HTTP/1.1 415")


def test_image_bytes(server: LiveServer) -> None:
    noise = png(np.random.default_rng(0).integers(0, 256, (100, 120), dtype=np.uint8))
    assert len(noise) > MAX_IMAGE
    response = server.post_form(form_request(source=("s", noise, "image/png")))
    assert_problem(response, 413, "image_too_many_bytes", "source")


def test_image_pixels(server: LiveServer) -> None:
    large = png(np.zeros((64, 97), np.uint8))
    response = server.post_form(form_request(target=("t", large, "image/png")))
    assert_problem(response, 413, "image_too_many_pixels", "target")
    assert server.post_form(form_request(target=("t", png(gray_image()), "image/png"))).status_code == 200


def test_imu_samples(server: LiveServer) -> None:
    imu = imu_part()
    first_51 = {name: (rows * 2)[:51] for name, rows in imu.items()}
    assert_problem(server.post_json(json_request(imu=first_51)), 413, "imu_too_many_samples", "imu.timestamps_ns")
    first_50 = {name: rows[:50] for name, rows in imu.items()}
    assert len(first_50["timestamps_ns"]) == 50
    assert server.post_json(json_request(imu=first_50)).status_code == 200


def test_json_values(server: LiveServer) -> None:
    imu = (None, "[" * 5000)
    assert_problem(server.post_form(form_request(imu=imu)), 413, "json_too_many_values", "imu")
