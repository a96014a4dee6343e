"""When the stages of a request began and ended: written by who does the work, read by who makes spans of them."""

from __future__ import annotations

import time
from collections.abc import MutableMapping
from typing import Any, NamedTuple, Self


class StageTime(NamedTuple):
    """Unix time in nanoseconds."""

    name: str
    started_ns: int
    ended_ns: int

    @classmethod
    def until_now(cls, name: str, seconds: float) -> Self:
        now_ns = time.time_ns()
        return cls(name, now_ns - round(seconds * 1e9), now_ns)


def stage_times(scope: MutableMapping[str, Any]) -> list[StageTime]:
    """Of one request, in the order of their ends."""
    times: list[StageTime] = scope.setdefault("viflow_stage_times", [])
    return times
