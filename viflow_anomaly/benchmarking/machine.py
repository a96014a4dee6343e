"""What a reader of measured times must know: machine, commit, versions, and what else ran meanwhile."""

from __future__ import annotations

import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from viflow_anomaly.checkpoint_record import source_commit
from viflow_anomaly.evaluation.flow_report import cpu_model

PACKAGES = (
    "viflow-anomaly",
    "torch",
    "openvino",
    "onnxruntime",
    "numpy",
    "opencv-python-headless",
    "scikit-image",
)
QUIET_SHARE = 0.1
"""Other programs that take less of the cores than that hardly change a time."""
_STAT = Path("/proc/stat")
_BUSY_COLUMNS = (1, 2, 3, 6, 7, 8)
"""user, nice, system, irq, softirq and steal of a line in ``/proc/stat``."""


def usable_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def circumstances() -> dict[str, Any]:
    """Machine, commit, date and versions; plain JSON values."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": source_commit(),
        "uncommitted_changes": _uncommitted_changes(),
        "cpu": cpu_model(),
        "system": platform.platform(),
        "cores": usable_cores(),
        "load_1min": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        "versions": {name: found for name in PACKAGES if (found := _version(name)) is not None},
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _uncommitted_changes() -> bool | None:
    """Whether tracked files differ from the commit; None outside a git checkout."""
    command = ["git", "-C", str(Path(__file__).parent), "status", "--porcelain", "--untracked-files=no"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)  # noqa: S603
    except (OSError, subprocess.SubprocessError):
        return None
    return bool(answer.stdout.strip())


@dataclass
class Spent:
    """Of a block of code, once it has ended.

    Attributes:
        wall_s: on the clock.
        cpu_s: of this process and of its children that ended in the block.
        others_share: of the usable cores' time that went to other programs; None where the system does not say.
    """

    wall_s: float = 0.0
    cpu_s: float = 0.0
    others_share: float | None = None

    @property
    def undisturbed(self) -> bool:
        return self.others_share is not None and self.others_share < QUIET_SHARE


@contextmanager
def spending() -> Iterator[Spent]:
    """Measure a block."""
    spent = Spent()
    busy, own, started = _busy_s(), _own_cpu_s(), time.perf_counter()
    yield spent
    spent.wall_s = time.perf_counter() - started
    spent.cpu_s = _own_cpu_s() - own
    if busy is not None and (after := _busy_s()) is not None:
        others_s = max(0.0, after - busy - spent.cpu_s)
        spent.others_share = min(1.0, others_s / max(spent.wall_s * (os.cpu_count() or 1), 1e-9))


def _own_cpu_s() -> float:
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def _busy_s() -> float | None:
    """Seconds that all cores together were busy since the system started."""
    try:
        columns = _STAT.read_text(encoding="ascii").split("\n", 1)[0].split()
        return sum(int(columns[k]) for k in _BUSY_COLUMNS) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError):
        return None


def peak_memory_mib(pid: int | None = None) -> float:
    """The most that this process, or another one that still runs, ever held in memory.

    Linux's own count of the process: ``getrusage`` starts a new one with the peak of the one that it was forked from.
    Elsewhere that is what there is, of this process alone.
    """
    try:
        status = Path(f"/proc/{'self' if pid is None else pid}/status").read_text(encoding="ascii", errors="replace")
        return int(status.partition("VmHWM:")[2].split()[0]) / 1024
    except (OSError, ValueError, IndexError):
        if pid is not None:
            return 0.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024**2 if sys.platform == "darwin" else 1024)
