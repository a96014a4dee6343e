"""How long the stages of a call take: told to metrics, to the request's log line, and to who makes spans of them."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Iterator, MutableMapping
from contextlib import contextmanager
from typing import Any, NamedTuple, Self, TypeVar

from viflow_anomaly_service.metrics import ServiceMetrics, Stage
from viflow_anomaly_service.request_log import log_fields

Result = TypeVar("Result")


class StageTime(NamedTuple):
    """Unix time in nanoseconds."""

    name: str
    started_ns: int
    ended_ns: int

    @classmethod
    def until_now(cls, name: str, seconds: float) -> Self:
        now_ns = time.time_ns()
        return cls(name, now_ns - round(seconds * 1e9), now_ns)


class StageClock:
    """Measures the stages of one call, some on the event loop, some in a worker's thread, one after the other.

    Args:
        metrics: told of every stage when it ends.

    Attributes:
        log: what the log line says of the call: milliseconds by stage, and what else is put into it.
    """

    def __init__(self, metrics: ServiceMetrics) -> None:
        self._metrics = metrics
        self._times: list[StageTime] = []
        self.log: dict[str, Any] = {}

    @contextmanager
    def stage(self, stage: Stage) -> Iterator[None]:
        """Measures the block, also one that raises."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.note(stage, time.perf_counter() - started)

    async def awaited(self, stage: Stage, work: Awaitable[Result]) -> Result:
        """The result of ``work``; what raises is not counted: a client was late, or the store is out of order."""
        started = time.perf_counter()
        result = await work
        self.note(stage, time.perf_counter() - started)
        return result

    def note(self, stage: Stage, seconds: float) -> None:
        """A stage that ends now."""
        self._metrics.observe_stage(stage, seconds)
        self.log[f"{stage}_ms"] = round(seconds * 1e3, 3)
        self._times.append(StageTime.until_now(stage, seconds))

    @contextmanager
    def told_to(self, scope: MutableMapping[str, Any]) -> Iterator[None]:
        """The request's log line and spans hear at the block's end of what is over then, however it ends."""
        try:
            yield
        finally:
            stage_times(scope).extend(self._times)
            log_fields(scope).update(self.log)


def stage_times(scope: MutableMapping[str, Any]) -> list[StageTime]:
    """Of one request, in the order of their ends."""
    times: list[StageTime] = scope.setdefault("viflow_stage_times", [])
    return times
