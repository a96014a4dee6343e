"""The end of the service takes no longer than its supervisor waits, whatever hangs: one deadline for all parts."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest
from scripted_detector import ScriptedDetector

from viflow_anomaly_service import app as app_module
from viflow_anomaly_service.app import create_app
from viflow_anomaly_service.closing_time import CLOSE_SECONDS, ClosingTime
from viflow_anomaly_service.detector_pool import DetectorPool
from viflow_anomaly_service.events.attach import CLOSE_SECONDS as EVENT_SECONDS
from viflow_anomaly_service.events.attach import EventParts
from viflow_anomaly_service.metrics import ServiceMetrics
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.store.detection_store import DetectionStore
from viflow_anomaly_service.store.engine import STATEMENT_SECONDS
from viflow_anomaly_service.store.keeper import ResultKeeper
from viflow_anomaly_service.store.store_threads import StoreThreads
from viflow_anomaly_service.supervisor import KILL_AFTER_SECONDS
from viflow_anomaly_service.tracing import end_tracing

WAIT_S = 30.0


class Clock:
    """Stands still but for those who take their time."""

    def __init__(self) -> None:
        self.now = 100.0
        self.taken: dict[str, float] = {}

    def __call__(self) -> float:
        return self.now

    def take(self, what: str, seconds: float) -> None:
        self.taken[what] = seconds
        self.now += seconds


@pytest.fixture
def may_go() -> Iterator[threading.Event]:
    """Set at the end, so that nothing hangs on."""
    event = threading.Event()
    yield event
    event.set()


def closed_by(
    clock: Clock, stuck: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[dict[str, float], float]:
    """What each part was given by the clock, and what all took, where those that are ``stuck`` take all of it."""

    def spend(what: str, within_s: float) -> None:
        clock.take(what, within_s) if what in stuck else clock.taken.setdefault(what, within_s)

    async def close_events(self: EventParts, streams: Any, *, within_s: float) -> None:
        spend("events", min(within_s, EVENT_SECONDS))

    async def close_keeper(self: ResultKeeper, *, within_s: float) -> None:
        spend("store", within_s)

    async def end_traces(provider: Any, *, within_s: float) -> None:
        spend("traces", within_s)

    monkeypatch.setattr(app_module, "ClosingTime", lambda: ClosingTime(clock))
    monkeypatch.setattr(app_module, "configured_tracing", object)
    monkeypatch.setattr(app_module, "end_tracing", end_traces)
    monkeypatch.setattr(DetectorPool, "close", lambda self, within_s: spend("workers", within_s))
    monkeypatch.setattr(EventParts, "close", close_events)
    monkeypatch.setattr(ResultKeeper, "close", close_keeper)
    monkeypatch.setattr(ResultKeeper, "start", lambda self: None)
    monkeypatch.setattr(EventParts, "start", lambda self: None)
    monkeypatch.setattr(app_module.FastAPI, "add_middleware", lambda *args, **options: None)
    settings = ServiceSettings(store_url=str(tmp_path / "unused.db"), warm_up=())  # type: ignore[arg-type]
    app = create_app(settings, load_detector=lambda settings: cast("Any", ScriptedDetector()))

    async def live() -> None:
        async with app.router.lifespan_context(app):
            clock.now += 1e4  # the service runs: closing begins with its end

    began = clock.now + 1e4
    asyncio.run(live())
    return clock.taken, clock.now - began


ALL = ("workers", "events", "store", "traces")


def test_all_that_hangs_ends_within_the_supervisors_patience(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken, seconds = closed_by(Clock(), ALL, tmp_path, monkeypatch)
    assert seconds == pytest.approx(CLOSE_SECONDS)
    assert CLOSE_SECONDS + 2 < KILL_AFTER_SECONDS  # the interpreter ends, too
    assert taken == {part: pytest.approx(most) for part, most in zip(ALL, (5, 4, 2, 1), strict=True)}


def test_what_ends_at_once_leaves_its_time_to_a_slow_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken, _ = closed_by(Clock(), ("store",), tmp_path, monkeypatch)
    assert taken["store"] > STATEMENT_SECONDS  # a write that takes its time is waited for


def test_the_time_is_never_less_than_nothing() -> None:
    clock = Clock()
    time = ClosingTime(clock)
    time.begin()
    assert (time.left_s(), time.left_s(kept_s=2.0)) == (CLOSE_SECONDS, CLOSE_SECONDS - 2.0)
    clock.now += CLOSE_SECONDS + 1
    assert time.left_s() == 0.0


def test_a_store_that_hangs_is_left_behind(
    tmp_path: Path, may_go: threading.Event, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    hanging = threading.Event()

    def hang(self: DetectionStore) -> None:
        hanging.set()
        may_go.wait(WAIT_S)

    monkeypatch.setattr(DetectionStore, "probe", hang)

    async def live() -> None:
        store = DetectionStore(str(tmp_path / "hangs.db"))
        keeper = ResultKeeper(store, ServiceSettings(), ServiceMetrics())
        keeper.start()
        await asyncio.to_thread(hanging.wait, WAIT_S)
        async with asyncio.timeout(WAIT_S):
            await keeper.close(within_s=0.05)

    asyncio.run(live())
    assert "store_not_closed_in_time" in caplog.messages
    assert not may_go.is_set()


def test_traces_that_nobody_takes_are_left_behind(may_go: threading.Event, caplog: pytest.LogCaptureFixture) -> None:
    class Hanging:
        def shutdown(self) -> None:
            may_go.wait(WAIT_S)

    asyncio.run(end_tracing(cast("Any", Hanging()), within_s=0.05))
    assert caplog.messages == ["traces_not_sent_in_time"]


HANGING_PROCESS = """
import threading
from viflow_anomaly_service.store.store_threads import StoreThreads

begun = threading.Event()
threads = StoreThreads(1, "hangs")
threads.submit(lambda: (begun.set(), threading.Event().wait()))
begun.wait()
threads.shutdown(wait=False, cancel_futures=True)
"""


def test_a_process_ends_though_a_call_of_its_store_does_not() -> None:
    subprocess.run([sys.executable, "-c", HANGING_PROCESS], check=True, timeout=60)


def test_threads_of_a_store_do_what_an_executor_does(may_go: threading.Event) -> None:
    threads = StoreThreads(2, "works")
    assert threads.submit(lambda a, *, b: a + b, 1, b=2).result(WAIT_S) == 3
    with pytest.raises(ZeroDivisionError):
        threads.submit(lambda: 1 / 0).result(WAIT_S)
    both = threading.Barrier(3)
    at_work = [threads.submit(lambda: both.wait(WAIT_S) >= 0 and may_go.wait(WAIT_S)) for _ in range(2)]
    both.wait(WAIT_S)
    waiting = threads.submit(lambda: 0)
    threads.shutdown(wait=False, cancel_futures=True)
    assert waiting.cancelled()
    with pytest.raises(RuntimeError, match="takes no more calls"):
        threads.submit(lambda: 0)
    may_go.set()
    threads.shutdown()
    assert [one.result(0) for one in at_work] == [True, True]


def test_threads_finish_what_waits_unless_it_is_cancelled() -> None:
    threads = StoreThreads(1, "works")
    done = [threads.submit(lambda number=number: number) for number in range(5)]
    threads.shutdown()
    assert [one.result(0) for one in done] == list(range(5))
    StoreThreads(1, "idle").shutdown()
