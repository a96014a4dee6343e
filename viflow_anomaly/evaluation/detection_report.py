"""A measurement of regions as plain values for JSON."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from viflow_anomaly.detection import ModelInfo
from viflow_anomaly.evaluation.detection_methods import Thresholds
from viflow_anomaly.evaluation.detection_quality import ByMethod, DetectionMeasurement, FindingScores, MethodScores
from viflow_anomaly.evaluation.detection_scores import (
    IGNORED_SHARE,
    MIN_IOU,
    SIZE_CLASSES,
    SPEED_CLASSES,
    DetectionScores,
    rounded,
)
from viflow_anomaly.evaluation.flow_report import ALL, circumstances
from viflow_anomaly.evaluation.labelled_pairs import MIN_AREA_PX, MIN_INDEPENDENT_FLOW_PX

Report = dict[str, Any]
CURVE_POINTS = 100
"""A curve in the report has at most this many points, evenly spread over its own."""


def detection_report(
    measurement: DetectionMeasurement,
    model: ModelInfo,
    detector: Mapping[str, Any],
    *,
    options: Mapping[str, Any] | None = None,
) -> Report:
    """The report of a run.

    ``all``, each of ``groups`` and each of ``sequences`` hold the figures of every method by its name; those of
    sequences are without classes and curves. A rival's thresholds are chosen for each scope; its sequences have those
    of their group. Where there was nothing to find, they are those of everything.

    Args:
        measurement: what was found.
        model: whose weights.
        detector: its configuration.
        options: of the run, as they are to be stated.
    """
    total, groups = measurement.total(), measurement.groups()
    overall = {name: scores.best() for name, scores in total.items()}
    chosen = {group: _chosen(by_method, overall) for group, by_method in groups.items()}
    sequences = {}
    names = [key.sequence for key in measurement.sequences]
    for key, by_method in sorted(measurement.sequences.items()):
        name = key.sequence if names.count(key.sequence) == 1 else f"{key.group}/{key.sequence}"
        figures = {
            method: _headline(by_method[method], chosen[key.group][method])
            for method in measurement.rivals
            if method in by_method
        }
        sequences[name] = {"group": key.group, "methods": figures}
    return {
        "model": {"name": model.name, "version": model.version, "sha256": model.sha256},
        **circumstances(),
        "options": dict(options or {}),
        "detector": dict(detector),
        "rules": _rules(),
        "methods": {name: {"best_thresholds": rival} for name, rival in measurement.rivals.items()},
        "skipped_pairs": dict(measurement.skipped),
        ALL: _figures(total, _chosen(total, overall)),
        "groups": {group: _figures(by_method, chosen[group]) for group, by_method in groups.items()},
        "sequences": sequences,
    }


def _rules() -> dict[str, Any]:
    """What the figures mean, as numbers; None: no bound."""

    def bounds(classes: Mapping[str, tuple[float, float]]) -> dict[str, list[float | None]]:
        return {name: [low, high if np.isfinite(high) else None] for name, (low, high) in classes.items()}

    return {
        "min_iou": MIN_IOU,
        "ignored_share": IGNORED_SHARE,
        "min_area_px": MIN_AREA_PX,
        "min_independent_flow_px": MIN_INDEPENDENT_FLOW_PX,
        "size_classes_box_px": bounds(SIZE_CLASSES),
        "speed_classes_px": bounds(SPEED_CLASSES),
    }


def _chosen(by_method: ByMethod, overall: Mapping[str, Thresholds | None]) -> dict[str, Thresholds]:
    """Each method's thresholds in one scope: the best there, else the best of all, else its first."""
    return {
        name: scores.best() or overall.get(name) or next(iter(scores.findings)) for name, scores in by_method.items()
    }


def _headline(scores: MethodScores, thresholds: Thresholds) -> dict[str, Any]:
    finding = scores.findings.get(thresholds, FindingScores())
    has_pixels = scores.pixels.frames > 0
    return {
        **finding.boxes.summary(),
        "pixel_ap": rounded(scores.pixels.average_precision()) if has_pixels else None,
        "pixel_iou_best": rounded(scores.pixels.best_iou()) if has_pixels else None,
        "pixel_iou": rounded(finding.masks.iou()) if has_pixels else None,
        **thresholds._asdict(),
    }


def _figures(by_method: ByMethod, chosen: Mapping[str, Thresholds]) -> dict[str, Any]:
    figures = {}
    for name, scores in by_method.items():
        boxes = scores.findings[chosen[name]].boxes
        figures[name] = {
            **_headline(scores, chosen[name]),
            "by_size": {one: _class_figures(boxes.of_size(one)) for one in SIZE_CLASSES},
            "by_speed": {one: _class_figures(boxes.of_speed(one)) for one in SPEED_CLASSES},
            "curve": _curve(boxes),
            "reliability": [
                {name: rounded(value) for name, value in one._asdict().items()} for one in boxes.reliability()
            ],
        }
    return figures


def _class_figures(boxes: DetectionScores) -> dict[str, Any]:
    summary = boxes.summary()
    return {key: summary[key] for key in ("movers", "roi_ap", "best_f1", "recall", "recall_at_0.1_false_alarms")}


def _curve(boxes: DetectionScores) -> dict[str, list[float]] | None:
    """Recall, precision and false alarms a frame; None where there was nothing to find."""
    if not boxes.movers:
        return None
    curve = boxes.curve()
    some = np.unique(np.linspace(0, len(curve.recall) - 1, CURVE_POINTS).round().astype(int))
    alarms = curve.false_alarms / boxes.frames
    values = {"recall": curve.recall, "precision": curve.precision, "false_alarms_per_frame": alarms}
    return {name: [round(float(value), 5) for value in points[some]] for name, points in values.items()}
