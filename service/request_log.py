"""A request id and one structured log line for every request; the last line of defence against our own faults."""

from __future__ import annotations

import json
import logging
import re
import time
import uuid
from typing import Any, Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from viflow_anomaly_service.problems import unexpected_problem

logger = logging.getLogger(__name__)

REQUEST_ID_HEADER: Final = "X-Request-ID"
CLIENT_CLOSED_REQUEST: Final = 499  # nginx's number for a client that left before its answer
_ACCEPTED_ID: Final = re.compile(r"[A-Za-z0-9._-]{1,64}", re.ASCII)
_MAX_LOGGED_PATH: Final = 200
_STANDARD_ATTRIBUTES: Final = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "color_message"}


class JsonLineFormatter(logging.Formatter):
    """One JSON object a line, ASCII only: a line break in a path or a message cannot forge a second line."""

    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, Any] = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created)) + f".{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "event": record.getMessage(),
        }
        line |= {key: value for key, value in vars(record).items() if key not in _STANDARD_ATTRIBUTES}
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


class RequestLogMiddleware:
    """Takes X-Request-ID over where it is harmless, else makes one; returns it; logs method, path, status, duration.

    Neither query strings nor headers nor bodies are logged.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        offered = Headers(scope=scope).get(REQUEST_ID_HEADER, "")
        request_id = offered if _ACCEPTED_ID.fullmatch(offered) else uuid.uuid4().hex
        scope["viflow_request_id"] = request_id
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
        except Exception:
            logger.exception("unexpected_error", extra={"request_id": request_id})
            if status:  # the answer has begun: only the server can end it, by closing the connection
                raise
            problem = unexpected_problem()
            scope["viflow_problem_code"] = problem.code
            await problem.response(request_id)(scope, receive, send_with_id)
        finally:
            self._log(scope, request_id, status, started)

    @staticmethod
    def _log(scope: Scope, request_id: str, status: int, started: float) -> None:
        fields = {
            "request_id": request_id,
            "method": scope["method"],
            "path": scope["path"][:_MAX_LOGGED_PATH],
            "status": status,
            "duration_ms": round((time.perf_counter() - started) * 1e3, 3),
            "code": scope.get("viflow_problem_code"),
        }
        logger.info("request", extra={key: value for key, value in fields.items() if value is not None})


def configure_logging(level: str) -> None:
    """Send this process's log to stderr, one JSON object a line; called once, at the start of the server process."""
    handler = logging.StreamHandler()
    handler.setFormatter(JsonLineFormatter())
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(level.upper())
