"""Charts: clustering error of the motor signal, error against hypotheses and runtime, wins over a training.

Each function writes ``stem.png`` and ``stem.pdf`` and returns both paths; needs the extra ``plots``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.evaluation.plot_style import PAGE_IN, SavedPicture, drawing, look, saved

HISTOGRAM_BINS = 60
HISTOGRAM_SHARE = 99.5
"""Percentile of the errors' sizes that the histogram reaches to; what lies beyond is said in the legend."""


class FlowPoint(NamedTuple):
    """One method's place in the charts.

    Attributes:
        series: points of one series are joined (``imu``, ``imu +correction``).
        label: of the point itself.
        hypotheses: None for a method without.
        runtime_ms: None where it is not known.
    """

    series: str
    label: str
    epe_px: float
    hypotheses: int | None = None
    runtime_ms: float | None = None


def clustering_error_histogram(errors_by_rig: Mapping[str, ArrayLike], stem: Path, *, unit: str = "m") -> SavedPicture:
    """How far the surrogate motor signal is from the motion that it stands for, one line a rig (the paper's Fig. 3).

    Args:
        errors_by_rig: rig -> differences between cluster centres and true position differences, any shape; signed
            components as in the paper, or distances.
        stem: of the files.
        unit: of the errors.

    Raises:
        InvalidInputError: ``plot_empty``; as ``drawing``.
    """
    errors = {name: np.asarray(values, dtype=np.float64).ravel() for name, values in errors_by_rig.items()}
    if not errors or not all(values.size and np.isfinite(values).all() for values in errors.values()):
        raise _empty("errors_by_rig", "finite errors of each rig")
    reach = max(float(np.percentile(np.abs(values), HISTOGRAM_SHARE)) for values in errors.values()) or 1.0
    signed = any((values < 0).any() for values in errors.values())
    edges = np.linspace(-reach if signed else 0.0, reach, HISTOGRAM_BINS + 1)
    with drawing(stem) as figure:
        axes = figure.add_subplot()
        for index, (name, values) in enumerate(errors.items()):
            counts, _ = np.histogram(values, edges)
            beyond = 1 - counts.sum() / values.size
            label = f"{name}: $\\sigma$ = {values.std():.3g} {unit}" + (f", {beyond:.1%} beyond" if beyond else "")
            style = look(index + 3)
            axes.stairs(100 * counts / values.size, edges, color=style.color, linestyle=look(index).line, label=label)
        axes.set_xlabel(f"clustering error [{unit}]")
        axes.set_ylabel("share of the errors [%]")
        axes.set_xlim(edges[0], edges[-1])
        axes.set_ylim(bottom=0)
        figure.legend(loc="outside upper center", ncols=1)
    return saved(stem)


def epe_by_hypotheses(points: Sequence[FlowPoint], stem: Path, *, title: str | None = None) -> SavedPicture:
    """Mean endpoint error against the number of hypotheses, one line a series; points without are left out.

    Raises:
        InvalidInputError: ``plot_empty``; as ``drawing``.
    """
    with_k = [(point, point.hypotheses) for point in points if point.hypotheses is not None]
    if not with_k:
        raise _empty("points", "a point with hypotheses")
    with drawing(stem, height_in=2.8) as figure:
        axes = figure.add_subplot()
        names = list(dict.fromkeys(point.series for point, _ in with_k))
        for index, name in enumerate(names):
            line = sorted((k, point.epe_px) for point, k in with_k if point.series == name)
            style = look(index)
            axes.plot(*zip(*line, strict=True), color=style.color, marker=style.marker, ls=style.line, label=name)
        numbers = sorted({k for _, k in with_k})
        axes.set_xscale("log", base=2)
        axes.set_xticks(numbers, [str(number) for number in numbers], minor=False)
        axes.set_xticks([], minor=True)
        axes.set_xlabel("hypotheses K")
        axes.set_ylabel("mean EPE [px]")
        axes.set_ylim(bottom=0)
        _titled(axes, title)
        figure.legend(loc="outside lower center", ncols=1 if max(map(len, names)) > 18 else 2)
    return saved(stem)


