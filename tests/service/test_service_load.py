"""Readiness while the model loads, overload, clients that go away, faults of ours."""

from __future__ import annotations

import json
import logging
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from rule_detector import RuleDetector
from service_world import assert_problem, form_request, json_request, live_server, wait_until

from viflow_anomaly.errors import CheckpointError


def test_everything_but_detect_answers_while_the_model_loads() -> None:
    loaded = threading.Event()

    def slow_load(settings: Any) -> RuleDetector:
        loaded.wait(20)
        return RuleDetector()

    with live_server(slow_load, ready=False) as server:
        assert server.client.get("/healthz").status_code == 200
        assert server.client.get("/version").json()["model"] is None
        for response in (server.client.get("/readyz"), server.post_json(json_request())):
            assert_problem(response, 503, "model_loading", None)
            assert int(response.headers["retry-after"]) >= 1
        loaded.set()
        wait_until(lambda: server.client.get("/readyz").status_code == 200)
        assert server.post_json(json_request()).status_code == 200


def test_a_model_that_cannot_be_loaded(caplog: pytest.LogCaptureFixture) -> None:
    def failing_load(settings: Any) -> RuleDetector:
        raise CheckpointError("/secret/place: expected a checkpoint", code="checkpoint_truncated")

    with live_server(failing_load, ready=False) as server:
        wait_until(lambda: server.client.get("/readyz").json()["code"] == "model_load_failed")
        assert server.client.get("/healthz").status_code == 200
        for response in (server.client.get("/readyz"), server.post_form(form_request())):
            assert_problem(response, 503, "model_load_failed", None)
            assert "secret" not in response.text
    assert "model_load_failed" in caplog.messages


def test_overload_is_refused_and_recovers() -> None:
    may_go = threading.Event()
    detector = RuleDetector(may_go=may_go)
    with (
        live_server(lambda settings: detector, max_concurrent=1, max_queued=1) as server,
        ThreadPoolExecutor(max_workers=2) as clients,
    ):
        accepted = [clients.submit(server.post_json, json_request()) for _ in range(2)]
        try:
            wait_until(lambda: server.app.state.gate.present == 2)
            for _ in range(3):
                response = server.post_json(json_request())
                assert_problem(response, 503, "overloaded", None)
                assert response.headers["retry-after"] == "1"
            assert server.client.get("/healthz").status_code == 200
        finally:
            may_go.set()
        assert [answer.result().status_code for answer in accepted] == [200, 200]
        assert server.post_json(json_request()).status_code == 200


def test_a_turn_that_does_not_come() -> None:
    may_go = threading.Event()
    detector = RuleDetector(may_go=may_go)
    with (
        live_server(lambda settings: detector, max_concurrent=1, max_queued=5, queue_timeout_s=0.2) as server,
        ThreadPoolExecutor(max_workers=1) as clients,
    ):
        first = clients.submit(server.post_json, json_request())
        try:
            wait_until(lambda: len(detector.calls) == 1)
            assert_problem(server.post_json(json_request()), 503, "overloaded", None)
        finally:
            may_go.set()
        assert first.result().status_code == 200
        assert server.post_json(json_request()).status_code == 200


def begin_request(port: int, body: bytes, *, announced: int) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", port), timeout=5)
    head = f"POST /detect HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: {announced}\r\n\r\n"
    connection.sendall(head.encode() + body)
    return connection


def logged_statuses(caplog: pytest.LogCaptureFixture, path: str = "/detect") -> list[int]:
    return [vars(record)["status"] for record in caplog.records if vars(record).get("path") == path]


def test_a_client_that_leaves_in_the_middle_of_its_upload(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    with live_server(lambda settings: RuleDetector(), max_concurrent=1, max_queued=0) as server:
        begin_request(server.port, b"{", announced=1000).close()
        wait_until(lambda: logged_statuses(caplog) == [499])
        assert server.app.state.gate.present == 0
        assert server.post_json(json_request()).status_code == 200
    assert "unexpected_error" not in caplog.messages


def test_nothing_is_computed_for_a_client_that_left_the_queue(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    may_go = threading.Event()
    detector = RuleDetector(may_go=may_go)
    with (
        live_server(lambda settings: detector, max_concurrent=1, max_queued=5) as server,
        ThreadPoolExecutor(max_workers=1) as clients,
    ):
        first = clients.submit(server.post_json, json_request())
        try:
            wait_until(lambda: len(detector.calls) == 1)
            body = json.dumps(json_request(seed=5)).encode()
            waiting = begin_request(server.port, body, announced=len(body))
            wait_until(lambda: server.app.state.gate.present == 2)
            waiting.close()
            assert server.client.get("/healthz").status_code == 200  # the server has seen the closing by now
        finally:
            may_go.set()
        assert first.result().status_code == 200
        wait_until(lambda: sorted(logged_statuses(caplog)) == [200, 499])
        assert len(detector.calls) == 1


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("/secret/place broke"),
        CheckpointError("/secret/place: expected other weights", code="checkpoint_version"),
        MemoryError(),
    ],
)
def test_faults_of_ours_tell_the_client_nothing(error: Exception, caplog: pytest.LogCaptureFixture) -> None:
    with live_server(lambda settings: RuleDetector(error=error)) as server:
        response = server.post_json(json_request())
        assert_problem(response, 500, "internal_error", None)
        assert "secret" not in response.text
        assert server.client.get("/healthz").status_code == 200
    faults = [record for record in caplog.records if record.getMessage() == "unexpected_error"]
    assert [vars(record)["request_id"] for record in faults] == [response.json()["request_id"]]
