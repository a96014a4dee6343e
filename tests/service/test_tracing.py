"""Traces: a span for a request and for each stage, below the caller's; nothing where nobody asked for it."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
from rule_detector import RuleDetector
from service_world import imu_part, json_request, live_server

from viflow_anomaly_service import tracing
from viflow_anomaly_service.tracing import ENDPOINT_VARIABLES, TracingMiddleware, configured_tracing

pytest.importorskip("opentelemetry.sdk")
from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.sdk.trace import ReadableSpan
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

TRACE = "4bf92f3577b34da6a3ce929d0e0e4736"
PARENT = {"traceparent": f"00-{TRACE}-00f067aa0ba902b7-01"}


@pytest.fixture
def exported(monkeypatch: pytest.MonkeyPatch) -> InMemorySpanExporter:
    """Where spans go; complete once the service has ended."""
    exporter = InMemorySpanExporter()
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setattr(tracing, "otlp_exporter", lambda: exporter)
    return exporter


def by_name(exporter: InMemorySpanExporter) -> dict[str, ReadableSpan]:
    return {span.name: span for span in exporter.get_finished_spans()}


def test_a_request_and_its_stages_are_spans_below_the_callers(
    exported: InMemorySpanExporter, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    with live_server(lambda settings: RuleDetector(), store_url=str(tmp_path / "x.db")) as server:
        assert server.post_json(json_request(), headers=PARENT).status_code == 200
    spans = by_name(exported)
    whole = spans.pop("POST /detect")
    assert f"{whole.context.trace_id:032x}" == TRACE
    assert whole.parent is not None
    assert f"{whole.parent.span_id:016x}" == "00f067aa0ba902b7"
    assert whole.attributes is not None
    assert (whole.attributes["http.route"], whole.attributes["http.response.status_code"]) == ("/detect", 200)
    assert set(spans) == {"upload", "queue", "decode", "detect", "encode", "store"}
    for stage in spans.values():
        assert stage.parent is not None
        assert (stage.parent.span_id, stage.context.trace_id) == (whole.context.span_id, whole.context.trace_id)
        assert stage.start_time <= stage.end_time <= whole.end_time
    assert whole.resource.attributes["service.name"] == "viflow-anomaly"
    (line,) = [record for record in caplog.records if getattr(record, "path", "") == "/detect"]
    assert line.trace_id == TRACE  # type: ignore[attr-defined]


def test_calls_of_a_stream_and_refusals_are_traced_health_is_not(exported: InMemorySpanExporter) -> None:
    with live_server(lambda settings: RuleDetector()) as server:
        assert server.client.post("/streams/a/frames", json={"imu": imu_part()}).status_code == 200
        assert server.post_bytes(b"{").status_code == 400
        assert server.client.get("/nowhere/x").status_code == 404
        server.client.get("/healthz")
    names = {span.name for span in exported.get_finished_spans()}
    assert {"POST /streams/{stream_id}/frames", "POST /detect", "GET none", "decode"} <= names
    assert not any("healthz" in name or "readyz" in name for name in names)
    refused = by_name(exported)["POST /detect"]
    assert refused.attributes is not None
    assert refused.attributes["viflow.code"] == "json_invalid"
    assert refused.status.is_unset


def test_a_fault_of_ours_is_an_error(exported: InMemorySpanExporter) -> None:
    with live_server(lambda settings: RuleDetector(error=RuntimeError("broken"))) as server:
        assert server.post_json(json_request()).status_code == 500
    (whole,) = [span for span in exported.get_finished_spans() if span.name == "POST /detect"]
    assert not whole.status.is_ok
    assert not whole.status.is_unset
    assert whole.events[0].name == "exception"


@pytest.mark.parametrize("value", ["", "x", f"00-{'0' * 32}-00f067aa0ba902b7-01", f"00-{TRACE}-{'0' * 16}-01"])
def test_a_broken_traceparent_begins_a_trace_of_its_own(exported: InMemorySpanExporter, value: str) -> None:
    with live_server(lambda settings: RuleDetector()) as server:
        assert server.client.get("/version", headers={"traceparent": value}).status_code == 200
    assert by_name(exported)["GET /version"].parent is None


def test_without_an_endpoint_there_is_none_and_the_callers_trace_is_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ENDPOINT_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    caplog.set_level("INFO")
    with live_server(lambda settings: RuleDetector()) as server:
        assert not any(one.cls is TracingMiddleware for one in server.app.user_middleware)
        server.client.get("/version", headers=PARENT)
    (line,) = [record for record in caplog.records if getattr(record, "path", "") == "/version"]
    assert line.trace_id == TRACE  # type: ignore[attr-defined]


@pytest.mark.parametrize("off", [{"OTEL_SDK_DISABLED": "true"}, {"OTEL_TRACES_EXPORTER": "none"}])
def test_it_can_be_switched_off(off: dict[str, str]) -> None:
    assert configured_tracing({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://127.0.0.1:9", **off}) is None


def test_without_the_extra_the_log_names_it(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk.trace", None)
    assert configured_tracing({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://127.0.0.1:9"}) is None
    (record,) = caplog.records
    assert record.hint == "pip install 'viflow-anomaly[otel]'"  # type: ignore[attr-defined]


def test_the_application_imports_nothing_of_it() -> None:
    code = "import sys, viflow_anomaly_service.app as a; sys.exit('opentelemetry.sdk' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.fixture
def collector() -> Iterator[tuple[int, list[ExportTraceServiceRequest]]]:
    """Its port, and what it was sent."""
    received: list[ExportTraceServiceRequest] = []

    class Collect(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            assert self.path == "/v1/traces"
            body = self.rfile.read(int(self.headers["content-length"]))
            received.append(ExportTraceServiceRequest.FromString(body))
            self.send_response(200)
            self.send_header("content-length", "0")
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Collect) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server.server_port, received
        server.shutdown()
        thread.join()


def test_a_collector_receives_them(
    collector: tuple[int, list[ExportTraceServiceRequest]], monkeypatch: pytest.MonkeyPatch
) -> None:
    port, received = collector
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", f"http://127.0.0.1:{port}")
    assert isinstance(tracing.otlp_exporter(), OTLPSpanExporter)
    with live_server(lambda settings: RuleDetector()) as server:
        assert server.post_json(json_request()).status_code == 200
    names = {
        span.name
        for request in received
        for resource in request.resource_spans
        for scope in resource.scope_spans
        for span in scope.spans
    }
    assert {"POST /detect", "detect"} <= names


def test_a_collector_that_is_gone_stops_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", f"http://127.0.0.1:{port}")
    with live_server(lambda settings: RuleDetector()) as server:
        assert [server.post_json(json_request()).status_code for _ in range(3)] == [200] * 3
