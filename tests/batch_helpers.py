"""Detectors that helper processes of a batch run make for themselves, and how one of them may end."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from difference_detector import DifferenceDetector
from turning_detector import TurningDetector

from viflow_anomaly.sensor_data import FramePair


def turning() -> TurningDetector:
    return TurningDetector()


def difference(folder: Path | None = None) -> DifferenceDetector:
    """Leaves a file named after its process in ``folder`` for every pair."""

    def note(pair: FramePair) -> None:
        if folder is not None:
            (folder / f"{os.getpid()}-{pair.source.timestamp_ns}").touch()

    return DifferenceDetector(on_pair=note)


def killed() -> DifferenceDetector:
    """As by a kernel that is out of memory."""

    def die(pair: FramePair) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    return DifferenceDetector(on_pair=die)


def raising() -> DifferenceDetector:
    raise MemoryError("no room for a second network")


def slow(pid_file: Path) -> DifferenceDetector:
    """Says who it is, and takes its time."""
    pid_file.write_text(str(os.getpid()))
    return DifferenceDetector(on_pair=lambda pair: time.sleep(0.05))
