"""The loops behind events outlive a fault of ours, and the end of the service waits for nothing that hangs."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any, cast

import pytest
from event_stream import reading
from scripted_detector import ScriptedDetector
from service_world import live_server, wait_until

from viflow_anomaly_service.admission import AdmissionGate
from viflow_anomaly_service.app import create_app
from viflow_anomaly_service.events import attach
from viflow_anomaly_service.events.attach import EventParts, StoredEvents
from viflow_anomaly_service.events.desk import EventDesk
from viflow_anomaly_service.events.event_record import EventRecord
from viflow_anomaly_service.events.event_rules import EventRules
from viflow_anomaly_service.events.log import EventLog, MemoryLog
from viflow_anomaly_service.events.metrics import EventMetrics
from viflow_anomaly_service.events.store_log import StoreLog
from viflow_anomaly_service.metrics import ServiceMetrics
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.store.keeper import ResultKeeper
from viflow_anomaly_service.store.record import IdMaker
from viflow_anomaly_service.streams.table import LiveStream, StreamTable

RULES = EventRules(start_score=0.5, start_pairs=2, end_score=0.3, end_s=1.0, update_s=1.0, cooldown_s=0.0)


class FaultError(Exception):
    """One that nobody expects."""


class Hanging:
    """A log and a courier of a database that does not answer."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    async def end(self, *values: Any) -> None:
        await self._hang("end")

    async def settle(self) -> None:
        await self._hang("settle")

    async def release(self) -> None:
        await self._hang("release")

    async def _hang(self, what: str) -> None:
        self.asked.append(what)
        await asyncio.Event().wait()


def begun_stream() -> LiveStream:
    return LiveStream("hall", begun=cast("Any", object()))


def parts(log: EventLog, couriers: list[Any]) -> EventParts:
    metrics = EventMetrics(ServiceMetrics())
    stored = StoredEvents(cast("Any", None), cast("Any", None), cast("Any", None), couriers)
    return EventParts(EventDesk(RULES, log, metrics), cast("Any", None), metrics, None, stored)


def test_a_database_that_hangs_does_not_hold_up_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    for number, name in enumerate(("ENDS_SECONDS", "TOLD_SECONDS", "CLOSE_SECONDS"), start=1):
        monkeypatch.setattr(attach, name, number / 10)
    hanging = Hanging()

    async def close() -> None:
        async with asyncio.timeout(30):
            await parts(cast("Any", hanging), [hanging]).close([begun_stream()], within_s=30.0)

    asyncio.run(close())
    assert hanging.asked == ["end", "settle", "release"]


def test_there_is_time_for_each_part_of_the_end() -> None:
    assert 0 < attach.ENDS_SECONDS < attach.TOLD_SECONDS < attach.CLOSE_SECONDS <= 4


def test_ends_that_fail_keep_nothing_else_from_being_closed() -> None:
    class Failing(MemoryLog):
        async def end(self, *values: Any) -> list[EventRecord]:
            raise FaultError

    hanging = Hanging()

    async def close() -> None:
        released = asyncio.create_task(parts(Failing(9), [hanging]).close([begun_stream()], within_s=30.0))
        while not hanging.asked and not released.done():
            await asyncio.sleep(0)
        released.cancel()
        await asyncio.gather(released, return_exceptions=True)

    asyncio.run(close())
    assert hanging.asked == ["settle"]


def test_the_store_is_closed_though_events_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[str] = []
    close_keeper = ResultKeeper.close

    async def fail(self: EventParts, streams: Any, *, within_s: float) -> None:
        raise FaultError

    async def close(self: ResultKeeper, *, within_s: float) -> None:
        await close_keeper(self, within_s=within_s)
        closed.append("store")

    monkeypatch.setattr(EventParts, "close", fail)
    monkeypatch.setattr(ResultKeeper, "close", close)
    settings = ServiceSettings(store_url=str(tmp_path / "events.db"), warm_up=())  # type: ignore[arg-type]
    app = create_app(settings, load_detector=lambda settings: cast("Any", ScriptedDetector()))

    async def live() -> None:
        async with app.router.lifespan_context(app):
            pass

    with pytest.raises(FaultError):
        asyncio.run(live())
    assert closed == ["store"]


def test_looking_for_events_of_others_outlives_a_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    look, faults = StoreLog.look, [FaultError()]

    async def look_or_fail(self: StoreLog) -> None:
        if faults:
            raise faults.pop()
        await look(self)

    monkeypatch.setattr(attach, "LOOK_SECONDS", 0.01)
    monkeypatch.setattr(StoreLog, "look", look_or_fail)
    with (
        live_server(lambda settings: ScriptedDetector(), store_url=str(tmp_path / "events.db")) as server,
        reading(f"http://127.0.0.1:{server.port}") as stream,
    ):
        wait_until(lambda: not faults)
        event_id = IdMaker()()
        told = EventRecord(event_id, "t-1", "start", "hall", 0, json.dumps({"event_id": event_id}))
        server.app.state.core.events.stored.events.add([told])  # by another process
        wait_until(lambda: stream.ids == [event_id])


def test_forgetting_idle_streams_outlives_a_fault() -> None:
    forgotten: list[str] = []
    settings, metrics = ServiceSettings(stream_idle_s=0.02), ServiceMetrics()

    def forget(stream: LiveStream, reason: str) -> None:
        forgotten.append(stream.stream_id)
        if len(forgotten) == 1:
            raise FaultError

    async def watch() -> None:
        table = StreamTable(settings, AdmissionGate(places=9, metrics=metrics), metrics, on_forget=forget)
        for name in ("hall", "door"):
            async with table.turn(name) as stream:
                stream.begun = cast("Any", object())
        watching = asyncio.create_task(table.watch())
        async with asyncio.timeout(30):
            while len(forgotten) < 2 and not watching.done():
                await asyncio.sleep(0.01)
        watching.cancel()

    asyncio.run(watch())
    assert forgotten == ["hall", "door"]
