"""Events in the store's database. Every call blocks and is a transaction, but ``insert``, which is part of one."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import Any, Final

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import Connection

from viflow_anomaly_service.events.event_record import EventRecord, ended
from viflow_anomaly_service.events.event_rules import EndReason
from viflow_anomaly_service.events.log import LoggedEvent, Place
from viflow_anomaly_service.events.query import EventFilter
from viflow_anomaly_service.store.detection_store import DetectionStore
from viflow_anomaly_service.store.record import IdMaker
from viflow_anomaly_service.store.tables import DELIVERIES, EVENTS, OPEN_EVENTS

_ORDER_LOCK: Final = 0x7669666C6F78  # any number that nobody else takes
ENDED_AT_ONCE: Final = 100
_READ: Final = (
    EVENTS.c.seq,
    EVENTS.c.event_id,
    EVENTS.c.thing_id,
    EVENTS.c.kind,
    EVENTS.c.stream_id,
    EVENTS.c.timestamp_ns,
    EVENTS.c.body,
)


class EventStore:
    """Events, and which of them are open.

    Args:
        store: whose database it is.
        sinks: names of those who are to be told of every event.
        holder: this process; what it has begun is its own for ``hold_s`` after ``hold_open``.
        hold_s: the same in all processes. What is held for longer than twice that was held by a clock that was ahead.
    """

    def __init__(self, store: DetectionStore, *, sinks: Sequence[str], holder: str, hold_s: float) -> None:
        self._store = store
        self._sinks = tuple(sinks)
        self._holder = holder
        self._hold_ns = round(hold_s * 1e9)
        self._new_id = IdMaker()

    def insert(self, connection: Connection, events: Iterable[EventRecord]) -> list[EventRecord]:
        """Those that were written: events in their order, each with a delivery to every sink.

        One that is there already is left out (a call that was sent again because nobody knew of its commit), and so is
        what would come behind the end of its event (another process has taken this one for dead).
        """
        if connection.dialect.name == "postgresql":  # numbers are given in the order of commits
            connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_ORDER_LOCK)))
        return [event for event in events if self._insert(connection, event)]

    def add(self, events: Sequence[EventRecord]) -> list[EventRecord]:
        """As ``insert``, in a transaction of its own."""
        with self._store.transaction(writes=True) as connection:
            return self.insert(connection, events)

    def newest(self) -> int:
        """The number of the last event; 0: there was none."""
        with self._store.transaction() as connection:
            return connection.execute(sa.select(sa.func.max(EVENTS.c.seq))).scalar_one() or 0

    def place_of(self, event_id: str) -> Place:
        """Behind an event, or behind the last one before its time where it is gone."""
        with self._store.transaction() as connection:
            found = connection.execute(sa.select(EVENTS.c.seq).where(EVENTS.c.event_id == event_id)).scalar()
            if found is not None:
                return Place(found, gap=False)
            earlier = sa.select(sa.func.max(EVENTS.c.seq)).where(EVENTS.c.event_id < event_id)
            return Place(connection.execute(earlier).scalar() or 0, gap=True)

    def after(self, seq: int, limit: int) -> list[LoggedEvent]:
        """The events behind a number, in order."""
        wanted = sa.select(*_READ).where(EVENTS.c.seq > seq).order_by(EVENTS.c.seq).limit(limit)
        with self._store.transaction() as connection:
            return [_logged(row) for row in connection.execute(wanted)]

    def page(self, chosen: EventFilter, limit: int, after: str | None) -> tuple[list[LoggedEvent], bool]:
        """Events that pass the filter, behind the one with the id ``after``; and whether there are more."""
        falling = chosen.order == "desc"
        found = sa.select(*_READ).where(*_conditions(chosen))
        if after is not None:
            place = sa.select(EVENTS.c.seq).where(EVENTS.c.event_id == after).scalar_subquery()
            by_id = EVENTS.c.event_id < after if falling else EVENTS.c.event_id > after
            by_seq = EVENTS.c.seq < place if falling else EVENTS.c.seq > place
            found = found.where(sa.case((place.is_(None), by_id), else_=by_seq))
        by = EVENTS.c.seq.desc() if falling else EVENTS.c.seq.asc()
        with self._store.transaction() as connection:
            rows = connection.execute(found.order_by(by).limit(limit + 1)).all()
        return [_logged(row) for row in rows[:limit]], len(rows) > limit

    def hold_open(self) -> None:
        """Say that this process lives, and will end what it has begun."""
        held = sa.update(OPEN_EVENTS).where(OPEN_EVENTS.c.holder == self._holder)
        with self._store.transaction(writes=True) as connection:
            connection.execute(held.values(held_until_ns=time.time_ns() + self._hold_ns))

    def is_open(self, session_id: str) -> bool:
        """Whether something is open of a session of a stream."""
        return self._some_open(_of_session(session_id))

    def end_session(self, session_id: str, reason: EndReason, ends: Sequence[EventRecord]) -> list[EventRecord]:
        """Keep these ends, and end what else is open: its start was committed, though nobody came to know of it.

        Returns:
            what was written.
        """
        with self._store.transaction(writes=True) as connection:
            written = self.insert(connection, ends)
            left = connection.execute(sa.select(OPEN_EVENTS.c.body).where(_of_session(session_id))).scalars().all()
            others = [ended(body, event_id=self._new_id(), reason=reason) for body in left]
            return written + self.insert(connection, others)

    def holds_some(self) -> bool:
        """Whether something is open that this process has begun."""
        return self._some_open(OPEN_EVENTS.c.holder == self._holder)

    def has_abandoned(self) -> bool:
        """Whether something is open that a process has begun which is no more."""
        return self._some_open(self._abandoned())

    def end_abandoned(self) -> int:
        """End what processes have begun that are no more; how many events that were."""
        gone = sa.select(OPEN_EVENTS.c.body).where(self._abandoned())
        with self._store.transaction(writes=True) as connection:
            bodies = connection.execute(gone.limit(ENDED_AT_ONCE)).scalars().all()
            ends = [ended(body, event_id=self._new_id(), reason="service_restarted") for body in bodies]
            return len(self.insert(connection, ends))

    def _abandoned(self) -> sa.ColumnElement[bool]:
        now_ns = time.time_ns()
        return sa.not_(OPEN_EVENTS.c.held_until_ns.between(now_ns, now_ns + 2 * self._hold_ns))

    def _some_open(self, condition: sa.ColumnElement[bool]) -> bool:
        with self._store.transaction() as connection:
            return connection.execute(sa.select(OPEN_EVENTS.c.thing_id).where(condition).limit(1)).first() is not None

    def _insert(self, connection: Connection, event: EventRecord) -> bool:
        mine = OPEN_EVENTS.c.thing_id == event.thing_id
        if event.kind != "start" and connection.execute(sa.select(OPEN_EVENTS.c.thing_id).where(mine)).first() is None:
            return False
        made = _insertion(connection)(EVENTS).values(
            event_id=event.event_id,
            thing_id=event.thing_id,
            kind=event.kind,
            stream_id=event.stream_id,
            timestamp_ns=event.timestamp_ns,
            body=event.body,
        )
        made = made.on_conflict_do_nothing(index_elements=["thing_id", "kind", "timestamp_ns"])
        seq = connection.execute(made.returning(EVENTS.c.seq)).scalar()
        if seq is None:
            return False
        if event.kind == "end":
            connection.execute(sa.delete(OPEN_EVENTS).where(mine))
        else:
            held_until_ns = time.time_ns() + self._hold_ns
            values = {"holder": self._holder, "held_until_ns": held_until_ns, "body": event.body}
            opened = _insertion(connection)(OPEN_EVENTS).values(
                thing_id=event.thing_id, stream_id=event.stream_id, **values
            )
            connection.execute(opened.on_conflict_do_update(index_elements=["thing_id"], set_=values))
        now_ns = time.time_ns()
        waiting = {"event_seq": seq, "state": "pending", "attempts": 0, "next_attempt_ns": now_ns}
        if self._sinks:
            connection.execute(sa.insert(DELIVERIES), [{**waiting, "sink": sink} for sink in self._sinks])
        return True


def _of_session(session_id: str) -> sa.ColumnElement[bool]:
    return OPEN_EVENTS.c.thing_id.startswith(f"{session_id}-", autoescape=True)


def _insertion(connection: Connection) -> Any:
    return postgresql.insert if connection.dialect.name == "postgresql" else sqlite.insert


def _conditions(chosen: EventFilter) -> list[Any]:
    conditions: list[Any] = []
    if chosen.stream_id is not None:
        conditions.append(EVENTS.c.stream_id == chosen.stream_id)
    if chosen.kind is not None:
        conditions.append(EVENTS.c.kind == chosen.kind)
    if chosen.from_ns is not None:
        conditions.append(EVENTS.c.timestamp_ns >= chosen.from_ns)
    if chosen.to_ns is not None:
        conditions.append(EVENTS.c.timestamp_ns < chosen.to_ns)
    return conditions


def _logged(row: Any) -> LoggedEvent:
    return LoggedEvent(row.seq, EventRecord(*row[1:]))
