"""The service's door, before any endpoint: keys and scopes, rate limits, other sites' pages, the time of a request."""

from __future__ import annotations

import asyncio
import ipaddress
import time
from http import HTTPStatus
from typing import Final

from fastapi import FastAPI
from starlette.datastructures import Headers
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from viflow_anomaly_service.access_rules import (
    SAFE_METHODS,
    is_direct_from_here,
    is_foreign_name,
    is_foreign_page,
    is_loopback,
    is_open,
    is_own_page,
    required_scope,
)
from viflow_anomaly_service.api_keys import ApiKey, KeyRing
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.rate_limits import Allowance, RateLimiter
from viflow_anomaly_service.request_body import RequestBody
from viflow_anomaly_service.request_log import log_fields
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.socket_access import SocketAccess, may_come_later, offered_key

KEY_HEADER: Final = "X-API-Key"
CHALLENGE: Final = {"WWW-Authenticate": 'Bearer realm="viflow-anomaly"'}
CORS_HEADERS: Final = ("Authorization", KEY_HEADER, "Content-Type", "X-Request-ID", "Last-Event-ID")
EXPOSED_HEADERS: Final = ("X-Request-ID", "Retry-After")
_EVENT_STREAM: Final = "text/event-stream"


def add_access_control(app: FastAPI, settings: ServiceSettings) -> None:
    """Put the door in front of all endpoints; to be called before the request log is added around it.

    Raises:
        ConfigError: the key file cannot be used.
    """
    app.add_middleware(AccessMiddleware, settings=settings)
    app.add_middleware(RequestTimeMiddleware, limit_s=settings.request_timeout_s)
    if settings.allowed_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.allowed_origins,
            allow_methods=("GET", "POST", "PUT", "DELETE"),
            allow_headers=CORS_HEADERS,
            expose_headers=EXPOSED_HEADERS,
            max_age=600,
        )


class AccessMiddleware:
    """Refuses who shows no key of the needed scope, or asks too often.

    Without a key file everybody may ask who can reach the service, and is told apart by the address.
    The name of the key stands in the request's log line and, for endpoints, in ``scope["viflow_key_name"]``.
    """

    def __init__(self, app: ASGIApp, settings: ServiceSettings) -> None:
        self.app = app
        self._settings = settings
        self._keys = None if settings.key_file is None else KeyRing(settings.key_file)
        self._limiter = RateLimiter(time.time)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket") or is_open(scope["path"]):
            await self.app(scope, receive, send)
            return
        try:
            self._admit(scope)
        except Problem as problem:
            await _refuse(problem, scope, receive, send)
            return
        await self.app(scope, receive, send)

    def _admit(self, scope: Scope) -> None:
        headers, client = Headers(scope=scope), _client_of(scope)
        if self._keys is None:
            self._require_reachable(scope, headers)
        if scope["type"] == "websocket":
            self._admit_socket(scope, headers)
            return
        method, path = scope["method"], scope["path"]
        is_scrape = method in SAFE_METHODS and path == "/metrics"
        if self._keys is not None and is_scrape and is_direct_from_here(client, headers):
            return
        detection = required_scope(method, path) == "detect" and method == "POST"
        self._charge(scope, _shown_key(headers), detection=detection)

    def _admit_socket(self, scope: Scope, headers: Headers) -> None:
        """A browser opens WebSockets to any site and asks nobody: the page's origin is looked at in any case."""
        if is_foreign_page(headers, self._settings.allowed_origins):
            raise _origin_refused()
        shown = _shown_key(headers) or offered_key(scope.get("subprotocols", ()))
        pending = self._keys is not None and shown is None and may_come_later(scope["path"])
        scope["viflow_access"] = SocketAccess(
            lambda key, detection: self._charge(scope, key, detection=detection), key=shown, pending=pending
        )
        if not pending:
            self._charge(scope, shown, detection=False)

    def _charge(self, scope: Scope, shown: str | None, *, detection: bool) -> None:
        """Check the key, where keys are asked for, and count a request."""
        key = None
        if self._keys is not None:
            key = _require_key(self._keys, shown)
            scope["viflow_key_name"] = log_fields(scope)["key"] = key.name
            needed = required_scope(scope.get("method", "POST"), scope["path"])  # a WebSocket carries frames in
            if not key.may(needed):
                detail = f"expected a key of scope {needed}, found one of {', '.join(sorted(key.scopes))}"
                raise Problem(403, code="scope_missing", detail=detail)
        who = _network_of(_client_of(scope)) if key is None else f"key:{key.name}"
        self._limiter.charge(who, self._allowance(key), detection=detection)

    def _require_reachable(self, scope: Scope, headers: Headers) -> None:
        """Without keys: for this machine alone, unless it was said otherwise; not for pages of other sites."""
        allowed, method = self._settings.allowed_origins, scope.get("method", "GET")
        if self._settings.insecure_no_keys:
            if method not in SAFE_METHODS and is_foreign_page(headers, allowed, method) and not is_own_page(headers):
                raise _origin_refused()
            return
        server = scope.get("server")
        if server is not None and server[1] is not None and not is_loopback(server[0]):
            detail = "The service was started without keys, and answers on this machine's loopback address only."
            raise Problem(403, code="keys_missing", detail=detail)
        if is_foreign_name(headers, allowed):
            detail = "expected a request to this machine's loopback address or to an allowed origin, found another name"
            raise Problem(403, code="host_refused", detail=detail, field="Host")
        if is_foreign_page(headers, allowed, method):
            raise _origin_refused()

    def _allowance(self, key: ApiKey | None) -> Allowance:
        settings = self._settings
        if key is None:
            return Allowance(settings.rate_limit_per_s, settings.rate_limit_burst, settings.daily_quota)
        return Allowance(
            rate_per_s=key.rate_per_s or settings.rate_limit_per_s,
            burst=key.burst or settings.rate_limit_burst,
            daily=key.daily or settings.daily_quota,
        )


