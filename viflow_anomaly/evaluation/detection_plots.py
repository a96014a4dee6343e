"""Charts of a report of regions: precision and recall, recall against false alarms, average precision by class.

Each function writes ``stem.png`` and ``stem.pdf`` and returns both paths; needs the extra ``plots``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.evaluation.detection_report import Report
from viflow_anomaly.evaluation.flow_report import scopes
from viflow_anomaly.evaluation.plot_style import PAGE_IN, SavedPicture, drawing, file_name, look, saved

MANY_ALARMS, FEW_ALARMS = 10.0, 0.003
"""Reach of the axis of false alarms a frame; a curve that starts below begins at its left edge."""

Figures = dict[str, Any]


def draw_detection_figures(folder: Path, report: Report) -> list[SavedPicture]:
    """``precision-recall-GROUP``, ``recall-alarms-GROUP``, ``ap-classes-GROUP`` and, without the rivals, whose scores
    are no probabilities, ``reliability-GROUP`` of each group with movers.

    Args:
        folder: made when it is not there.
        report: of ``detection_report``.

    Raises:
        MissingDependencyError: ``plots_unavailable``.
    """
    pictures = []
    for scope, figures in scopes(report).items():
        if any(one["curve"] is not None for one in figures.values()):
            name = file_name(scope)
            pictures.append(precision_recall(figures, folder / f"precision-recall-{name}", title=scope))
            pictures.append(recall_by_alarms(figures, folder / f"recall-alarms-{name}", title=scope))
            pictures.append(precision_by_class(figures, folder / f"ap-classes-{name}", title=scope))
            own = {method: one for method, one in figures.items() if not report["methods"][method]["best_thresholds"]}
            if any(one["reliability"] for one in own.values()):
                pictures.append(reliability(own, folder / f"reliability-{name}", title=scope))
    return pictures


def precision_recall(figures: Figures, stem: Path, *, title: str | None = None) -> SavedPicture:
    """Precision against recall, one line a method, with the mark where it labels regions as motion.

    Args:
        figures: of one scope, by method.
        stem: of the files.
        title: above the chart.

    Raises:
        InvalidInputError: ``plot_empty`` without any curve; as ``drawing``.
    """
    curves = _curves(figures)
    with drawing(stem, height_in=4.0) as figure:
        axes = figure.add_subplot()
        for index, (name, curve) in enumerate(curves.items()):
            style = look(index)
            label = f"{name} ({figures[name]['roi_ap']:.2f})"
            # Before the first region, precision is not defined.
            axes.plot(curve["recall"][1:], curve["precision"][1:], color=style.color, ls=style.line, label=label)
            if figures[name]["precision"] is not None:
                at = (figures[name]["recall"], figures[name]["precision"])
                axes.plot(*at, ls="none", color=style.color, marker=style.marker)
        axes.set_xlabel("recall")
        axes.set_ylabel("precision")
        axes.set_xlim(0, 1)
        axes.set_ylim(0, 1.02)
        _titled(axes, title)
        figure.legend(loc="outside lower center", ncols=1, title="method (ROI AP)")
    return saved(stem)


def recall_by_alarms(figures: Figures, stem: Path, *, title: str | None = None) -> SavedPicture:
    """Recall against false alarms a frame (logarithmic), one line a method.

    Raises:
        InvalidInputError: ``plot_empty``; as ``drawing``.
    """
    curves = _curves(figures)
    with drawing(stem, height_in=3.2) as figure:
        axes = figure.add_subplot()
        for index, (name, curve) in enumerate(curves.items()):
            style = look(index)
            alarms = [max(rate, FEW_ALARMS) for rate in curve["false_alarms_per_frame"]]
            axes.plot(
                alarms, curve["recall"], color=style.color, ls=style.line, label=name, drawstyle="steps-post",
            )  # fmt: skip
            if figures[name]["recall"] is not None:
                at = max(figures[name]["false_alarms_per_frame"], FEW_ALARMS)
                axes.plot(at, figures[name]["recall"], ls="none", color=style.color, marker=style.marker)
        axes.set_xscale("log")
        axes.set_xlim(FEW_ALARMS, MANY_ALARMS)
        axes.set_ylim(0, 1)
        axes.set_xlabel("false alarms a frame")
        axes.set_ylabel("recall")
        _titled(axes, title)
        figure.legend(loc="outside lower center", ncols=2)
    return saved(stem)


def precision_by_class(figures: Figures, stem: Path, *, title: str | None = None) -> SavedPicture:
    """Average precision by size and by speed of the movers, one marker a method; classes without movers are left out.

    Raises:
        InvalidInputError: ``plot_empty``; as ``drawing``.
    """
    panels = {}
    for kind, label in (("by_size", "area of the box"), ("by_speed", "independent motion")):
        first: dict[str, Figures] = next(iter(figures.values()))[kind]
        names = [name for name in first if any(one[kind][name]["movers"] for one in figures.values())]
        if names:
            panels[kind] = (label, names, [f"{name}\n({first[name]['movers']})" for name in names])
    if not panels:
        raise _empty("a mover")
    with drawing(stem, width_in=PAGE_IN, height_in=2.8) as figure:
        for axes, (kind, (label, names, ticks)) in zip(
            figure.subplots(1, len(panels), squeeze=False, sharey=True)[0], panels.items(), strict=True
        ):
            for index, (method, one) in enumerate(figures.items()):
                style = look(index)
                values = [one[kind][name]["roi_ap"] for name in names]
                axes.plot(
                    range(len(names)), [float("nan") if value is None else value for value in values],
                    color=style.color, marker=style.marker, ls=style.line, lw=0.8, label=method,
                )  # fmt: skip
            axes.set_xticks(range(len(names)), ticks)
            axes.set_xlabel(f"{label} (movers)")
            axes.set_ylim(bottom=0)
            axes.margins(x=0.15)
        figure.axes[0].set_ylabel("ROI AP")
        _titled(figure.axes[0], title)
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right center")
    return saved(stem)


def reliability(figures: Figures, stem: Path, *, title: str | None = None) -> SavedPicture:
    """Share of regions that move by themselves against their score; a marker's area tells how many there are.

    Raises:
        InvalidInputError: ``plot_empty`` without any region; as ``drawing``.
    """
    known = {name: one["reliability"] for name, one in figures.items() if one["reliability"]}
    if not known:
        raise _empty("a region")
    with drawing(stem, height_in=3.6) as figure:
        axes = figure.add_subplot()
        axes.plot((0, 1), (0, 1), color="0.6", lw=0.8)
        for index, (name, bins) in enumerate(known.items()):
            style = look(index)
            scores, shares = ([one[key] for one in bins] for key in ("mean_score", "share_moving"))
            most = max(one["regions"] for one in bins)
            areas = [20 + 100 * one["regions"] / most for one in bins]
            axes.plot(scores, shares, color=style.color, ls=style.line, lw=0.8)
            label = f"{name} (ECE {figures[name]['score_ece']:.3f})"
            axes.scatter(scores, shares, s=areas, color=style.color, marker=style.marker, label=label)
        axes.set_xlabel("score")
        axes.set_ylabel("share that moves by itself")
        axes.set_xlim(0, 1)
        axes.set_ylim(0, 1.02)
        _titled(axes, title)
        figure.legend(loc="outside lower center", ncols=1)
    return saved(stem)


def _curves(figures: Figures) -> dict[str, dict[str, list[float]]]:
    curves = {name: one["curve"] for name, one in figures.items() if one["curve"] is not None}
    if not curves:
        raise _empty("a curve")
    return curves


def _titled(axes: Any, title: str | None) -> None:
    if title is not None:
        axes.set_title(title)


def _empty(expected: str) -> InvalidInputError:
    return InvalidInputError(f"figures: expected {expected}, found none", code="plot_empty", field="plots")
