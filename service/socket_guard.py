"""uvicorn's WebSockets with our manners: a quiet log, an end in order, no patience with a peer that does not read."""

from __future__ import annotations

import logging
from typing import Any, Final

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from viflow_anomaly_service.connection_guard import LINGER_SECONDS
from viflow_anomaly_service.settings import ServiceSettings

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
    """One connection."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        # Its own lines show query strings, and headers in debug; ours are in the request log.
        self.logger = _FaultsOnly(self.logger)  # type: ignore[assignment]
        self.conn.debug = False

    async def run_asgi(self) -> None:
        await super().run_asgi()
        self.loop.call_later(self.close_timeout + LINGER_SECONDS, self.transport.abort)

    async def send(self, message: Any) -> None:
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


class _FaultsOnly(logging.LoggerAdapter[logging.Logger]):
    def __init__(self, logger: logging.Logger) -> None:
        super().__init__(logger, {})

    @property
    def level(self) -> int:
        return logging.ERROR

    def isEnabledFor(self, level: int) -> bool:
        return level >= logging.ERROR and super().isEnabledFor(level)
