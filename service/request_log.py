"""A request id and one structured log line for every request; the last line of defence against our own faults."""

from __future__ import annotations

import logging
import re
import time
import uuid
from collections.abc import MutableMapping
from typing import Any, Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from viflow_anomaly_service.metrics import ServiceMetrics
from viflow_anomaly_service.problems import unexpected_problem

logger = logging.getLogger(__name__)

REQUEST_ID_HEADER: Final = "X-Request-ID"
CLIENT_CLOSED_REQUEST: Final = 499  # nginx's number for a client that left before its answer
_ACCEPTED_ID: Final = re.compile(r"[A-Za-z0-9._-]{1,64}", re.ASCII)
_TRACE_PARENT: Final = re.compile(r"[0-9a-f]{2}-(?!0{32})(?P<trace>[0-9a-f]{32})-(?!0{16})[0-9a-f]{16}-[0-9a-f]{2}")
"""W3C Trace Context: what a caller with traces of its own sends along."""
_MAX_LOGGED_PATH: Final = 200


def log_fields(scope: MutableMapping[str, Any]) -> dict[str, Any]:
    """What endpoints add to their request's log line: plain numbers and words, nothing that a client wrote."""
    fields: dict[str, Any] = scope.setdefault("viflow_log_fields", {})
    return fields


class RequestLogMiddleware:
    """Takes X-Request-ID over where it is harmless, else makes one; returns it; logs and counts every request.

    Neither query strings nor headers nor bodies are logged.
    """

    def __init__(self, app: ASGIApp, metrics: ServiceMetrics) -> None:
        self.app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await self._socket(scope, receive, send)
            return
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        request_id = _request_id(scope)
        if (traced := _TRACE_PARENT.fullmatch(Headers(scope=scope).get("traceparent", ""))) is not None:
            log_fields(scope)["trace_id"] = traced["trace"]
        started = time.perf_counter()
        status = 0

        async def send_with_id(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                MutableHeaders(scope=message)[REQUEST_ID_HEADER] = request_id
            await send(message)

        try:
            await self.app(scope, receive, send_with_id)
        except ClientDisconnect:
            status = CLIENT_CLOSED_REQUEST
            self._metrics.clients_gone.inc()
        except Exception:
            logger.exception("unexpected_error", extra={"request_id": request_id})
            if status:  # the answer has begun: only the server can end it, by closing the connection
                raise
            problem = unexpected_problem()
            scope["viflow_problem_code"] = problem.code
            await problem.response(request_id)(scope, receive, send_with_id)
        finally:
            self._log(scope, request_id, status, started)

    async def _socket(self, scope: Scope, receive: Receive, send: Send) -> None:
        """A line when it is over, with the code that it was closed with, or the status that it was refused with."""
        request_id, started, code = _request_id(scope), time.perf_counter(), 0

        async def receive_noting() -> Message:
            nonlocal code
            message = await receive()
            if message["type"] == "websocket.disconnect":
                code = code or message.get("code") or 1005
            return message

        async def send_with_id(message: Message) -> None:
            nonlocal code
            if message["type"] in ("websocket.accept", "websocket.http.response.start"):
                message.setdefault("headers", [])
                MutableHeaders(scope=message)[REQUEST_ID_HEADER] = request_id
            code = message.get("status" if "response" in message["type"] else "code", code)
            await send(message)

        try:
            await self.app(scope, receive_noting, send_with_id)
        except Exception:
            logger.exception("unexpected_error", extra={"request_id": request_id})
            await send({"type": "websocket.close", "code": 1011, "reason": "internal_error"})
        finally:
            fields = {
                "request_id": request_id,
                "path": scope["path"][:_MAX_LOGGED_PATH],
                "closed_with": code,
                "duration_ms": round((time.perf_counter() - started) * 1e3, 3),
                "code": scope.get("viflow_problem_code"),
                **log_fields(scope),
            }
            if fields["code"] is not None:
                self._metrics.observe_problem(str(fields["code"]))
            logger.info("websocket", extra={key: value for key, value in fields.items() if value is not None})

    def _log(self, scope: Scope, request_id: str, status: int, started: float) -> None:
        seconds = time.perf_counter() - started
        code = scope.get("viflow_problem_code")
        route = getattr(scope.get("route"), "path", "none")  # paths of clients would be names without end
        self._metrics.observe_request(route=route, method=scope["method"], status=status, seconds=seconds)
        if code is not None:
            self._metrics.observe_problem(code)
        fields = {
            "request_id": request_id,
            "method": scope["method"],
            "path": scope["path"][:_MAX_LOGGED_PATH],
            "status": status,
            "duration_ms": round(seconds * 1e3, 3),
            "code": code,
            **log_fields(scope),
        }
        logger.info("request", extra={key: value for key, value in fields.items() if value is not None})


def _request_id(scope: Scope) -> str:
    """The client's, where it is harmless, or a new one; noted in the scope."""
    offered = Headers(scope=scope).get(REQUEST_ID_HEADER, "")
    request_id = offered if _ACCEPTED_ID.fullmatch(offered) else uuid.uuid4().hex
    scope["viflow_request_id"] = request_id
    return request_id
