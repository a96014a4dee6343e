"""OpenTelemetry traces, where an endpoint for them is named (``OTEL_EXPORTER_OTLP_ENDPOINT``) and the extra is there.

A span for every request and one for each of its stages. Nothing of OpenTelemetry is imported otherwise, and requests
pass no further code.
"""

from __future__ import annotations

import asyncio
import logging
import os
import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from viflow_anomaly_service.request_log import log_fields
from viflow_anomaly_service.stage_times import stage_times

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import SpanExporter
    from opentelemetry.trace import Span

logger = logging.getLogger(__name__)

ENDPOINT_VARIABLES: Final = ("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")
UNTRACED_PATHS: Final = frozenset({"/healthz", "/readyz", "/metrics"})
SERVICE_NAME: Final = "viflow-anomaly"
_SHOWN_FIELDS: Final = ("detection", "regions", "pairs", "faults", "key")
"""Of the request's log line: nothing that a client wrote."""


def configured_tracing(environment: Mapping[str, str] = os.environ) -> TracerProvider | None:
    """What OpenTelemetry's own variables ask for; None: no traces."""
    off = environment.get("OTEL_SDK_DISABLED", "").strip().lower() == "true"
    unwanted = environment.get("OTEL_TRACES_EXPORTER", "otlp").strip().lower() != "otlp"
    if off or unwanted or not any(environment.get(name, "").strip() for name in ENDPOINT_VARIABLES):
        return None
    try:
        from opentelemetry.sdk.resources import Resource  # noqa: PLC0415 - an extra
        from opentelemetry.sdk.trace import TracerProvider  # noqa: PLC0415
        from opentelemetry.sdk.trace.export import BatchSpanProcessor  # noqa: PLC0415

        exporter = otlp_exporter()
    except ImportError as err:
        hint = "pip install 'viflow-anomaly[otel]'"
        logger.warning("tracing_unavailable", extra={"missing": err.name, "hint": hint})
        return None
    named = {} if environment.get("OTEL_SERVICE_NAME") else {"service.name": SERVICE_NAME}
    provider = TracerProvider(resource=Resource.create(named), shutdown_on_exit=False)
    provider.add_span_processor(BatchSpanProcessor(exporter))
    return provider


def otlp_exporter() -> SpanExporter:
    """OTLP over HTTP (protobuf), to where the environment says."""
    from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter  # noqa: PLC0415

    return OTLPSpanExporter()


async def end_tracing(provider: TracerProvider, *, within_s: float) -> None:
    """Send what is left; a collector that does not take it in time gets no more, and the process does not wait."""
    ending = threading.Thread(target=provider.shutdown, name="traces-end", daemon=True)
    ending.start()
    await asyncio.to_thread(ending.join, within_s)
    if ending.is_alive():
        logger.warning("traces_not_sent_in_time")


class TracingMiddleware:
    """A span for every request, below the caller's where it sent W3C's ``traceparent``; its trace stands in the log."""

    def __init__(self, app: ASGIApp, provider: TracerProvider) -> None:
        from opentelemetry.trace.propagation.tracecontext import (  # noqa: PLC0415 - an extra
            TraceContextTextMapPropagator,
        )

        self.app = app
        self._tracer = provider.get_tracer("viflow_anomaly_service")
        self._propagator = TraceContextTextMapPropagator()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["path"] in UNTRACED_PATHS:
            await self.app(scope, receive, send)
            return
        from opentelemetry.trace import SpanKind  # noqa: PLC0415

        caller = self._propagator.extract(dict(Headers(scope=scope)))
        span = self._tracer.start_span(scope["method"][:16], context=caller, kind=SpanKind.SERVER)
        log_fields(scope)["trace_id"] = f"{span.get_span_context().trace_id:032x}"
        status = 0

        async def send_noting(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self.app(scope, receive, send_noting)
        except BaseException as err:
            span.record_exception(err)
            raise
        finally:
            self._finish(span, scope, status)

    def _finish(self, span: Span, scope: Scope, status: int) -> None:
        from opentelemetry.trace import StatusCode, set_span_in_context  # noqa: PLC0415

        route = getattr(scope.get("route"), "path", "none")
        attributes: dict[str, Any] = {
            "http.request.method": scope["method"][:16],
            "http.route": route,
            "http.response.status_code": status,
            "viflow.request_id": scope.get("viflow_request_id", ""),
        }
        fields = log_fields(scope)
        attributes |= {f"viflow.{name}": fields[name] for name in _SHOWN_FIELDS if name in fields}
        if (code := scope.get("viflow_problem_code")) is not None:
            attributes["viflow.code"] = code
        span.update_name(f"{scope['method'][:16]} {route}")
        span.set_attributes(attributes)
        if status == 0 or status >= 500:
            span.set_status(StatusCode.ERROR)
        within = set_span_in_context(span)
        for stage in stage_times(scope):
            self._tracer.start_span(stage.name, context=within, start_time=stage.started_ns).end(stage.ended_ns)
        span.end()
