"""All pictures of a run: flow and correspondences of one pair of each group, charts of the table, wins of trainings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from viflow_anomaly.evaluation.flow_methods import CORRECTED, FlowMethod, MethodAbout, NoEstimateError
from viflow_anomaly.evaluation.flow_pictures import correspondence_picture, flow_wheel_picture
from viflow_anomaly.evaluation.flow_run import ByMethod, FlowMeasurement, group_of
from viflow_anomaly.evaluation.flow_truth import FlowTruth, spread
from viflow_anomaly.evaluation.plot_style import SavedPicture
from viflow_anomaly.evaluation.plots import FlowPoint, epe_by_hypotheses, epe_by_runtime, hypothesis_wins
from viflow_anomaly.geometry import Float32Array

MAX_PANELS = 7
"""Methods in one flow picture: beyond that panels would be too small to read."""


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
    for group, (truth, index) in _middle_pairs(spread(truths, max_pairs)).items():
        pictures += _draw_pair(folder, group, methods, truth, index)
    groups = measurement.groups()
    for name, by_method in (groups if len(groups) == 1 else {**groups, "all": measurement.total()}).items():
        pictures += _draw_charts(folder, name, measurement.methods, by_method)
    for name, log in (training_logs or {}).items():
        if log.is_file():
            pictures.append(hypothesis_wins(log, folder / f"wins-{_file_name(name)}", title=name))
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


def _middle_pairs(chosen: Sequence[tuple[FlowTruth, int]]) -> dict[str, tuple[FlowTruth, int]]:
    groups: dict[str, list[tuple[FlowTruth, int]]] = {}
    for truth, index in chosen:
        groups.setdefault(group_of(truth.sequence), []).append((truth, index))
    return {group: some[len(some) // 2] for group, some in sorted(groups.items())}


def _draw_pair(
    folder: Path, group: str, methods: Sequence[FlowMethod], truth: FlowTruth, index: int
) -> list[SavedPicture]:
    true_px, valid = truth.truth(index)
    pair = truth.pair(index)
    flows: dict[str, Float32Array] = {}
    shown = sorted(methods, key=lambda method: method.about.kind != "network")
    for method in [one for one in shown if one.about.name != "identity"][:MAX_PANELS]:
        try:
            flows[method.about.name] = method.flow(truth.pair(index, method.motor_source), truth.name(index))
        except NoEstimateError:
            continue
    if not valid.any() or not flows:
        return []
    name = _file_name(group)
    pictures = [flow_wheel_picture(pair.source.image, true_px, valid, flows, folder / f"flow-{name}")]
    best = next((one for one in flows if one.endswith(CORRECTED)), next(iter(flows)))
    if (valid & np.isfinite(flows[best]).all(axis=-1)).any():
        images = (pair.source.image, pair.target.image)
        stem = folder / f"correspondences-{name}"
        pictures.append(correspondence_picture(*images, true_px, valid, flows[best], stem, label=best))
    return pictures


def _draw_charts(folder: Path, name: str, methods: Sequence[MethodAbout], by_method: ByMethod) -> list[SavedPicture]:
    points = flow_points(methods, by_method)
    pictures = []
    if any(point.runtime_ms for point in points):
        pictures.append(epe_by_runtime(points, folder / f"epe-runtime-{_file_name(name)}", title=name))
    if len({point.hypotheses for point in points if point.hypotheses is not None}) > 1:
        pictures.append(epe_by_hypotheses(points, folder / f"epe-hypotheses-{_file_name(name)}", title=name))
    return pictures


def _file_name(text: str) -> str:
    """What is safe in a file's name on any system."""
    return "".join(character if character.isalnum() or character in "-_.+" else "_" for character in text)
