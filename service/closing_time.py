"""How long closing may take: one deadline for all parts, so that the process ends before it would be killed."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

CLOSE_SECONDS: Final = 12.0
"""For all parts together, behind the last request; see ``supervisor.KILL_AFTER_SECONDS``."""
KEPT_FROM_WORKERS: Final = 7.0
"""Of these, what workers that do not end leave to events, store and traces."""
KEPT_FROM_EVENTS: Final = 3.0
"""What events leave to store and traces."""
KEPT_FROM_STORE: Final = 1.0
"""What a store that hangs leaves to the last traces."""


class ClosingTime:
    """What is left of the time for closing. A part that needs little leaves its own to those behind it.

    Args:
        clock: seconds; anything that only grows.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._ends_at = 0.0

    def begin(self) -> None:
        """Closing begins now."""
        self._ends_at = self._clock() + CLOSE_SECONDS

    def left_s(self, *, kept_s: float = 0.0) -> float:
        """For the part whose turn it is; ``kept_s`` of the whole are for those behind it."""
        return max(0.0, self._ends_at - self._clock() - kept_s)
