"""Runtime x preset x size x threads beside the other methods, as rows of plain values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import cv2

from viflow_anomaly.benchmarking.made_scene import make_pair
from viflow_anomaly.benchmarking.measuring import in_own_process, peak_of, take_turns
from viflow_anomaly.benchmarking.subjects import HOMOGRAPHY, YARDSTICK, Run, Subject, choose_subjects, load_subject
from viflow_anomaly.config import RuntimeName
from viflow_anomaly.errors import ConfigError, InvalidInputError
from viflow_anomaly.sensor_data import FramePair

Size = tuple[int, int]
OnStep = Callable[[str], None]
"""Told what is measured next."""


@dataclass(frozen=True)
class Plan:
    """What is compared.

    Attributes:
        sizes: (width, height) each.
        threads: numbers of them.
        runtimes: of the bundled model; ``required`` ones must be there.
        presets: of ``subjects.PRESETS``.
        repeats: of each subject.
        budget_s: seconds after which a subject is not repeated any more.
        memory: also the peak of each subject, in a process of its own.
    """

    sizes: Sequence[Size]
    threads: Sequence[int]
    runtimes: Sequence[RuntimeName]
    required: bool
    presets: Sequence[str]
    repeats: int
    budget_s: float
    memory: bool


@dataclass(frozen=True)
class Comparison:
    """Rows in the order of the plan, and why some are missing."""

    rows: list[dict[str, Any]]
    skipped: list[str]


def compare(plan: Plan, on_step: OnStep) -> Comparison:
    """Measure all of it; each size and number of threads is a round in which all subjects take turns.

    Raises:
        ConfigError: ``runtime_unavailable`` for one that is required.
    """
    rows: list[dict[str, Any]] = []
    skipped: dict[str, None] = {}
    threads_before = cv2.getNumThreads()
    try:
        for threads in plan.threads:
            cv2.setNumThreads(threads)
            runs = _load(plan, threads, skipped)
            for width, height in plan.sizes:
                on_step(f"{width}x{height} px, {threads} thread{'s' if threads > 1 else ''}")
                able = _able(runs, make_pair(width, height), skipped)
                rows += _round(plan, able, width, height, threads)
    finally:
        cv2.setNumThreads(threads_before)
    if plan.memory:
        for row in rows:
            on_step(
                f"memory of {row['method']} ({row['runtime']}, {row['preset']}) at {row['width']}x{row['height']} px"
            )
            subject = Subject(row["method"], row["runtime"], row["preset"], row["evidence"])
            row["peak_mib"] = in_own_process(peak_of, subject, row["width"], row["height"], row["threads"])
    return Comparison(rows, list(skipped))


def _load(plan: Plan, threads: int, skipped: dict[str, None]) -> dict[Subject, Run]:
    runs: dict[Subject, Run] = {}
    for subject in choose_subjects(plan.runtimes, plan.presets):
        try:
            runs[subject] = load_subject(subject, threads)
        except ConfigError as err:
            if plan.required or err.code != "runtime_unavailable":
                raise
            skipped[f"{subject.runtime}: {err.message}"] = None
    return runs


def _able(runs: dict[Subject, Run], pair: FramePair, skipped: dict[str, None]) -> dict[Subject, Run]:
    """Those that can judge pairs of this size: the paper's crop asks for 224 pixels."""
    able = {}
    for subject, run in runs.items():
        try:
            run(pair)
        except InvalidInputError as err:
            skipped[f"{subject.preset}: {err.message}"] = None
        else:
            able[subject] = run
    return able


def _round(plan: Plan, runs: dict[Subject, Run], width: int, height: int, threads: int) -> list[dict[str, Any]]:
    times = take_turns(runs, make_pair(width, height), repeats=plan.repeats, budget_s=plan.budget_s)
    by_name = {subject.name: one for subject, one in times.items()}
    rows = []
    for subject, one in times.items():
        rows.append(
            {
                "method": subject.name,
                "runtime": subject.runtime,
                "preset": subject.preset,
                "evidence": subject.evidence,
                "width": width,
                "height": height,
                "threads": threads,
                **asdict(one),
                "over_dis_medium": round(one.median_ms / by_name[YARDSTICK].median_ms, 3),
                "over_homography": round(one.median_ms / by_name[HOMOGRAPHY].median_ms, 3),
                "peak_mib": None,
            }
        )
    return rows


def paper_ratios(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """How many times as long as each variant of ours the paper's network takes, in the same round."""
    ratios = []
    for paper in (row for row in rows if row["preset"] == "paper"):
        place = {name: paper[name] for name in ("width", "height", "threads")}
        for row in rows:
            if row["preset"] == "bundled" and all(row[name] == value for name, value in place.items()):
                ratio = round(paper["median_ms"] / row["median_ms"], 2)
                ratios.append(
                    {**place, "runtime": row["runtime"], "evidence": row["evidence"], "paper_over_ours": ratio}
                )
    return ratios
