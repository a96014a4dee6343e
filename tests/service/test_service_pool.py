"""The worker threads: order, deadlines, work that nobody waits for any more, ends."""

from __future__ import annotations

import asyncio
import gc
import threading
from collections.abc import Callable

import pytest
from service_world import wait_until

from viflow_anomaly_service.detector_pool import AbandonedError, DeadlinePassedError, DetectorPool, Job
from viflow_anomaly_service.metrics import ServiceMetrics

WAIT_S = 20.0


class Hall:
    """A pool, and work that waits inside until it is told to go on."""

    def __init__(self, workers: int = 1) -> None:
        self.metrics = ServiceMetrics()
        self.pool = DetectorPool(workers=workers, metrics=self.metrics)
        self.may_go = threading.Event()
        self.begun: list[int] = []
        self.seen_abandoned: list[int] = []

    def work(self, number: int) -> Callable[[Job[int]], int]:
        def run(job: Job[int]) -> int:
            self.begun.append(number)
            self.may_go.wait(WAIT_S)
            try:
                job.require_wanted()
            except AbandonedError:
                self.seen_abandoned.append(number)
                raise
            return number

        return run

    async def submit(self, number: int, *, within_s: float = WAIT_S) -> asyncio.Task[int]:
        task = asyncio.create_task(self.pool.run(self.work(number), within_s=within_s))
        await asyncio.sleep(0)
        return task

    def depth(self) -> float:
        return sum(sample.value for metric in self.metrics.queue_depth.collect() for sample in metric.samples)


def in_hall(scene: Callable[[Hall], object], *, workers: int = 1) -> Hall:
    hall = Hall(workers)
    hall.pool.start()
    try:
        asyncio.run(scene(hall))  # type: ignore[arg-type]
    finally:
        hall.may_go.set()
        hall.pool.close(WAIT_S)
    return hall


async def reached(condition: Callable[[], bool]) -> None:
    await asyncio.to_thread(wait_until, condition)


def test_first_come_first_served() -> None:
    async def scene(hall: Hall) -> None:
        tasks = [await hall.submit(number) for number in range(6)]
        await reached(lambda: hall.begun == [0])
        assert hall.depth() == 5
        hall.may_go.set()
        assert await asyncio.gather(*tasks) == list(range(6))

    hall = in_hall(scene)
    assert hall.begun == list(range(6))
    assert hall.depth() == 0


def test_workers_work_side_by_side() -> None:
    async def scene(hall: Hall) -> None:
        tasks = [await hall.submit(number) for number in range(3)]
        await reached(lambda: len(hall.begun) == 3)
        hall.may_go.set()
        assert await asyncio.gather(*tasks) == [0, 1, 2]

    in_hall(scene, workers=3)


def test_work_whose_deadline_passes_is_not_begun_and_running_work_is_not_cut_short() -> None:
    async def scene(hall: Hall) -> None:
        first = await hall.submit(0, within_s=0.05)
        await reached(lambda: hall.begun == [0])
        second = await hall.submit(1, within_s=0.05)
        with pytest.raises(DeadlinePassedError):
            await second
        assert hall.depth() == 0
        hall.may_go.set()
        assert await first == 0

    assert in_hall(scene).begun == [0]


def test_work_of_those_who_left_is_dropped() -> None:
    async def scene(hall: Hall) -> None:
        running, waiting = [await hall.submit(number) for number in range(2)]
        await reached(lambda: hall.begun == [0])
        for task in (running, waiting):
            task.cancel()
        for task in (running, waiting):
            with pytest.raises(asyncio.CancelledError):
                await task
        assert hall.depth() == 0
        hall.may_go.set()
        assert await (await hall.submit(2)) == 2

    hall = in_hall(scene)
    assert hall.begun == [0, 2]
    assert hall.seen_abandoned == [0]


def test_errors_reach_who_waits_and_the_worker_lives_on() -> None:
    async def scene(hall: Hall) -> None:
        def failing(job: Job[int]) -> int:
            raise MemoryError("no room")

        with pytest.raises(MemoryError, match="no room"):
            await hall.pool.run(failing, within_s=WAIT_S)
        hall.may_go.set()
        assert await hall.pool.run(hall.work(7), within_s=WAIT_S) == 7

    in_hall(scene)


def test_an_error_after_its_client_left_is_nobodys(caplog: pytest.LogCaptureFixture) -> None:
    async def scene(hall: Hall) -> None:
        def failing(job: Job[int]) -> int:
            hall.begun.append(0)
            hall.may_go.wait(WAIT_S)
            raise ValueError("too late")

        task = asyncio.create_task(hall.pool.run(failing, within_s=WAIT_S))
        await reached(lambda: hall.begun == [0])
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        hall.may_go.set()
        assert await hall.pool.run(hall.work(1), within_s=WAIT_S) == 1
        gc.collect()

    in_hall(scene)
    assert caplog.messages == []


def test_a_loop_that_has_ended_does_not_end_the_worker() -> None:
    async def leave(hall: Hall) -> None:
        await hall.submit(0)
        await reached(lambda: hall.begun == [0])

    async def stay(hall: Hall) -> None:
        assert await hall.pool.run(hall.work(1), within_s=WAIT_S) == 1

    hall = Hall()
    hall.pool.start()
    asyncio.run(leave(hall))
    hall.may_go.set()
    asyncio.run(stay(hall))
    hall.pool.close(WAIT_S)


def test_closing_says_which_worker_is_stuck(caplog: pytest.LogCaptureFixture) -> None:
    async def scene(hall: Hall) -> None:
        await hall.submit(0)
        await reached(lambda: hall.begun == [0])
        hall.pool.close(0.05)

    in_hall(scene)
    assert "workers_still_busy" in caplog.messages
