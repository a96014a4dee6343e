"""Events and deliveries in the store itself, on SQLite and on PostgreSQL; and the ring that replaces them."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import pytest
import sqlalchemy as sa
from alembic import command
from alembic.config import Config

from viflow_anomaly_service.events import delivery_store, event_store
from viflow_anomaly_service.events.delivery_store import DeliveryStore
from viflow_anomaly_service.events.event_record import EventRecord
from viflow_anomaly_service.events.event_store import EventStore
from viflow_anomaly_service.events.live import LiveReaders
from viflow_anomaly_service.events.log import MemoryLog, Place
from viflow_anomaly_service.events.metrics import EventMetrics
from viflow_anomaly_service.events.query import EventFilter
from viflow_anomaly_service.metrics import ServiceMetrics
from viflow_anomaly_service.store.detection_store import DetectionStore
from viflow_anomaly_service.store.engine import MIGRATIONS, make_engine, store_url
from viflow_anomaly_service.store.record import IdMaker, first_id_at, stored_at_ns

NEW_ID = IdMaker()
SINKS = ("mqtt", "webhook-000000000000")


@pytest.fixture
def store(empty_store_url: str) -> Iterator[DetectionStore]:
    opened = DetectionStore(empty_store_url)
    opened.open()
    yield opened
    opened.close()


@pytest.fixture
def events(store: DetectionStore) -> EventStore:
    return EventStore(store, sinks=SINKS, holder="a" * 32, hold_s=30.0)


@pytest.fixture
def deliveries(store: DetectionStore) -> DeliveryStore:
    return DeliveryStore(store, holder="a" * 32)


@dataclass
class Clock:
    """The wall clock as events and deliveries see it."""

    ahead_s: float = 0.0

    def time_ns(self) -> int:
        return time.time_ns() + round(self.ahead_s * 1e9)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(delivery_store, "time", made)
    monkeypatch.setattr(event_store, "time", made)
    return made


def event(kind: Any, thing: str = "t-1", *, at: int = 0, stream: str = "hall") -> EventRecord:
    new_id = NEW_ID()
    body = {"event_id": new_id, "kind": kind, "thing_id": thing, "stream_id": stream, "timestamp_ns": at}
    return EventRecord(new_id, thing, kind, stream, at, json.dumps(body))


def id_of_an_hour_ago(told: EventRecord) -> str:
    earlier = first_id_at(stored_at_ns(told.event_id) - 3600 * 10**9)
    return earlier + told.event_id[len(earlier) :]


def kinds(events: EventStore) -> list[str]:
    return [one.event.kind for one in events.after(0, 1000)]


def test_what_is_there_already_or_behind_its_end_is_left_out(events: EventStore) -> None:
    first = [event("start", at=1), event("update", at=2), event("end", at=3)]
    events.add(first)
    assert events.add([event("start", at=1), event("update", at=2), event("end", at=3)]) == []  # sent again
    assert events.add([event("update", at=4), event("end", at=5)]) == []  # of one that has ended
    assert [one.event for one in events.after(0, 10)] == first
    events.add([event("start", at=6)])
    events.add([event("end", at=7)])
    assert kinds(events) == ["start", "update", "end", "start", "end"]


def test_numbers_follow_the_commits_of_several_processes(empty_store_url: str) -> None:
    stores = [DetectionStore(empty_store_url) for _ in range(3)]
    stores[0].open()
    parts = [EventStore(one, sinks=(), holder=str(k), hold_s=30.0) for k, one in enumerate(stores)]
    done = threading.Event()

    def write(number: int) -> None:
        for k in range(20):
            parts[number].add([event("start", f"{number}-{k}", at=k), event("end", f"{number}-{k}", at=k)])

    def follow() -> list[str]:
        """What a reader sees who never looks back."""
        seq, found, last = 0, [], False
        while not last:
            last = done.is_set()
            for one in parts[2].after(seq, 7):
                seq, last = one.seq, False
                found.append(one.event.event_id)
        return found

    with ThreadPoolExecutor(3) as threads:
        reader = threads.submit(follow)
        for one in [threads.submit(write, 0), threads.submit(write, 1)]:
            one.result()
        done.set()
        found = reader.result()
    assert len(found) == len(set(found)) == 80
    for one_store in stores:
        one_store.close()


def test_the_place_of_an_event_that_is_gone_is_behind_those_before_it(
    events: EventStore, store: DetectionStore
) -> None:
    told = [event("start", f"t-{k}") for k in range(3)]
    events.add(told)
    assert events.place_of(told[1].event_id) == Place(events.after(0, 2)[1].seq, gap=False)
    gone = NEW_ID()
    later = event("start", "t-9")
    events.add([later])
    place = events.place_of(gone)
    assert ([one.event for one in events.after(place.seq, 9)], place.gap) == ([later], True)
    assert events.place_of("0" * 32) == Place(0, gap=True)


def test_numbers_are_not_given_again(events: EventStore, store: DetectionStore) -> None:
    events.add([event("start"), event("end")])
    newest = events.newest()
    store.prune(max_age_s=1e-6, max_bytes=None)
    assert (events.newest(), kinds(events)) == (0, [])
    events.add([event("start", "t-2")])
    assert events.newest() > newest


def test_events_and_their_deliveries_go_with_the_detections_of_their_time(
    events: EventStore, store: DetectionStore, deliveries: DeliveryStore
) -> None:
    old = [replace(one, event_id=id_of_an_hour_ago(one)) for one in (event("start"), event("end"))]
    new = event("start", "t-2")
    events.add([*old, new])
    store.prune(max_age_s=1800.0, max_bytes=None)
    assert [one.event for one in events.after(0, 9)] == [new]
    assert [one.event for one in deliveries.pending("mqtt", 9)] == [new]
    store.prune(max_age_s=1e-6, max_bytes=None)
    assert deliveries.pending("mqtt", 9) == []


def test_what_a_dead_process_has_begun_is_ended_once(store: DetectionStore) -> None:
    dead = EventStore(store, sinks=SINKS, holder="d" * 32, hold_s=0.0)
    alive = EventStore(store, sinks=SINKS, holder="a" * 32, hold_s=30.0)
    dead.add([event("start", "d-1", at=1), event("start", "d-2", at=1), event("update", "d-1", at=2)])
    alive.add([event("start", "a-1", at=1)])
    assert (alive.holds_some(), alive.has_abandoned()) == (True, True)
    assert (alive.end_abandoned(), alive.end_abandoned()) == (2, 0)
    assert not alive.has_abandoned()
    ends, _ = alive.page(EventFilter(kind="end", order="asc"), 9, None)
    assert {one.event.thing_id for one in ends} == {"d-1", "d-2"}
    bodies = [json.loads(one.event.body) for one in ends]
    assert {body["reason"] for body in bodies} == {"service_restarted"}
    assert [body["event_id"] for body in bodies] == [one.event.event_id for one in ends]
    dead.add([event("end", "d-1", at=5)])  # it was not dead after all
    assert kinds(alive).count("end") == 2


def test_who_lives_keeps_what_it_has_begun(store: DetectionStore, clock: Clock) -> None:
    events = EventStore(store, sinks=(), holder="a" * 32, hold_s=30.0)
    events.add([event("start")])
    clock.ahead_s = 20.0
    events.hold_open()
    clock.ahead_s = 45.0
    assert not events.has_abandoned()
    clock.ahead_s = 55.0
    assert events.has_abandoned()


def test_what_a_clock_that_was_ahead_held_is_abandoned(store: DetectionStore, clock: Clock) -> None:
    dead, alive = (EventStore(store, sinks=(), holder=name * 32, hold_s=30.0) for name in "da")
    clock.ahead_s = 3600.0
    dead.add([event("start", "d-1")])
    assert not alive.has_abandoned()
    clock.ahead_s = 0.0
    assert alive.has_abandoned()
    assert alive.end_abandoned() == 1


def test_one_process_delivers_to_a_sink(store: DetectionStore, clock: Clock) -> None:
    one, other = (DeliveryStore(store, holder=name * 32) for name in "ab")
    assert one.hold("mqtt", 30.0)
    assert one.hold("mqtt", 30.0)
    assert not other.hold("mqtt", 30.0)
    assert other.hold("webhook-000000000000", 30.0)
    other.release("mqtt")  # not its own
    assert not other.hold("mqtt", 30.0)
    one.release("mqtt")
    assert other.hold("mqtt", 30.0)
    clock.ahead_s = 31.0
    assert one.hold("mqtt", 30.0)


def test_a_sink_that_a_clock_that_was_ahead_held_is_free(store: DetectionStore, clock: Clock) -> None:
    dead, alive = (DeliveryStore(store, holder=name * 32) for name in "da")
    clock.ahead_s = 3600.0
    assert dead.hold("mqtt", 30.0)
    clock.ahead_s = 3595.0  # as clocks of replicas differ
    assert not alive.hold("mqtt", 30.0)
    clock.ahead_s = 0.0
    assert alive.hold("mqtt", 30.0)


def test_deliveries_wait_in_order_until_they_are_noted(events: EventStore, deliveries: DeliveryStore) -> None:
    told = [event("start"), event("update", at=1), event("end", at=2)]
    events.add(told)
    waiting = deliveries.pending("mqtt", 9)
    assert [one.event for one in waiting] == told
    deliveries.note(waiting[0], "delivered", attempts=1, next_attempt_ns=0, error=None)
    deliveries.note(waiting[1], "dead", attempts=7, next_attempt_ns=0, error="x" * 5000)
    assert [one.event for one in deliveries.pending("mqtt", 9)] == told[2:]
    assert [one.event for one in deliveries.pending(SINKS[1], 9)] == told
    backlog = deliveries.backlog("mqtt")
    assert (backlog.pending, backlog.dead, backlog.oldest_event_id) == (1, 1, told[2].event_id)
    dead = deliveries.get(told[1].event_id, "mqtt")
    assert dead is not None
    assert (dead.state, dead.attempts, dead.last_error) == ("dead", 7, "x" * 300)
    assert deliveries.revive(dead)
    assert not deliveries.revive(dead)
    assert [(one.event, one.attempts) for one in deliveries.pending("mqtt", 9)] == [(told[1], 0), (told[2], 0)]
    assert deliveries.get("0" * 32, "mqtt") is None


def test_a_page_is_whole_though_a_delivery_is_noted_meanwhile(
    events: EventStore,
    deliveries: DeliveryStore,
    store: DetectionStore,
    empty_store_url: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told = [event("start"), event("update", at=1)]
    events.add(told)
    first, _ = deliveries.pending("mqtt", 9)
    other = DetectionStore(empty_store_url)
    noting = DeliveryStore(other, holder="b" * 32)
    begin = store.transaction

    @contextlib.contextmanager
    def noted_behind(*, writes: bool = False) -> Iterator[sa.Connection]:
        with begin(writes=writes) as connection:
            yield connection
        for sink in SINKS:
            noting.note(replace(first, sink=sink), "delivered", attempts=1, next_attempt_ns=0, error=None)

    monkeypatch.setattr(store, "transaction", noted_behind)
    found, more = deliveries.page("pending", 1, 0)
    assert ([(one.event, one.sink) for one in found], more) == ([(told[0], sink) for sink in SINKS], True)
    other.close()


def test_an_attempt_that_is_noted_late_changes_nothing(events: EventStore, deliveries: DeliveryStore) -> None:
    events.add([event("start"), event("end", at=1)])
    first, second = deliveries.pending("mqtt", 9)
    deliveries.note(first, "delivered", attempts=1, next_attempt_ns=0, error=None)
    deliveries.note(first, "dead", attempts=1, next_attempt_ns=0, error="late")
    deliveries.note(second, "pending", attempts=1, next_attempt_ns=5, error="first")
    deliveries.note(second, "pending", attempts=1, next_attempt_ns=9, error="late")
    found, _ = deliveries.page(None, 9, 0)
    assert [(one.state, one.last_error) for one in found if one.sink == "mqtt"] == [
        ("delivered", None),
        ("pending", "first"),
    ]


def test_what_is_open_is_as_the_sink_was_told(events: EventStore, deliveries: DeliveryStore) -> None:
    def tell(count: int) -> None:
        for one in deliveries.pending("mqtt", count):
            deliveries.note(one, "delivered", attempts=1, next_attempt_ns=0, error=None)

    events.add([event("start", "h-1"), event("start", "d-1", stream="door"), event("end", "h-1", at=1)])
    assert deliveries.open_things("mqtt") == {"hall": set(), "door": set()}
    tell(1)
    assert deliveries.open_things("mqtt") == {"hall": {"h-1"}, "door": set()}
    tell(2)
    assert deliveries.open_things("mqtt") == {"hall": set(), "door": {"d-1"}}
    events.add([event("end", "d-1", at=1, stream="door"), event("start", "d-1", at=2, stream="door")])
    assert deliveries.open_things("mqtt") == {"hall": set(), "door": {"d-1"}}


def test_what_is_open_is_known_beyond_the_newest_streams(
    events: EventStore, deliveries: DeliveryStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(delivery_store, "KNOWN_STREAMS", 1)
    events.add([event("start", "h-1")])
    for one in deliveries.pending("mqtt", 1):
        deliveries.note(one, "delivered", attempts=1, next_attempt_ns=0, error=None)
    events.add([event("end", "h-1", at=1), event("start", "d-1", stream="door"), event("start", "y-1", stream="yard")])
    assert deliveries.open_things("mqtt") == {"hall": {"h-1"}, "door": set(), "yard": set()}


def test_a_store_of_the_first_version_is_brought_up_to_date(empty_store_url: str) -> None:
    engine = make_engine(store_url(empty_store_url))
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    config.set_main_option("path_separator", "os")
    with engine.execution_options(writes=True).begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, "0001")
        connection.execute(sa.text("INSERT INTO store_probe (id, padding) VALUES (1, 'x')"))
    engine.dispose()
    opened = DetectionStore(empty_store_url)
    opened.open()
    events = EventStore(opened, sinks=(), holder="a", hold_s=1.0)
    events.add([event("start")])
    assert kinds(events) == ["start"]
    opened.close()


def test_a_reader_that_falls_behind_the_ring_is_told_of_the_gap() -> None:
    async def read() -> list[bytes]:
        log = MemoryLog(2)
        readers = LiveReaders(log, limit=1, closing=asyncio.Event(), metrics=EventMetrics(ServiceMetrics()))
        parts = readers.read(Place(0, gap=False), None)
        found = [await anext(parts)]
        log.took([event("start", "t-1")])
        found.append(await anext(parts))
        log.took([event("start", f"t-{number}") for number in range(2, 6)])
        found += [await anext(parts), await anext(parts)]
        await parts.aclose()
        return found

    retry, first, gap, rest = asyncio.run(read())
    assert retry.startswith(b"retry:")
    assert first.count(b"id: ") == 1
    assert gap.startswith(b"event: gap\ndata: ")
    assert [json.loads(line[6:])["thing_id"] for line in rest.splitlines() if line.startswith(b"data: ")] == [
        "t-4",
        "t-5",
    ]


def test_the_ring_ends_what_has_begun_once() -> None:
    async def tell() -> list[str]:
        log = MemoryLog(9)
        told = [event("start"), event("end", at=1), event("end", at=2), event("update", at=3)]
        assert log.took(told) == told[:2]
        found = await log.after(0, 9)
        assert found is not None
        return [one.event.kind for one in found]

    assert asyncio.run(tell()) == ["start", "end"]
