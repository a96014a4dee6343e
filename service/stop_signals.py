"""SIGINT and SIGTERM as a wish, from the first moment of a serving process to its last."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any, Final

STOP_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)


class StopSignals:
    """Notes that the process is to end, and tells the server once there is one.

    uvicorn, once it has ended well, raises a signal again for whoever handled it before: with this handler that does
    nothing, so that the process's status is its own and not the signal's.

    Attributes:
        requested: the process is to end.
    """

    def __init__(self) -> None:
        self.requested = False
        self._server: Any = None
        self._before: dict[signal.Signals, Any] = {}

    def install(self) -> None:
        """Handle the signals from now on; nothing outside the main thread, where Python handles none."""
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._stop) for number in STOP_SIGNALS}

    def restore(self) -> None:
        """The handlers that were there before."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def tell(self, server: Any) -> None:
        """Set ``server.should_exit`` when a signal comes, or now if one has come."""
        self._server = server
        server.should_exit = self.requested

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        if self._server is not None:
            self._server.should_exit = True
