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
from test_service_metrics import scraped

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
            wait_until(lambda: server.app.state.core.gate.present == 2)
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
    head = "POST /detect HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    head += f"Content-Length: {announced}\r\n\r\n"
    connection.sendall(head.encode() + body)
    return connection


def logged_statuses(caplog: pytest.LogCaptureFixture, path: str = "/detect") -> list[int]:
    return [vars(record)["status"] for record in caplog.records if vars(record).get("path") == path]


def test_a_client_that_leaves_in_the_middle_of_its_upload(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    with live_server(lambda settings: RuleDetector(), max_concurrent=1, max_queued=0) as server:
        begin_request(server.port, b"{", announced=1000).close()
        wait_until(lambda: logged_statuses(caplog) == [499])
        assert server.app.state.core.gate.present == 0
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
            wait_until(lambda: scraped(server)["viflow_queue_depth", ()] == 1)  # inside comes before uploaded
            waiting.close()
            wait_until(lambda: logged_statuses(caplog) == [499])  # an answer to another request does not say so
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


def test_work_for_a_client_that_leaves_while_it_runs_is_dropped_and_its_place_is_free(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    may_go = threading.Event()
    detector = RuleDetector(may_go=may_go)
    with live_server(lambda settings: detector, max_concurrent=1, max_queued=0) as server:
        body = json.dumps(json_request()).encode()
        try:
            leaving = begin_request(server.port, body, announced=len(body))
            wait_until(lambda: len(detector.calls) == 1)
            leaving.close()
            wait_until(lambda: logged_statuses(caplog) == [499])
            assert server.app.state.core.gate.present == 0
        finally:
            may_go.set()
        assert server.post_json(json_request()).status_code == 200
    assert "unexpected_error" not in caplog.messages


def test_many_clients_get_their_own_answers_and_the_log_says_how_long_each_stage_took(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    with (
        live_server(lambda settings: RuleDetector(), max_concurrent=2, max_queued=64) as server,
        ThreadPoolExecutor(max_workers=24) as clients,
    ):
        alone = [server.post_json(json_request(seed=seed)).json()["rois"] for seed in range(8)]
        together = list(clients.map(lambda number: server.post_json(json_request(seed=number % 8)), range(96)))
        assert [answer.status_code for answer in together] == [200] * 96
        assert [answer.json()["rois"] for answer in together] == alone * 12
        assert server.app.state.core.gate.present == 0
        wait_until(lambda: len(logged_statuses(caplog)) == 104)
    line = next(vars(record) for record in caplog.records if vars(record).get("path") == "/detect")
    for stage in ("upload", "queue", "decode", "detect", "encode"):
        assert line[f"{stage}_ms"] >= 0
    assert (line["detection"], line["regions"]) == ("ok", len(alone[0]))


def test_slow_uploads_hold_places_but_nobody_else_up() -> None:
    with live_server(lambda settings: RuleDetector(), max_concurrent=1, max_queued=2, body_timeout_s=20) as server:
        slow = [begin_request(server.port, b"{", announced=1000) for _ in range(2)]
        wait_until(lambda: server.app.state.core.gate.present == 2)
        assert server.post_json(json_request()).status_code == 200
        slow.append(begin_request(server.port, b"{", announced=1000))
        wait_until(lambda: server.app.state.core.gate.present == 3)
        assert_problem(server.post_json(json_request()), 503, "overloaded", None)
        assert server.client.get("/readyz").status_code == 200
        for connection in slow:
            connection.close()
        wait_until(lambda: server.app.state.core.gate.present == 0)
        assert server.post_json(json_request()).status_code == 200


def test_a_client_that_reads_slowly_holds_no_worker(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    with live_server(lambda settings: RuleDetector(), max_concurrent=1, max_queued=0) as server:
        body = json.dumps(json_request()).encode()
        lazy = begin_request(server.port, body, announced=len(body))
        try:
            wait_until(lambda: logged_statuses(caplog) == [200])
            assert server.post_json(json_request()).status_code == 200
            assert lazy.recv(12) == b"HTTP/1.1 200"
        finally:
            lazy.close()
