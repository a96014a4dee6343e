"""uvicorn's WebSockets with our manners: a quiet log, an end in order, no patience with a peer that does not read."""

from __future__ import annotations

import asyncio
import logging
import select
import sys
from http import HTTPStatus
from typing import Any, Final

from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import CloseCode

from viflow_anomaly_service.connection_guard import LINGER_SECONDS
from viflow_anomaly_service.settings import ServiceSettings

MAX_FRAGMENTS: Final = 1024
"""Of one message."""
MAX_UNREAD_BYTES: Final = 256 * 1024
"""Of what was sent to a peer that goes on asking for more."""
PONG_SECONDS: Final = 60.0
"""Longer than a message waits for its turn: the answer to a ping comes behind those that were sent before."""


def socket_options(settings: ServiceSettings) -> dict[str, Any]:
    """Arguments for ``uvicorn.Config``. Nothing is compressed: images are, and small messages could become large."""
    return {
        "ws": GuardedSocket,
        "ws_max_size": settings.max_websocket_bytes,
        "ws_ping_timeout": PONG_SECONDS,
        "ws_per_message_deflate": False,
    }


class GuardedSocket(WebSocketsSansIOProtocol):
    """One connection; says in ``scope["viflow_left"]``, an event, that the peer has gone.

    uvicorn says that behind the messages that wait, and does not hear of it while they keep it from reading.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._left = asyncio.Event()
        self._unreadable = False
        self._hangup: HangupWatch | None = None
        # Its own lines show query strings, and headers in debug; ours are in the request log.
        self.logger = _FaultsOnly(self.logger)  # type: ignore[assignment]
        self.conn.debug = False

    def handle_connect(self, event: Any) -> None:
        super().handle_connect(event)
        if self.response.status_code == HTTPStatus.SWITCHING_PROTOCOLS:
            self.scope["viflow_left"] = self._left  # type: ignore[typeddict-unknown-key]
            self._hangup = HangupWatch(self.loop, self.transport, self._left)

    def handle_ping(self) -> None:
        """Pongs that nobody reads are kept by no limit of uvicorn's."""
        if self.transport.get_write_buffer_size() > MAX_UNREAD_BYTES:
            self.transport.abort()
        else:
            super().handle_ping()

    def handle_cont(self, event: Any) -> None:
        """A limit of bytes alone lets messages of empty fragments go on for ever."""
        if len(self.frames) >= MAX_FRAGMENTS:
            self.transport.abort()
        else:
            super().handle_cont(event)

    def send_receive_event_to_app(self) -> None:
        """Text that is not UTF-8 is the peer's mistake: closed, and not logged with a traceback as uvicorn does."""
        if self.curr_msg_data_type == "text" and not self.close_sent and not _is_utf8(b"".join(self.frames)):
            self.frames = []
            self.conn.send_close(CloseCode.INVALID_DATA)
            self.handle_parser_exception()
            return
        super().send_receive_event_to_app()

    def handle_parser_exception(self) -> None:
        """What cannot be read ends the connection; a message at work is not answered any more."""
        self._unreadable = True
        self._left.set()
        super().handle_parser_exception()

    def handle_close(self, event: Any) -> None:
        self._left.set()
        super().handle_close(event)

    def connection_lost(self, exc: Exception | None) -> None:
        self._left.set()
        if self._hangup is not None:
            self._hangup.end()
        super().connection_lost(exc)

    async def run_asgi(self) -> None:
        await super().run_asgi()
        self.loop.call_later(self.close_timeout + LINGER_SECONDS, self.transport.abort)

    async def send(self, message: Any) -> None:
        if self._unreadable:
            raise ClientDisconnected  # uvicorn calls it a fault of ours until the transport is closed, too
        await super().send(message)
        if message["type"] == "websocket.http.response.body" and self.close_sent:
            self.handshake_complete = True  # or it would log the refusal, which is whole, as a fault of ours

    def shutdown(self) -> None:
        """The application, which knows that the service ends, answers what it has and closes with 1001."""
        if not self.handshake_complete or self.close_sent:
            super().shutdown()

    def keepalive_timeout(self) -> None:
        super().keepalive_timeout()
        self.loop.call_later(LINGER_SECONDS, self.transport.abort)


def _is_utf8(data: bytes) -> bool:
    try:
        data.decode()
    except UnicodeDecodeError:
        return False
    return True


class HangupWatch:
    """Hears that the other side has ended its connection, also while nothing is read of it; on Linux only.

    Args:
        loop: on which ``left`` is set.
        transport: of the connection.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, transport: asyncio.Transport, left: asyncio.Event) -> None:
        self._loop = loop
        self._left = left
        self._poll: Any = None
        if sys.platform == "linux":
            self._poll = select.epoll()
            self._poll.register(transport.get_extra_info("socket").fileno(), select.EPOLLRDHUP)
            loop.add_reader(self._poll.fileno(), self._heard)

    def end(self) -> None:
        """Before the connection's socket is closed."""
        if self._poll is not None:
            self._loop.remove_reader(self._poll.fileno())
            self._poll.close()
            self._poll = None

    def _heard(self) -> None:
        self._left.set()
        self.end()


class _FaultsOnly(logging.LoggerAdapter[logging.Logger]):
    def __init__(self, logger: logging.Logger) -> None:
        super().__init__(logger, {})

    @property
    def level(self) -> int:
        return logging.ERROR

    def isEnabledFor(self, level: int) -> bool:
        return level >= logging.ERROR and super().isEnabledFor(level)
