"""Connections that cost a client nothing and the service a place: silent ones, slow heads, answers nobody reads."""

from __future__ import annotations

import asyncio
from typing import Any, Final

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from viflow_anomaly_service.settings import ServiceSettings

LINGER_SECONDS: Final = 5.0
"""For the rest of an answer on a connection that is being closed."""


def guarded_protocol(settings: ServiceSettings) -> type[H11Protocol]:
    """The class of uvicorn's connections, with the limits of ``settings`` (uvicorn makes the instances)."""

    class Connection(GuardedConnection):
        head_timeout_s = settings.head_timeout_s
        max_connections = settings.max_connections

    return Connection


class GuardedConnection(H11Protocol):
    """Closes a connection whose next request head does not come whole in time, and one too many at once.

    uvicorn's own timer ends with the first byte after an answer and does not run before the first request.
    """

    head_timeout_s: float
    max_connections: int
    _head_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        if len(self.connections) > self.max_connections:
            transport.abort()
            return
        self._watch_head()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._watch_head()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_watching()
        super().connection_lost(exc)

    def timeout_keep_alive_handler(self) -> None:
        super().timeout_keep_alive_handler()
        self.loop.call_later(LINGER_SECONDS, self.transport.abort)

    def _watch_head(self) -> None:
        """Start the clock where a head is awaited, stop it where there is one."""
        if self.conn.their_state is not h11.IDLE:
            self._stop_watching()
        elif self._head_timer is None:
            self._head_timer = self.loop.call_later(self.head_timeout_s, self._head_missing)

    def _stop_watching(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None

    def _head_missing(self) -> None:
        self._head_timer = None
        if self.conn.their_state is h11.IDLE:
            self.transport.abort()
