"""Whether the wall clock may be believed when it says that a detection is old enough to be deleted."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Final

logger = logging.getLogger(__name__)

JUMP_SECONDS: Final = 60.0
DOUBT_SECONDS: Final = 3600.0


def seconds_since_boot() -> float:
    """Seconds, those in which the machine slept included; no setting of the clock changes them."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic()


class AgeClock:
    """A clock that was set forward makes everything look old; it is believed once it has stayed for an hour.

    Args:
        wall, steady: seconds; the first may jump, the second may not.
    """

    def __init__(self, wall: Callable[[], float], steady: Callable[[], float]) -> None:
        self._wall = wall
        self._steady = steady
        self._difference = wall() - steady()
        self._doubted_until = steady()

    def is_believed(self) -> bool:
        """Looked at now and then: a jump is found by the first look behind it."""
        now = self._steady()
        difference = self._wall() - now
        jumped_s = difference - self._difference
        self._difference = difference
        if abs(jumped_s) > JUMP_SECONDS:
            logger.warning("clock_jumped", extra={"seconds": round(jumped_s, 1)})
            self._doubted_until = now + DOUBT_SECONDS
        return now >= self._doubted_until