def _client_of(scope: Scope) -> str:
    client: str = (scope.get("client") or ("", 0))[0]
    return client


def _origin_refused() -> Problem:
    detail = "expected a page of this machine or an allowed origin, found another one"
    return Problem(403, code="origin_refused", detail=detail, field="Origin")


def _shown_key(headers: Headers) -> str | None:
    if (shown := headers.get(KEY_HEADER)) is not None:
        return shown
    scheme, _, credentials = headers.get("authorization", "").partition(" ")
    return credentials.strip() if scheme.lower() == "bearer" else None


def _require_key(keys: KeyRing, shown: str | None) -> ApiKey:
    if not shown:
        detail = f"expected an API key in 'Authorization: Bearer KEY' or '{KEY_HEADER}: KEY', found none"
        raise Problem(401, code="key_missing", detail=detail)
    key = keys.find(shown)
    if key is None:
        raise Problem(401, code="key_invalid", detail="expected a key that this service knows, found another one")
    return key


def _network_of(client: str) -> str:
    """Who is counted as one without keys: an IPv4 address, or the /64 network that one IPv6 subscriber has."""
    try:
        address = ipaddress.ip_address(client)
    except ValueError:
        return "unknown"
    if address.version == 4:
        return str(address)
    return str(ipaddress.ip_network((int(address) >> 64 << 64, 64)))


async def _refuse(problem: Problem, scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        scope["viflow_problem_code"] = problem.code
        if "websocket.http.response" not in scope.get("extensions", {}):
            await send({"type": "websocket.close", "code": 1008, "reason": problem.code})  # not accepted: HTTP 403
            return
        await problem.response(scope.get("viflow_request_id", ""))(scope, receive, send)
        return
    body = RequestBody(Request(scope, receive))
    await body.discard()
    problem.closes_connection = not body.finished
    scope["viflow_problem_code"] = problem.code
    headers = CHALLENGE if problem.status == HTTPStatus.UNAUTHORIZED else None
    await problem.response(scope.get("viflow_request_id", ""), headers)(scope, receive, send)


class RequestTimeMiddleware:
    """Ends a request whose answer is not out within ``limit_s`` from its head.

    It is the last word: uploads and turns have limits of their own. What it catches is a client that does not read its
    answer. One that comes in parts has ``limit_s`` for each of them; the events of a stream may be far apart.
    """

    def __init__(self, app: ASGIApp, limit_s: float) -> None:
        self.app = app
        self._limit_s = limit_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        begun = is_event_stream = False
        loop = asyncio.get_running_loop()

        async def send_watched(message: Message) -> None:
            nonlocal begun, is_event_stream
            if message["type"] == "http.response.start":
                begun = True
                is_event_stream = Headers(raw=message["headers"]).get("content-type", "").startswith(_EVENT_STREAM)
            if message.get("more_body") and not limit.expired():
                limit.reschedule(loop.time() + self._limit_s)
            await send(message)
            if is_event_stream and not limit.expired():
                limit.reschedule(None)

        try:
            async with asyncio.timeout(self._limit_s) as limit:
                await self.app(scope, receive, send_watched)
        except TimeoutError as err:
            if not limit.expired():
                raise
            if begun:  # it is not reading: nothing that is sent now would arrive
                raise ClientDisconnect from err
            detail = f"expected to be done with the request within {self._limit_s:g} s, was not"
            problem = Problem(503, code="request_timeout", detail=detail, retry_after_s=1)
            problem.closes_connection = True
            scope["viflow_problem_code"] = problem.code
            await problem.response(scope.get("viflow_request_id", ""))(scope, receive, send)
