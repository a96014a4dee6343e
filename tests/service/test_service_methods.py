"""HEAD and OPTIONS: the head of what GET answers, and which methods a path has."""

from __future__ import annotations

from pathlib import Path

import pytest
from rule_detector import RuleDetector
from service_world import LiveServer, live_server, wait_until

from viflow_anomaly_service.api_keys import new_key

SAME_EACH_TIME = (
    "/",
    "/dashboard/app.js",
    "/dashboard/nothing.js",
    "/healthz",
    "/readyz",
    "/version",
    "/models",
    "/live",
    "/streams",
    "/streams/nobody",
    "/events",
    "/detections",
    "/docs",
    "/openapi.json",
    "/schemas/detection-1.0.json",
    "/nowhere",
    "/detect",
)


@pytest.mark.parametrize("path", SAME_EACH_TIME)
def test_head_is_what_get_answers_without_its_body(server: LiveServer, path: str) -> None:
    got, head = server.client.get(path), server.client.head(path)
    assert head.status_code == got.status_code
    for name in ("content-type", "content-length", "etag", "cache-control", "content-security-policy", "allow"):
        assert head.headers.get(name) == got.headers.get(name)
    assert head.content == b""


def test_head_of_what_changes_all_the_time(server: LiveServer) -> None:
    head = server.client.head("/metrics")
    assert (head.status_code, head.content) == (200, b"")
    assert int(head.headers["content-length"]) > 1000


def test_a_file_that_is_known_is_not_sent_again(server: LiveServer) -> None:
    etag = server.client.head("/").headers["etag"]
    assert server.client.head("/", headers={"If-None-Match": etag}).status_code == 304


@pytest.mark.parametrize("path", ["/events/live", "/live/pairs", "/streams/a/live"])
def test_head_begins_no_stream_and_holds_no_place(path: str) -> None:
    with live_server(lambda settings: RuleDetector(), max_event_readers=1) as server:
        for _ in range(70):  # more than may follow at once
            head = server.client.head(path)
            assert (head.status_code, head.content) == (200, b"")
            assert head.headers["content-type"].startswith("text/event-stream")


def test_head_is_counted_as_what_it_is(server: LiveServer) -> None:
    server.client.head("/version")
    counted = 'viflow_requests_total{method="HEAD",route="/version",status="200"}'
    wait_until(lambda: counted in server.client.get("/metrics").text)


@pytest.mark.parametrize(
    ("path", "allowed"),
    [
        ("/", "GET, HEAD, OPTIONS"),
        ("/dashboard/app.js", "GET, HEAD, OPTIONS"),
        ("/healthz", "GET, HEAD, OPTIONS"),
        ("/metrics", "GET, HEAD, OPTIONS"),
        ("/openapi.json", "GET, HEAD, OPTIONS"),
        ("/detections", "GET, HEAD, OPTIONS"),
        ("/detect", "OPTIONS, POST"),
        ("/streams/a", "DELETE, GET, HEAD, OPTIONS"),
        ("/models/default", "OPTIONS, PUT"),
    ],
)
def test_options_names_the_methods_of_a_path(server: LiveServer, path: str, allowed: str) -> None:
    answer = server.client.options(path)
    assert (answer.status_code, answer.headers["allow"], answer.content) == (204, allowed, b"")
    refused = server.client.patch(path)
    assert (refused.status_code, refused.headers["allow"]) == (405, allowed)


def test_options_of_no_path(server: LiveServer) -> None:
    assert server.client.options("/nowhere").status_code == 404


def test_head_needs_the_key_that_get_needs(tmp_path: Path) -> None:
    key, line = new_key("reader", ["read"])
    (tmp_path / "keys.txt").write_text(f"{line}\n")
    with live_server(lambda settings: RuleDetector(), key_file=tmp_path / "keys.txt") as server:
        assert server.client.head("/live").status_code == 401
        assert server.client.head("/live", headers={"X-API-Key": key}).status_code == 200
        assert server.client.head("/healthz").status_code == 200
