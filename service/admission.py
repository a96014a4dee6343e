"""How many requests may be inside at once, and how they leave when the service ends."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import TypeVar

from viflow_anomaly_service.detector_pool import DeadlinePassedError, DetectorPool, Job
from viflow_anomaly_service.metrics import ServiceMetrics, ShedReason
from viflow_anomaly_service.problems import Problem

Result = TypeVar("Result")


class AdmissionGate:
    """Bounds memory: a request's body is read only once it is admitted.

    Args:
        places: requests inside at once: uploading, waiting for a worker or being judged.
        metrics: told of who is inside and who was refused.

    Attributes:
        present: requests inside.
        closing: set when nobody is admitted any more; for those who would else go on for ever.
    """

    def __init__(self, *, places: int, metrics: ServiceMetrics) -> None:
        self._places = places
        self._metrics = metrics
        self._limits: set[asyncio.Timeout] = set()
        self.closing = asyncio.Event()

    @property
    def closed(self) -> bool:
        return self.closing.is_set()

    @property
    def present(self) -> int:
        return len(self._limits)

    @asynccontextmanager
    async def admitted(self, *, looking_on: bool = False) -> AsyncIterator[None]:
        """Hold one of the places.

        Args:
            looking_on: for a picture or an inspection: only while less than half of the places are taken, so that
                the others are always there for detections.

        Raises:
            Problem: 503 ``overloaded``; ``shutting_down``, also for a request inside when its time has run out.
        """
        self.require_open()
        if len(self._limits) >= self._places:
            raise self.shed("queue_full", f"all {self._places} places are taken")
        if looking_on and len(self._limits) >= max(1, self._places // 2):
            raise self.shed("queue_full", f"half of the {self._places} places are taken, the others are for detections")
        try:
            async with asyncio.timeout(None) as limit:
                self._limits.add(limit)
                self._metrics.in_flight.inc()
                try:
                    yield
                finally:
                    self._limits.remove(limit)
                    self._metrics.in_flight.dec()
        except TimeoutError as err:  # only ours: a request's own limits have become problems further in
            raise self._ending() from err

    async def in_turn(self, pool: DetectorPool, work: Callable[[Job[Result]], Result], *, patience_s: float) -> Result:
        """The result of the work of one who is inside, from a worker's thread.

        Raises:
            Problem: 503 ``overloaded``: no worker came in time; the work will not be done.
        """
        try:
            return await pool.run(work, within_s=patience_s)
        except DeadlinePassedError as err:
            raise self.no_turn(patience_s) from err

    def require_open(self) -> None:
        """Nothing, unless the service is ending.

        Raises:
            Problem: 503 ``shutting_down``.
        """
        if self.closing.is_set():
            raise self._ending()

    def close(self) -> None:
        """Admit nobody any more; who is inside goes on."""
        self.closing.set()

    def expel(self) -> None:
        """Whoever is still inside is refused now: an answer, where the end of the process would be none."""
        now = asyncio.get_running_loop().time()
        for limit in self._limits:
            limit.reschedule(now)

    def shed(self, reason: ShedReason, found: str) -> Problem:
        """Count a refusal and say it."""
        self._metrics.shed.labels(reason).inc()
        return Problem(503, code="overloaded", detail=f"The service is busy: {found}.", retry_after_s=1)

    def no_turn(self, patience_s: float) -> Problem:
        """Count a wait that was too long and say it."""
        return self.shed("deadline", f"no turn came within {patience_s:g} s")

    def _ending(self) -> Problem:
        self._metrics.shed.labels("shutting_down").inc()
        return Problem(503, code="shutting_down", detail="The service is being shut down.", retry_after_s=1)