def epe_by_runtime(points: Sequence[FlowPoint], stem: Path, *, title: str | None = None) -> SavedPicture:
    """Mean endpoint error against runtime; the line joins what no other point beats in both (the Pareto front).

    Points without a runtime are left out. Numbers in the picture refer to the list beside it: labels beside points
    that lie close together would cover each other.

    Raises:
        InvalidInputError: ``plot_empty``; as ``drawing``.
    """
    timed = sorted(
        (point.runtime_ms, point.epe_px, point.label) for point in points if point.runtime_ms and point.epe_px > 0
    )
    if not timed:
        raise _empty("points", "a point with a runtime")
    with drawing(stem, width_in=PAGE_IN, height_in=3.0) as figure:
        axes = figure.add_subplot()
        front = pareto_front([(runtime_ms, epe_px) for runtime_ms, epe_px, _ in timed])
        axes.plot(*zip(*front, strict=True), color="#808080", drawstyle="steps-post", lw=1.0, ls="--", zorder=1)
        for index, (runtime_ms, epe_px, label) in enumerate(timed):
            style = look(index)
            fill = style.color if (runtime_ms, epe_px) in front else "white"
            axes.plot(
                runtime_ms, epe_px, ls="none", color=style.color, marker=style.marker, mfc=fill, ms=6,
                label=f"{index + 1}  {label}",
            )  # fmt: skip
            axes.annotate(str(index + 1), (runtime_ms, epe_px), (4, 4), textcoords="offset points", color=style.color)
        axes.set_xscale("log")
        axes.set_xlabel("runtime [ms]")
        axes.set_ylabel("mean EPE [px]")
        axes.set_ylim(0, 1.12 * max(epe_px for _, epe_px, _ in timed))
        axes.margins(x=0.1)
        _titled(axes, title)
        figure.legend(loc="outside right center")
    return saved(stem)


def pareto_front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points that no other one beats in both coordinates (lower is better), by the first."""
    front: list[tuple[float, float]] = []
    for first, second in sorted(points):
        if not front or second < front[-1][1]:
            front.append((first, second))
    return front


def hypothesis_wins(metrics: Path, stem: Path, *, title: str | None = None) -> SavedPicture:
    """The share of examples that each hypothesis won, over the training (``metrics.jsonl`` of a run).

    Raises:
        InvalidInputError: ``plot_empty``, ``metrics_malformed``; as ``drawing``.
    """
    steps, wins = read_wins(metrics)
    with drawing(stem, height_in=2.8) as figure:
        axes = figure.add_subplot()
        every = max(1, len(steps) // 6)
        for index, shares in enumerate(100 * wins.T):
            style = look(index)
            axes.plot(
                steps, shares, color=style.color, ls=style.line, marker=style.marker, markevery=(index % every, every),
                ms=3.5, lw=0.9, label=str(index + 1),
            )  # fmt: skip
        axes.axhline(100 / wins.shape[1], color="#808080", lw=0.8, zorder=0)
        axes.set_xlabel("training step")
        axes.set_ylabel("share of wins [%]")
        axes.set_ylim(bottom=0)
        _titled(axes, title)
        figure.legend(loc="outside lower center", ncols=4, title="hypothesis (gray: equal shares)")
    return saved(stem)


def read_wins(metrics: Path) -> tuple[np.ndarray[Any, np.dtype[np.int64]], np.ndarray[Any, np.dtype[np.float64]]]:
    """Steps [N] and shares of wins [N, K] of a run's ``metrics.jsonl``; lines without wins are passed over.

    Raises:
        InvalidInputError: ``metrics_malformed`` (names the line), ``plot_empty`` without any line with wins.
        OSError: the file cannot be read.
    """
    steps: list[int] = []
    wins: list[list[float]] = []
    for number, line in enumerate(metrics.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            values = json.loads(line)
            if "wins" not in values:
                continue
            step, shares = int(values["step"]), [float(share) for share in values["wins"]]
        except (ValueError, KeyError, TypeError) as err:
            raise _malformed(metrics, number, "a JSON object with step and wins", line) from err
        if wins and len(shares) != len(wins[0]):
            raise _malformed(metrics, number, f"{len(wins[0])} shares as in the lines before", line)
        steps.append(step)
        wins.append(shares)
    if not steps:
        raise _empty(str(metrics), "a line with wins")
    return np.array(steps, dtype=np.int64), np.array(wins, dtype=np.float64)


def _malformed(metrics: Path, line: int, expected: str, found: str) -> InvalidInputError:
    return InvalidInputError(
        f"{metrics}, line {line}: expected {expected}, found {found[:60]!r}", code="metrics_malformed", field="metrics"
    )


def _titled(axes: Any, title: str | None) -> None:
    if title is not None:
        axes.set_title(title)


def _empty(where: str, expected: str) -> InvalidInputError:
    return InvalidInputError(f"{where}: expected {expected}, found none", code="plot_empty", field="plots")
