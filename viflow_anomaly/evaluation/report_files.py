"""A report as two files: JSON for programs, Markdown for people."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from viflow_anomaly.checkpoint_record import write_atomically


def write_report(stem: Path, report: Mapping[str, Any], text: str) -> None:
    """Write ``stem.json`` and ``stem.md``, each as a whole or not at all."""
    write_atomically(stem.with_suffix(".json"), (json.dumps(report, indent=2) + "\n").encode())
    write_atomically(stem.with_suffix(".md"), text.encode())
