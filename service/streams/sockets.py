"""``/streams/{id}`` as a WebSocket: an opening message, then calls in and answers out, in order, one at a time.

Each call takes the path of ``POST /streams/{id}/frames``. What a connection may have inside is small: one message at
work, ``AHEAD`` behind it; then its socket is not read until there is room. Before the opening message was accepted
there is room for that one alone.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import AsyncIterator, Iterator
from http import HTTPStatus
from typing import Any, Final

from fastapi import FastAPI, WebSocket
from starlette.requests import ClientDisconnect
from starlette.websockets import WebSocketDisconnect

from viflow_anomaly_service.problems import Problem, unexpected_problem
from viflow_anomaly_service.request_body import unless_gone
from viflow_anomaly_service.request_log import log_fields
from viflow_anomaly_service.service_core import ServiceCore
from viflow_anomaly_service.socket_access import PROTOCOL, SocketAccess
from viflow_anomaly_service.stage_times import StageClock
from viflow_anomaly_service.streams.calls import answer_call, require_callable
from viflow_anomaly_service.streams.schemas import StreamSetup
from viflow_anomaly_service.streams.socket_messages import MessageReading, read_opening

logger = logging.getLogger(__name__)

AHEAD: Final = 2
ROUTE: Final = "/streams/{stream_id}"
GOING_AWAY: Final = 1001
POLICY: Final = 1008
FAULT: Final = 1011
TRY_LATER: Final = 1013


class ClosingError(Exception):
    """The connection is to be closed, with this code and reason."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code = code
        self.reason = reason


class SocketPlaces:
    """How many WebSockets are open; those that have shown no key yet are counted apart and cannot keep others out."""

    def __init__(self, core: ServiceCore) -> None:
        self._limit = core.settings.max_websockets
        self._open = 0
        self._unknown = 0
        self._gauge = core.metrics.gauge("viflow_websockets", "Open WebSockets")

    @contextlib.contextmanager
    def unknown(self) -> Iterator[None]:
        """A place for one whose key is to come; Problem 503 ``sockets_full``."""
        self._require(self._unknown)
        self._unknown += 1
        try:
            yield
        finally:
            self._unknown -= 1

    @contextlib.contextmanager
    def taken(self) -> Iterator[None]:
        """A place; Problem 503 ``sockets_full``."""
        self._require(self._open)
        self._open += 1
        self._gauge.inc()
        try:
            yield
        finally:
            self._open -= 1
            self._gauge.dec()

    def _require(self, count: int) -> None:
        if count >= self._limit:
            detail = f"expected at most {self._limit} WebSockets at once, found one more"
            raise Problem(503, code="sockets_full", detail=detail, retry_after_s=5)


def add_stream_sockets(app: FastAPI, core: ServiceCore) -> None:
    """Add the endpoint."""
    places = SocketPlaces(core)

    @app.websocket(ROUTE)
    async def stream_socket(websocket: WebSocket, stream_id: str) -> None:
        try:
            require_callable(core, stream_id)
            access: SocketAccess = websocket.scope["viflow_access"]
            with contextlib.ExitStack() as place:
                place.enter_context(places.unknown() if access.pending else places.taken())
                await websocket.accept(subprotocol=PROTOCOL if PROTOCOL in websocket.scope["subprotocols"] else None)
                with contextlib.suppress(WebSocketDisconnect, ClientDisconnect, TimeoutError):
                    await StreamSocket(core, websocket, stream_id, access).run(places, place)
        except Problem as problem:
            websocket.scope["viflow_problem_code"] = problem.code
            await websocket.send_denial_response(problem.response(websocket.scope.get("viflow_request_id", "")))


