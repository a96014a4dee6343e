"""A run's figures as data: what the JSON holds, and what every table is made from."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from viflow_anomaly.checkpoint_record import source_commit
from viflow_anomaly.evaluation.flow_methods import MethodAbout
from viflow_anomaly.evaluation.flow_run import ByMethod, FlowMeasurement
from viflow_anomaly.evaluation.flow_statistics import COARSE_BINS, FINE_BIN_PX, FINE_END_PX, GROWTH
from viflow_anomaly.evaluation.paper_table import PAPER_TABLE

ALL = "all"
Report = dict[str, Any]


def flow_report(
    measurement: FlowMeasurement,
    *,
    threads: int,
    left_out: Sequence[str] = (),
    options: Mapping[str, Any] | None = None,
) -> Report:
    """The report of a run, ready for JSON.

    ``all``, each of ``groups`` and each of ``sequences`` hold the figures of every method
    (``FlowStatistics.summary``) by its name.

    Args:
        measurement: what was found.
        threads: that the methods ran with.
        left_out: default baselines that this build of OpenCV lacks.
        options: of the run (look-aheads, crop, correction), as they are to be stated.
    """
    return {
        **circumstances(),
        "threads": threads,
        "options": dict(options or {}),
        "median_resolution": {
            "px": FINE_BIN_PX,
            "up_to_px": FINE_END_PX,
            "relative_beyond": round(GROWTH - 1, 6),
            "last_px": round(FINE_END_PX * GROWTH**COARSE_BINS),
        },
        "methods": {about.name: _about(about) for about in measurement.methods},
        "left_out": list(left_out),
        "skipped_pairs": dict(measurement.skipped),
        ALL: _figures(measurement.total()),
        "groups": {name: _figures(some) for name, some in measurement.groups().items()},
        "sequences": {name: _figures(some) for name, some in sorted(measurement.sequences.items())},
        "paper": paper_figures(),
    }


def scopes(report: Report) -> dict[str, dict[str, Any]]:
    """The figures of all groups and of everything; a single group is everything."""
    groups: dict[str, dict[str, Any]] = report["groups"]
    return dict(groups) if len(groups) == 1 else {**groups, ALL: report[ALL]}


def circumstances() -> dict[str, Any]:
    """Commit, machine and date of a measurement."""
    return {
        "commit": source_commit(),
        "machine": {"cpu": cpu_model(), "cores": os.cpu_count()},
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def cpu_model() -> str:
    """The processor's name, as well as the system says it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()


def paper_figures() -> dict[str, Any]:
    """The paper's table, labelled as what it is."""
    rows = []
    for row in PAPER_TABLE:
        errors = {name: one._asdict() for name, one in (("kitti", row.kitti), ("euroc", row.euroc))}
        rows.append({"algorithm": row.algorithm, "hypotheses": row.hypotheses, "runtime_ms": row.runtime_ms, **errors})
    return {"source": "the paper's Table I: its authors' data (224x224 px crops), machine and runs", "rows": rows}


def _about(about: MethodAbout) -> dict[str, Any]:
    return {
        "kind": about.kind,
        "preset": about.preset,
        "inputs": about.inputs,
        "hypotheses": about.hypotheses,
        "corrected": about.corrected,
        **about.details,
    }


def _figures(by_method: ByMethod) -> dict[str, Any]:
    return {name: statistics.summary() for name, statistics in by_method.items()}
