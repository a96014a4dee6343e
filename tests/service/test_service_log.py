"""Request ids and the log: one JSON object a line, which nobody outside can forge or fill with secrets."""

from __future__ import annotations

import asyncio
import json
import logging
import time
from typing import Any

import pytest
from service_world import LiveServer, assert_problem, json_request, problem_of

from viflow_anomaly_service.json_log import JsonLineFormatter, configure_logging
from viflow_anomaly_service.metrics import ServiceMetrics
from viflow_anomaly_service.request_log import RequestLogMiddleware


def request_lines(
    caplog: pytest.LogCaptureFixture, *, expected: int = 2, of: set[str] | None = None
) -> list[dict[str, Any]]:
    """The lines of the answered requests; a line may follow its answer by a moment."""
    deadline = time.monotonic() + 10.0
    while time.monotonic() < deadline:
        records = [record for record in caplog.records if record.getMessage() == "request"]
        if of is not None:  # one of an earlier test may be written late
            records = [record for record in records if vars(record)["request_id"] in of]
        if len(records) >= expected:
            break
        time.sleep(0.01)
    formatter = JsonLineFormatter()
    written = [formatter.format(record) for record in records]
    assert all("\n" not in line and line.isascii() for line in written)
    return [json.loads(line) for line in written]


@pytest.mark.parametrize("offered", ["drone7-000042", "a", "A.b_c-1" * 9])
def test_a_harmless_request_id_is_taken_over(server: LiveServer, offered: str) -> None:
    response = server.client.get("/healthz", headers={"X-Request-ID": offered})
    assert response.headers["x-request-id"] == offered


@pytest.mark.parametrize("offered", ["", "a" * 65, "a b", 'x","level":"error', "ü", "<script>"])
def test_any_other_request_id_is_replaced(server: LiveServer, offered: str) -> None:
    first, second = (server.client.get("/healthz", headers={"X-Request-ID": offered.encode()}) for _ in range(2))
    assert len(first.headers["x-request-id"]) == 32
    assert first.headers["x-request-id"] != second.headers["x-request-id"]


def test_a_problem_carries_the_request_id(server: LiveServer) -> None:
    response = server.client.post("/detect", content=b"{", headers={"X-Request-ID": "abc", "Content-Type": "text/x"})
    assert problem_of(response)["request_id"] == "abc"


def test_one_line_for_each_request(server: LiveServer, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    server.post_json(json_request(), headers={"X-Request-ID": "good", "Authorization": "Bearer hush"})
    server.post_json({"secret": "hush"}, headers={"X-Request-ID": "bad"})
    good, bad = request_lines(caplog, of={"good", "bad"})
    assert (good["request_id"], good["status"], good["method"], good["path"]) == ("good", 200, "POST", "/detect")
    assert good["level"] == "info"
    assert good["duration_ms"] > 0
    assert "code" not in good
    assert (bad["request_id"], bad["status"], bad["code"]) == ("bad", 422, "field_missing")
    assert "hush" not in caplog.text


def test_hostile_paths_stay_inside_their_line(server: LiveServer, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    assert_problem(server.client.get('/%0A{"level":"error"}%0D\u2028?key=hush'), 404, "not_found", None)
    server.client.get("/" + "x" * 5000)
    forged, long = request_lines(caplog)
    assert forged["path"].startswith('/\n{"level"')
    assert len(long["path"]) == 200
    assert "hush" not in json.dumps(forged)


def test_formatter_writes_exceptions_and_odd_values_in_one_line() -> None:
    err = ValueError("first\nsecond")
    record = logging.makeLogRecord(
        {"name": "n", "levelname": "ERROR", "msg": "failed %s", "args": ("x",), "exc_info": (type(err), err, None)}
    )
    record.place = {1}
    line = JsonLineFormatter().format(record)
    assert "\n" not in line
    values = json.loads(line)
    assert (values["event"], values["level"], values["logger"]) == ("failed x", "error", "n")
    assert "first\nsecond" in values["exception"]


def test_configure_logging_replaces_the_handlers(monkeypatch: pytest.MonkeyPatch) -> None:
    root = logging.getLogger()
    monkeypatch.setattr(root, "handlers", list(root.handlers))
    level = root.level
    try:
        configure_logging("warning")
        assert [type(handler.formatter) for handler in root.handlers] == [JsonLineFormatter]
        assert root.level == logging.WARNING
        configure_logging("info")
        assert not logging.getLogger("httpx").isEnabledFor(logging.INFO)  # it tells whom it asks, passwords included
    finally:
        root.setLevel(level)


def test_other_protocols_pass_through() -> None:
    seen: list[str] = []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        seen.append(scope["type"])

    asyncio.run(RequestLogMiddleware(app, ServiceMetrics())({"type": "lifespan"}, None, None))  # type: ignore[arg-type]
    assert seen == ["lifespan"]


def test_a_fault_after_the_answer_began_goes_to_the_server() -> None:
    sent: list[Any] = []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        raise RuntimeError("late")

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {"type": "http", "method": "GET", "path": "/", "headers": []}
    with pytest.raises(RuntimeError, match="late"):
        asyncio.run(RequestLogMiddleware(app, ServiceMetrics())(scope, None, send))  # type: ignore[arg-type]
    assert [message["type"] for message in sent] == ["http.response.start"]