class StreamSocket:
    """One connection from its acceptance to its end."""

    def __init__(self, core: ServiceCore, websocket: WebSocket, stream_id: str, access: SocketAccess) -> None:
        self._core = core
        self._websocket = websocket
        self._stream_id = stream_id
        self._access = access
        self._inbox = Inbox(websocket, core.gate.closing)
        self._request_id = str(websocket.scope.get("viflow_request_id", ""))
        self._log = log_fields(websocket.scope)

    async def run(self, places: SocketPlaces, place: contextlib.ExitStack) -> None:
        """Until either side closes."""
        async with self._inbox.filled():
            try:
                setup = await self._opened(places, place)
                self._inbox.widen()
                await self._send({"opened": {"stream_id": self._stream_id}})
                number = 0
                while True:
                    message = await self._inbox.next(self._core.settings.websocket_idle_s, "idle")
                    number += 1
                    self._log["messages"] = number
                    await self._answer(message, setup, number)
                    del message
            except ClosingError as closing:
                async with asyncio.timeout(self._core.settings.body_timeout_s):
                    await self._websocket.close(closing.code, closing.reason)

    async def _opened(self, places: SocketPlaces, place: contextlib.ExitStack) -> StreamSetup:
        settings = self._core.settings
        message = await self._inbox.next(settings.head_timeout_s, "opening_timeout")
        try:
            opening = read_opening(message, settings)
            if self._access.pending:
                self._access.admit(opening.key)
                place.close()
                place.enter_context(places.taken())
        except Problem as problem:
            await self._send(self._problem(problem, None, self._request_id))
            code = TRY_LATER if problem.status == HTTPStatus.SERVICE_UNAVAILABLE else POLICY
            raise ClosingError(code, problem.code) from problem
        return StreamSetup(camera=opening.camera, options=opening.options)

    async def _answer(self, message: str | bytes, setup: StreamSetup, number: int) -> None:
        started, clock = time.perf_counter(), StageClock(self._core.metrics)
        reading = MessageReading(message, setup, self._core.settings)
        request_id = f"{self._request_id}-{number}"
        status, code = int(HTTPStatus.OK), None
        try:
            answer = await self._judged(reading, clock)
            await self._send_text(f'{{"id":{json.dumps(reading.id)},"answer":{answer.decode()}}}')
        except Problem as problem:
            if reading.id is None:
                await asyncio.to_thread(reading.identify)
            status, code = problem.status, problem.code
            await self._send(self._problem(problem, reading.id, request_id))
            if problem.status in (HTTPStatus.UNAUTHORIZED, HTTPStatus.FORBIDDEN):
                raise ClosingError(POLICY, problem.code) from problem
        except (ClientDisconnect, WebSocketDisconnect, TimeoutError):  # or does not read its answer
            status = 499
            raise
        except Exception as err:
            logger.exception("unexpected_error", extra={"request_id": request_id})
            status, code = int(HTTPStatus.INTERNAL_SERVER_ERROR), "internal_error"
            await self._send(self._problem(unexpected_problem(), reading.id, request_id))
            raise ClosingError(FAULT, "internal_error") from err
        finally:
            seconds = time.perf_counter() - started
            self._core.metrics.observe_request(route=ROUTE, method="MESSAGE", status=status, seconds=seconds)
            log = {**clock.log, "request_id": request_id, "status": status, "duration_ms": round(seconds * 1e3, 3)}
            logger.info("message", extra=log if code is None else {**log, "code": code})

    async def _judged(self, reading: MessageReading, clock: StageClock) -> bytes:
        self._access.charge_detection()
        models = require_callable(self._core, self._stream_id)

        async def receive() -> MessageReading:
            return reading

        return await answer_call(
            self._core,
            self._stream_id,
            models,
            receive=receive,
            while_connected=lambda work: unless_gone(work, self._inbox.left.wait()),
            clock=clock,  # told to no span: those are of HTTP requests
        )

    def _problem(self, problem: Problem, message_id: int | str | None, request_id: str) -> dict[str, Any]:
        self._core.metrics.observe_problem(problem.code)
        said: dict[str, Any] = {"id": message_id, "problem": problem.body(request_id)}
        if problem.retry_after_s is not None:
            said["retry_after_s"] = problem.retry_after_s
        return said

    async def _send(self, value: dict[str, Any]) -> None:
        await self._send_text(json.dumps(value, allow_nan=False))

    async def _send_text(self, text: str) -> None:
        """A peer that does not read its answers loses its connection."""
        async with asyncio.timeout(self._core.settings.body_timeout_s):
            await self._websocket.send_text(text)


class Inbox:
    """What has arrived and waits: the opening message alone, then ``AHEAD``.

    Attributes:
        left: the peer has gone. Heard of also while a message is at work and others wait, unless the peer has sent more
            than the system holds for a socket that is not read: then a ping without answer tells.
    """

    def __init__(self, websocket: WebSocket, closing: asyncio.Event) -> None:
        self._websocket = websocket
        self._closing = closing
        self._messages: asyncio.Queue[str | bytes] = asyncio.Queue()
        self._room = asyncio.Semaphore(1)
        self._wide = False
        self.left: asyncio.Event = websocket.scope.get("viflow_left") or asyncio.Event()

    def widen(self) -> None:
        """The opening message was taken and accepted."""
        self._wide = True
        for _ in range(AHEAD):
            self._room.release()

    @contextlib.asynccontextmanager
    async def filled(self) -> AsyncIterator[None]:
        """Inside, messages are taken in."""
        filling = asyncio.create_task(self._fill())
        try:
            yield
        finally:
            filling.cancel()
            await asyncio.wait({filling})

    async def next(self, patience_s: float, reason: str) -> str | bytes:
        """The next message.

        Args:
            patience_s: how long to wait for it; ``reason``: what is said when that is over.

        Raises:
            ClosingError: none came, or the service is ending.
            ClientDisconnect: the peer has gone.
        """
        if self._closing.is_set():
            raise ClosingError(GOING_AWAY, "shutting_down")
        message = asyncio.ensure_future(self._messages.get())
        left, closing = (asyncio.ensure_future(one.wait()) for one in (self.left, self._closing))
        try:
            await asyncio.wait({message, left, closing}, timeout=patience_s, return_when=asyncio.FIRST_COMPLETED)
            if message.done() and not left.done():
                if self._wide:
                    self._room.release()
                return message.result()
            if left.done():
                raise ClientDisconnect
            if closing.done():
                raise ClosingError(GOING_AWAY, "shutting_down")
            raise ClosingError(POLICY, reason)
        finally:
            for one in (message, left, closing):
                one.cancel()

    async def _fill(self) -> None:
        try:
            while True:
                await self._room.acquire()  # before it is received: no message waits in a hand
                event = await self._websocket.receive()
                if event["type"] != "websocket.receive":
                    break
                text: str | None = event.get("text")
                self._messages.put_nowait(event["bytes"] if text is None else text)
                del event, text
        finally:
            self.left.set()
