"""All pictures of a run: flow and correspondences of one pair of each group, charts of the table, wins of trainings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.evaluation.flow_methods import FlowMethod, MethodAbout, NoEstimateError
from viflow_anomaly.evaluation.flow_pictures import correspondence_picture, flow_wheel_picture
from viflow_anomaly.evaluation.flow_run import ByMethod, FlowMeasurement, group_of
from viflow_anomaly.evaluation.flow_truth import FlowTruth, spread
from viflow_anomaly.evaluation.paper_table import PAPER_TABLE
from viflow_anomaly.evaluation.plot_style import SavedPicture, file_name
from viflow_anomaly.evaluation.plots import FlowPoint, epe_by_hypotheses, epe_by_runtime, hypothesis_wins
from viflow_anomaly.geometry import Float32Array

MAX_POINTS = 14
MAX_NETWORKS, MAX_PANELS = 4, 7
"""Methods in one flow picture, the best of each kind: beyond that panels would be too small to read."""


def draw_flow_figures(
    folder: Path,
    measurement: FlowMeasurement,
    methods: Sequence[FlowMethod],
    truths: Sequence[FlowTruth],
    *,
    max_pairs: int | None = None,
    training_logs: Mapping[str, Path] | None = None,
) -> list[SavedPicture]:
    """Draw a run into ``folder``.

    A picture of a pair shows the best networks and the best others by mean EPE; the correspondences are the best one's.
    ``flow-GROUP`` and ``correspondences-GROUP`` (the pair in the middle of the group's), ``epe-runtime-GROUP``,
    ``epe-hypotheses-GROUP`` where networks differ in K, and ``wins-NAME`` where a checkpoint's training left its log.

    Args:
        folder: made when it is not there.
        measurement, methods, truths, max_pairs: of ``measure_flow_methods``.
        training_logs: name of a checkpoint -> its ``metrics.jsonl``; those that are not there are left out.

    Raises:
        MissingDependencyError: ``plots_unavailable``.
        InvalidInputError: ``metrics_malformed``; as the truths and methods raise.
    """
    pictures = []
    groups = measurement.groups()
    for group, candidates in _from_the_middle(spread(truths, max_pairs)).items():
        best = _best_methods(methods, groups[group])
        pictures += next(filter(None, (_draw_pair(folder, group, best, *one) for one in candidates)), [])
    for name, by_method in (groups if len(groups) == 1 else {**groups, "all": measurement.total()}).items():
        pictures += _draw_charts(folder, name, measurement.methods, by_method)
    for name, log in (training_logs or {}).items():
        if log.is_file():
            pictures.append(hypothesis_wins(log, folder / f"wins-{file_name(name)}", title=name))
    return pictures


def flow_points(methods: Sequence[MethodAbout], by_method: ByMethod) -> list[FlowPoint]:
    """The charts' points of what was estimated."""
    points = []
    for about in methods:
        summary = by_method[about.name].summary()
        if summary["epe_mean_px"] is None:
            continue
        mean_px, runtime_ms = summary["epe_mean_px"], summary["runtime_ms"]
        points.append(FlowPoint(about.series, about.name, mean_px, about.hypotheses, runtime_ms))
    return points


def paper_points(data: Literal["kitti", "euroc"]) -> list[FlowPoint]:
    """The paper's own figures as points, to be drawn in a chart of their own."""
    points = []
    for row in PAPER_TABLE:
        errors = row.kitti if data == "kitti" else row.euroc
        label = row.algorithm if row.hypotheses is None else f"{row.algorithm} K={row.hypotheses}"
        points.append(FlowPoint(row.algorithm, label, errors.mean_px, row.hypotheses, row.runtime_ms))
    return points


def _best_methods(methods: Sequence[FlowMethod], by_method: ByMethod) -> list[FlowMethod]:
    """Networks first, each kind from the best mean EPE up; no identity, whose picture is white."""

    def error_px(method: FlowMethod) -> float:
        mean_px = by_method[method.about.name].summary()["epe_mean_px"]
        return float("inf") if mean_px is None else float(mean_px)

    ranked = sorted((method for method in methods if method.about.name != "identity"), key=error_px)
    networks = [method for method in ranked if method.about.kind == "network"][:MAX_NETWORKS]
    return (networks + [method for method in ranked if method.about.kind != "network"])[:MAX_PANELS]


def best_of_each_series(points: Sequence[FlowPoint]) -> list[FlowPoint]:
    """All points, or the most accurate of each series where there are more than a chart's list has room for."""
    timed = [point for point in points if point.runtime_ms]
    if len(timed) <= MAX_POINTS:
        return list(points)
    best: dict[str, FlowPoint] = {}
    for point in timed:
        if point.series not in best or point.epe_px < best[point.series].epe_px:
            best[point.series] = point
    return list(best.values())


def _from_the_middle(chosen: Sequence[tuple[FlowTruth, int]]) -> dict[str, list[tuple[FlowTruth, int]]]:
    """The pairs of each group, the one in the middle first: it may be one that cannot be measured."""
    groups: dict[str, list[tuple[FlowTruth, int]]] = {}
    for truth, index in chosen:
        groups.setdefault(group_of(truth.sequence), []).append((truth, index))
    return {
        group: [some[k] for k in sorted(range(len(some)), key=lambda k: abs(k - len(some) // 2))]
        for group, some in sorted(groups.items())
    }


def _draw_pair(
    folder: Path, group: str, methods: Sequence[FlowMethod], truth: FlowTruth, index: int
) -> list[SavedPicture]:
    try:
        true_px, valid = truth.truth(index)
        pair = truth.pair(index)
    except (DatasetError, InvalidInputError):
        return []
    flows: dict[str, Float32Array] = {}
    for method in methods:
        try:
            flows[method.about.name] = method.flow(truth.pair(index, method.motor_source), truth.name(index))
        except (NoEstimateError, DatasetError, InvalidInputError):
            continue
    if not valid.any() or not flows:
        return []
    name = file_name(group)
    pictures = [flow_wheel_picture(pair.source.image, true_px, valid, flows, folder / f"flow-{name}")]
    best = next(iter(flows))
    if (valid & np.isfinite(flows[best]).all(axis=-1)).any():
        images = (pair.source.image, pair.target.image)
        stem = folder / f"correspondences-{name}"
        pictures.append(correspondence_picture(*images, true_px, valid, flows[best], stem, label=best))
    return pictures


def _draw_charts(folder: Path, name: str, methods: Sequence[MethodAbout], by_method: ByMethod) -> list[SavedPicture]:
    points = flow_points(methods, by_method)
    pictures = []
    if any(point.runtime_ms for point in points):
        pictures.append(
            epe_by_runtime(best_of_each_series(points), folder / f"epe-runtime-{file_name(name)}", title=name)
        )
    if len({point.hypotheses for point in points if point.hypotheses is not None}) > 1:
        pictures.append(epe_by_hypotheses(points, folder / f"epe-hypotheses-{file_name(name)}", title=name))
    return pictures
