"""Where events are read from in their order; and a ring in memory that is one, for a service without a store."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from itertools import count, islice
from typing import TYPE_CHECKING, NamedTuple, Protocol

from viflow_anomaly_service.events.event_record import EventRecord
from viflow_anomaly_service.events.event_rules import EndReason

if TYPE_CHECKING:
    from sqlalchemy.engine import Connection


class LoggedEvent(NamedTuple):
    """An event and its number: later ones have greater numbers."""

    seq: int
    event: EventRecord


class Place(NamedTuple):
    """Where a reader stands: behind the event ``seq``; ``gap``: what came next may be missing."""

    seq: int
    gap: bool


class EventLog(Protocol):
    """Events in the order in which they were kept."""

    @property
    def changed(self) -> asyncio.Event:
        """Set once events come; taken before ``after``, so that none is slept through."""

    async def newest(self) -> int:
        """The number of the last event; 0: there was none."""

    async def place_of(self, event_id: str) -> Place:
        """Behind an event."""

    async def after(self, seq: int, limit: int) -> list[LoggedEvent] | None:
        """Events behind a number; None: some of them are gone."""

    def part_of_commit(self, events: Sequence[EventRecord]) -> Callable[[Connection], Sequence[EventRecord]] | None:
        """What keeps the events together with their detections, and gives those that are new; None: nothing can."""

    def took(self, events: Sequence[EventRecord]) -> Sequence[EventRecord]:
        """The detections are kept, and with them what ``part_of_commit`` keeps; gives the events that are new."""

    async def end(self, session_id: str, reason: EndReason, ends: Sequence[EventRecord]) -> Sequence[EventRecord]:
        """Keep the ends of a session of a stream, and end what else is open in it; gives the ends that are new.

        Raises:
            Problem: 503 ``store_...``.
        """


class Bell:
    """Wakes all who wait; whoever takes ``event`` before looking misses no ring."""

    def __init__(self) -> None:
        self.event = asyncio.Event()

    def ring(self) -> None:
        self.event.set()
        self.event = asyncio.Event()


class MemoryLog:
    """The last events of this process.

    Args:
        size: how many are kept.
    """

    def __init__(self, size: int) -> None:
        self._kept: deque[LoggedEvent] = deque(maxlen=size)
        self._open: set[str] = set()
        self._numbers = count(1)
        self._bell = Bell()

    @property
    def changed(self) -> asyncio.Event:
        return self._bell.event

    async def newest(self) -> int:
        return self._kept[-1].seq if self._kept else 0

    async def place_of(self, event_id: str) -> Place:
        for seq, event in self._kept:
            if event.event_id == event_id:
                return Place(seq, gap=False)
        first = self._kept[0].seq if self._kept else 1
        return Place(first - 1, gap=True)

    async def after(self, seq: int, limit: int) -> list[LoggedEvent] | None:
        if self._kept and self._kept[0].seq > seq + 1:
            return None
        skipped = seq + 1 - self._kept[0].seq if self._kept else 0
        return list(islice(self._kept, skipped, skipped + limit))

    def part_of_commit(self, events: Sequence[EventRecord]) -> None:
        return None

    def took(self, events: Sequence[EventRecord]) -> Sequence[EventRecord]:
        taken = []
        for event in events:
            if event.kind != "start" and event.thing_id not in self._open:
                continue  # it has ended: its stream was forgotten while a call was at work
            (self._open.discard if event.kind == "end" else self._open.add)(event.thing_id)
            self._kept.append(LoggedEvent(next(self._numbers), event))
            taken.append(event)
        if taken:
            self._bell.ring()
        return taken

    async def end(self, session_id: str, reason: EndReason, ends: Sequence[EventRecord]) -> Sequence[EventRecord]:
        return self.took(ends)
