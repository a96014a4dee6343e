"""What a reader needs to judge a result: commit, machine, date."""

from __future__ import annotations

import os
import platform
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from viflow_anomaly.checkpoint_record import source_commit


def cpu_model() -> str:
    """The processor's name where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()


def circumstances() -> dict[str, Any]:
    """Commit, machine and date."""
    return {
        "commit": source_commit(),
        "machine": {"cpu": cpu_model(), "cores": os.cpu_count()},
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }
