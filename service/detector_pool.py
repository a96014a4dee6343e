"""The threads that judge pairs, and the line of requests in front of them.

A worker takes one request at a time. Several pairs in one network call gain nothing on a CPU
(benchmarks/service_batching.py: the small network a few tenths of a millisecond, the evidence head loses), so nothing
waits for company. On a device where a batch pays, ``_take`` is the place that hands out several.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Final, Generic, TypeVar

from viflow_anomaly_service.metrics import ServiceMetrics

logger = logging.getLogger(__name__)

Result = TypeVar("Result")
MEET_SECONDS: Final = 60.0


class DeadlinePassedError(Exception):
    """No worker came in time; the work was not begun."""


class AbandonedError(Exception):
    """Nobody waits for the result any more: raised inside the work, and seen by nobody."""


class Job(Generic[Result]):
    """Work on its way from the event loop to a worker and back.

    Attributes:
        done: the result, on the event loop.
        abandoned: nobody waits for it any more; set by the event loop, looked at by the worker.
    """

    def __init__(self, work: Callable[[Job[Result]], Result]) -> None:
        self._work = work
        self._loop = asyncio.get_running_loop()
        self._entered = time.perf_counter()
        self.done: asyncio.Future[Result] = self._loop.create_future()
        self.abandoned = False
        self.waited_s = 0.0

    def require_wanted(self) -> None:
        """Called by the work between its steps.

        Raises:
            AbandonedError: the rest would be for nobody.
        """
        if self.abandoned:
            raise AbandonedError

    def run(self) -> None:
        """In a worker's thread; whatever the work raises goes to whoever awaits ``done``."""
        self.waited_s = time.perf_counter() - self._entered
        try:
            result = self._work(self)
        except AbandonedError:
            return
        except BaseException as err:  # a worker that ended with its work would be missed by all later requests
            self._deliver(self._fail, err)
        else:
            self._deliver(self._succeed, result)

    def _deliver(self, action: Callable[[Any], None], value: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has been closed: nobody waits
            self._loop.call_soon_threadsafe(action, value)

    def _succeed(self, result: Result) -> None:
        if not self.done.done():
            self.done.set_result(result)

    def _fail(self, err: BaseException) -> None:
        if not self.done.done():
            self.done.set_exception(err)


class DetectorPool:
    """A fixed number of worker threads, first come, first served.

    How many may wait is bounded by who lets them in (``AdmissionGate``).

    Args:
        workers: threads.
        metrics: told of the line's length and of the workers at work.
    """

    def __init__(self, *, workers: int, metrics: ServiceMetrics) -> None:
        self._metrics = metrics
        self._line: deque[Job[Any]] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._threads = [
            threading.Thread(target=self._serve, name=f"detect-{number}", daemon=True) for number in range(workers)
        ]

    def start(self) -> None:
        """Once, in the process that serves: threads do not outlive a fork."""
        self._metrics.workers.set(len(self._threads))
        for thread in self._threads:
            thread.start()

    async def run(self, work: Callable[[Job[Result]], Result], *, within_s: float) -> Result:
        """The result of ``work``, which is called in a worker's thread with its own job.

        Cancelled while it waits, the work leaves the line; cancelled while it runs, it is told by
        ``Job.require_wanted``.

        Args:
            within_s: longest wait for a worker.

        Raises:
            DeadlinePassedError: none came; the work will not be done.
        """
        job = Job(work)
        self._enter(job)
        try:
            await asyncio.wait({job.done}, timeout=within_s)
            if not job.done.done() and self._withdraw(job):
                raise DeadlinePassedError
            return await job.done
        finally:
            job.abandoned = True
            job.done.cancel()  # an error that comes now is nobody's, not even the loop's to complain of
            self._withdraw(job)

    async def run_everywhere(self, work: Callable[[], None]) -> None:
        """Call ``work`` once in every worker's thread, at the same time; who is in the line waits meanwhile.

        One such call at a time: two would wait for each other.
        """
        together = threading.Barrier(len(self._threads))

        def meet(job: Job[None]) -> None:
            together.wait(MEET_SECONDS)
            work()

        try:
            await asyncio.gather(*(self.run(meet, within_s=MEET_SECONDS) for _ in self._threads))
        finally:
            together.abort()  # whoever waits for one that will not come

    def close(self, within_s: float) -> None:
        """Let the workers finish what they do, and wait for them, but not longer."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        deadline = time.monotonic() + within_s
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))
        if stuck := [thread.name for thread in self._threads if thread.is_alive()]:
            logger.error("workers_still_busy", extra={"threads": stuck})

    def _enter(self, job: Job[Any]) -> None:
        with self._changed:
            self._line.append(job)
            self._metrics.queue_depth.inc()
            self._changed.notify()

    def _withdraw(self, job: Job[Any]) -> bool:
        """Take a job out of the line; False: a worker has it, or had."""
        with self._changed:
            try:
                self._line.remove(job)
            except ValueError:
                return False
            self._metrics.queue_depth.dec()
            return True

    def _take(self) -> Job[Any] | None:
        """The next job, as soon as there is one; None: the pool was closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._line or self._closed)
            if not self._line:
                return None
            self._metrics.queue_depth.dec()
            return self._line.popleft()

    def _serve(self) -> None:
        while (job := self._take()) is not None:
            with self._metrics.workers_busy.track_inprogress():
                job.run()
            del job  # its body and its answer, which would else be kept until the next one comes
