"""How many requests may be inside, and how many of them may compute, at once."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from viflow_anomaly_service.problems import Problem


class AdmissionGate:
    """Bounds memory (a request's body is read only once it is admitted) and the computing threads.

    Args:
        max_concurrent: requests that compute at once.
        max_queued: further requests that may upload or wait for their turn.
        queue_timeout_s: longest wait for a turn.

    Attributes:
        present: requests inside, computing or not.
    """

    def __init__(self, *, max_concurrent: int, max_queued: int, queue_timeout_s: float) -> None:
        self._capacity = max_concurrent + max_queued
        self.present = 0
        self._turns = asyncio.Semaphore(max_concurrent)
        self._queue_timeout_s = queue_timeout_s

    @asynccontextmanager
    async def admitted(self) -> AsyncIterator[None]:
        """Hold one of the places.

        Raises:
            Problem: 503 ``overloaded``.
        """
        if self.present >= self._capacity:
            raise _overloaded(f"all {self._capacity} places are taken")
        self.present += 1
        try:
            yield
        finally:
            self.present -= 1

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """Wait for a computing thread and hold it; first come, first served.

        Raises:
            Problem: 503 ``overloaded`` after the longest wait.
        """
        try:
            async with asyncio.timeout(self._queue_timeout_s):
                await self._turns.acquire()
        except TimeoutError as err:
            raise _overloaded(f"no turn came within {self._queue_timeout_s:g} s") from err
        try:
            yield
        finally:
            self._turns.release()


def _overloaded(found: str) -> Problem:
    return Problem(503, code="overloaded", detail=f"The service is busy: {found}.", retry_after_s=1)
