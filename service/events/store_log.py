"""Events that stay: kept in the transaction of their detections, read in the order of the commits."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from functools import partial

from sqlalchemy.engine import Connection

from viflow_anomaly_service.events.event_record import EventRecord
from viflow_anomaly_service.events.event_rules import EndReason
from viflow_anomaly_service.events.event_store import EventStore
from viflow_anomaly_service.events.log import Bell, LoggedEvent, Place
from viflow_anomaly_service.store.keeper import ResultKeeper


class StoreLog:
    """The events in the store, of this process and of all that share it.

    Args:
        events: where they are.
        keeper: runs what blocks.
    """

    def __init__(self, events: EventStore, keeper: ResultKeeper) -> None:
        self._events = events
        self._keeper = keeper
        self._bell = Bell()
        self._seen = 0

    @property
    def changed(self) -> asyncio.Event:
        return self._bell.event

    async def newest(self) -> int:
        return await self._keeper.read(self._events.newest)

    async def place_of(self, event_id: str) -> Place:
        return await self._keeper.read(partial(self._events.place_of, event_id))

    async def after(self, seq: int, limit: int) -> list[LoggedEvent]:
        return await self._keeper.read(partial(self._events.after, seq, limit))

    def part_of_commit(self, events: Sequence[EventRecord]) -> Callable[[Connection], Sequence[EventRecord]] | None:
        return partial(self._events.insert, events=events) if events else None

    def took(self, events: Sequence[EventRecord]) -> Sequence[EventRecord]:
        if events:
            self._bell.ring()
        return events

    async def end(self, session_id: str, reason: EndReason, ends: Sequence[EventRecord]) -> Sequence[EventRecord]:
        is_open: bool = await self._keeper.read(partial(self._events.is_open, session_id))
        if ends or is_open:
            written = await self._keeper.change(partial(self._events.end_session, session_id, reason, ends))
            self._bell.ring()
            return written
        return []

    async def look(self) -> None:
        """Wake those who wait, if another process has kept events."""
        newest = await self.newest()
        if newest != self._seen:
            self._seen = newest
            self._bell.ring()
