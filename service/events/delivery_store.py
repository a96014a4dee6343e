"""Deliveries in the store's database: what waits for whom, and which process is the one that delivers."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from viflow_anomaly_service.events.event_record import EventRecord
from viflow_anomaly_service.store.detection_store import DetectionStore
from viflow_anomaly_service.store.tables import DELIVERIES, EVENTS, OPEN_EVENTS, SINKS

DeliveryState = Literal["pending", "delivered", "dead"]
KNOWN_STREAMS: Final = 1000
MAX_ERROR: Final = 300
_DELIVERY: Final = (
    EVENTS.c.seq,
    DELIVERIES.c.sink,
    DELIVERIES.c.state,
    DELIVERIES.c.attempts,
    DELIVERIES.c.next_attempt_ns,
    DELIVERIES.c.last_error,
    EVENTS.c.event_id,
    EVENTS.c.thing_id,
    EVENTS.c.kind,
    EVENTS.c.stream_id,
    EVENTS.c.timestamp_ns,
    EVENTS.c.body,
)


@dataclass(frozen=True)
class Delivery:
    """An event on its way to a sink."""

    seq: int
    sink: str
    state: DeliveryState
    attempts: int
    next_attempt_ns: int
    last_error: str | None
    event: EventRecord


@dataclass(frozen=True)
class Backlog:
    """What a sink has not got: numbers, and the event that waits longest."""

    pending: int
    dead: int
    oldest_event_id: str | None


class DeliveryStore:
    """The deliveries of all sinks.

    Args:
        store: whose database it is.
        holder: this process.
    """

    def __init__(self, store: DetectionStore, *, holder: str) -> None:
        self._store = store
        self._holder = holder

    def hold(self, sink: str, seconds: float) -> bool:
        """Become, or stay, the one process that delivers to a sink; False: another one is.

        Args:
            seconds: after which another one may, unless this is called again; the same in all processes. What is held
                for longer than twice that was held by a clock that was ahead.
        """
        now_ns = time.time_ns()
        values = {"holder": self._holder, "held_until_ns": now_ns + round(seconds * 1e9)}
        with self._store.transaction(writes=True) as connection:
            insert: Any = postgresql.insert if connection.dialect.name == "postgresql" else sqlite.insert
            taken = insert(SINKS).values(sink=sink, **values)
            until = SINKS.c.held_until_ns
            held = until.between(now_ns, now_ns + round(2 * seconds * 1e9))
            free = sa.or_(SINKS.c.holder == self._holder, sa.not_(held))
            taken = taken.on_conflict_do_update(index_elements=["sink"], set_=values, where=free)
            return connection.execute(taken.returning(SINKS.c.sink)).scalar() is not None

    def release(self, sink: str) -> None:
        """Let another process deliver at once."""
        with self._store.transaction(writes=True) as connection:
            connection.execute(sa.delete(SINKS).where(SINKS.c.sink == sink, SINKS.c.holder == self._holder))

    def pending(self, sink: str, limit: int) -> list[Delivery]:
        """What waits for a sink, in the order of the events."""
        return self._select([DELIVERIES.c.sink == sink, DELIVERIES.c.state == "pending"], limit, after=0)

    def page(self, state: str | None, limit: int, after: int) -> tuple[list[Delivery], bool]:
        """All deliveries of some events, in the order of the events; and whether there are more.

        Args:
            state: only those that are in it.
            limit: events.
            after: number of the event behind which to begin.
        """
        wanted = [DELIVERIES.c.state == state] if state is not None else []
        seq = DELIVERIES.c.event_seq
        events = sa.select(seq).where(*wanted, seq > after).distinct().order_by(seq).limit(limit + 1)
        found = self._select([*wanted, seq.in_(events)], None, after=after)  # one statement: nothing changes within it
        seqs = sorted({one.seq for one in found})
        return [one for one in found if one.seq in seqs[:limit]], len(seqs) > limit

    def get(self, event_id: str, sink: str) -> Delivery | None:
        found = self._select([EVENTS.c.event_id == event_id, DELIVERIES.c.sink == sink], 1, after=0)
        return found[0] if found else None

    def note(
        self, delivery: Delivery, state: DeliveryState, *, attempts: int, next_attempt_ns: int, error: str | None
    ) -> None:
        """What an attempt came to, unless another process has made one meanwhile."""
        one = (DELIVERIES.c.event_seq == delivery.seq, DELIVERIES.c.sink == delivery.sink)
        same = (DELIVERIES.c.state == "pending", DELIVERIES.c.attempts == delivery.attempts)
        with self._store.transaction(writes=True) as connection:
            connection.execute(
                sa.update(DELIVERIES)
                .where(*one, *same)
                .values(
                    state=state,
                    attempts=attempts,
                    next_attempt_ns=next_attempt_ns,
                    last_error=None if error is None else error[:MAX_ERROR],
                )
            )

    def revive(self, delivery: Delivery) -> bool:
        """Make a dead letter wait again, as if it had never been tried; False: it is not dead."""
        one = (DELIVERIES.c.event_seq == delivery.seq, DELIVERIES.c.sink == delivery.sink)
        values = {"state": "pending", "attempts": 0, "next_attempt_ns": time.time_ns()}
        with self._store.transaction(writes=True) as connection:
            found = connection.execute(sa.update(DELIVERIES).where(*one, DELIVERIES.c.state == "dead").values(**values))
        return bool(found.rowcount)

    def backlog(self, sink: str) -> Backlog:
        """How much waits for a sink."""
        mine = DELIVERIES.c.sink == sink
        counted = sa.select(DELIVERIES.c.state, sa.func.count(), sa.func.min(DELIVERIES.c.event_seq))
        counted = counted.where(mine, DELIVERIES.c.state.in_(("pending", "dead"))).group_by(DELIVERIES.c.state)
        with self._store.transaction() as connection:
            found = {state: (count, first) for state, count, first in connection.execute(counted)}
            pending, first = found.get("pending", (0, None))
            oldest = sa.select(EVENTS.c.event_id).where(EVENTS.c.seq == first)
            event_id = None if first is None else connection.execute(oldest).scalar()
        return Backlog(pending, found.get("dead", (0, None))[0], event_id)

    def open_things(self, sink: str) -> dict[str, set[str]]:
        """Stream -> what is open in it as far as the sink was told, also where that is nothing."""
        newest = sa.func.max(EVENTS.c.seq)
        known = sa.select(EVENTS.c.stream_id).group_by(EVENTS.c.stream_id).order_by(newest.desc()).limit(KNOWN_STREAMS)
        untold = (
            sa.select(EVENTS.c.thing_id, EVENTS.c.stream_id, EVENTS.c.kind)
            .join(DELIVERIES, DELIVERIES.c.event_seq == EVENTS.c.seq)
            .where(DELIVERIES.c.sink == sink, DELIVERIES.c.state == "pending", EVENTS.c.kind != "update")
            .order_by(EVENTS.c.seq)
        )
        with self._store.transaction() as connection:
            found: dict[str, set[str]] = {stream: set() for stream in connection.execute(known).scalars()}
            for thing, stream in connection.execute(sa.select(OPEN_EVENTS.c.thing_id, OPEN_EVENTS.c.stream_id)):
                found.setdefault(stream, set()).add(thing)
            seen = set()
            for thing, stream, kind in connection.execute(untold):
                if thing in seen:
                    continue
                seen.add(thing)  # the first message that the sink has not got says where it stands
                things = found.setdefault(stream, set())
                (things.discard if kind == "start" else things.add)(thing)
        return found

    def _select(self, conditions: Sequence[Any], limit: int | None, *, after: int) -> list[Delivery]:
        wanted = (
            sa.select(*_DELIVERY)
            .join(EVENTS, DELIVERIES.c.event_seq == EVENTS.c.seq)
            .where(*conditions, DELIVERIES.c.event_seq > after)
            .order_by(DELIVERIES.c.event_seq, DELIVERIES.c.sink)
            .limit(limit)
        )
        with self._store.transaction() as connection:
            return [_delivery(row) for row in connection.execute(wanted)]


def _delivery(row: Any) -> Delivery:
    seq, sink, state, attempts, next_attempt_ns, last_error, *event = row
    return Delivery(seq, sink, state, attempts, next_attempt_ns, last_error, EventRecord(*event))
