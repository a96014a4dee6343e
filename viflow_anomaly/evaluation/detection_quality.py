"""Ours and its rivals on labelled sequences: the same regions, the same ruler, thresholds that favour the rivals.

A rival's thresholds are those of ``RIVAL_THRESHOLDS`` that give its best average precision on the very frames it is
judged on; ours are the configuration's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from viflow_anomaly.config import RegionConfig
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.evaluation.detection_scores import DetectionScores, ScoredBox
from viflow_anomaly.evaluation.flow_truth import RecordingTruth
from viflow_anomaly.evaluation.labelled_pairs import BoolArray, Labels, labels_of
from viflow_anomaly.evaluation.rivals import RIVALS
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.regions import BoundingBox, find_regions
from viflow_anomaly.sensor_data import FramePair

RIVAL_THRESHOLDS = tuple((mads, gray) for mads in (3.0, 6.0, 12.0) for gray in (6.0, 12.0, 24.0, 48.0))
EVIDENCE_SCALE_GRAY = 64.0
"""Evidence at which the pixel measure is half saturated; any monotone scale gives the same average precision."""
PIXEL_SMOOTHING_PX = 1.2
OURS = "viflow-anomaly"

Table = dict[str, dict[str, dict[str, Any]]]


def measure_detection(
    detector: AnomalyDetector,
    recordings: Sequence[Path],
    *,
    every: int = 1,
    rivals: bool = True,
    on_progress: Callable[[int, int], None] | None = None,
) -> Table:
    """Figures by group of sequences (the name up to its first underscore) and method.

    Args:
        detector: ours.
        recordings: simulated sequences with ground truth.
        every: take every n-th pair of each.
        rivals: measure the classical methods, too.
        on_progress: called with (done, total) after each recording.

    Raises:
        DatasetError: ``ground_truth_missing`` for a recording without ground truth or pairs, before anything is
            measured; as ``open_recording``.
    """
    groups: dict[str, dict[str, dict[tuple[float, float], DetectionScores]]] = {}
    opened = [RecordingTruth(path) for path in recordings]
    for done, truth in enumerate(opened, start=1):
        group = groups.setdefault(truth.sequence.split("_", 1)[0], {})
        for index in range(0, len(truth), every):
            pair = truth.pair(index, detector.motor_source)
            labels = labels_of(truth.ground_truth, pair.source.timestamp_ns)
            _add_ours(group, detector, pair, labels)
            if rivals:
                _add_rivals(group, detector.config.regions, pair, labels)
        if on_progress is not None:
            on_progress(done, len(recordings))
    return {name: {method: _best(scores) for method, scores in group.items()} for name, group in sorted(groups.items())}


def _add_ours(
    group: dict[str, dict[tuple[float, float], DetectionScores]],
    detector: AnomalyDetector,
    pair: FramePair,
    labels: Labels,
) -> None:
    regions = detector.config.regions
    key = (regions.threshold_mads, regions.min_residual_gray)
    scores = group.setdefault(OURS, {}).setdefault(key, DetectionScores())
    analysis = detector.analyze(pair)
    boxes = [(roi.bbox, roi.score) for roi in analysis.detection.rois]
    found = [ScoredBox(BoundingBox(box.x, box.y, box.width, box.height), score) for box, score in boxes]
    scores.add_frame(found, labels)
    _add_pixels(scores, analysis.evidence, analysis.inside, labels)


def _add_rivals(
    group: dict[str, dict[tuple[float, float], DetectionScores]],
    config: RegionConfig,
    pair: FramePair,
    labels: Labels,
) -> None:
    for name, rival in RIVALS.items():
        evidence, inside = rival(pair)
        for mads, gray in RIVAL_THRESHOLDS:
            scores = group.setdefault(name, {}).setdefault((mads, gray), DetectionScores())
            thresholds = config.model_copy(update={"threshold_mads": mads, "min_residual_gray": gray})
            found = find_regions(evidence, inside, thresholds).regions
            scores.add_frame([ScoredBox(region.bbox, region.score) for region in found], labels)
            if (mads, gray) == RIVAL_THRESHOLDS[0]:  # pixels know no threshold
                _add_pixels(scores, evidence, inside, labels)


def _add_pixels(scores: DetectionScores, evidence: Float32Array, inside: BoolArray, labels: Labels) -> None:
    smoothed = cv2.GaussianBlur(evidence, (0, 0), PIXEL_SMOOTHING_PX)
    scores.add_pixels(np.asarray(smoothed / (smoothed + EVIDENCE_SCALE_GRAY), dtype=np.float32), inside, labels)


def _best(by_threshold: dict[tuple[float, float], DetectionScores]) -> dict[str, Any]:
    """The figures at the thresholds with the best average precision; the pixel measure is of the first."""
    summaries = {key: scores.summary() for key, scores in by_threshold.items()}
    best = max(summaries, key=lambda key: summaries[key]["roi_ap"] or 0.0)
    pixel_ap = next(iter(summaries.values()))["pixel_ap"]
    return {**summaries[best], "pixel_ap": pixel_ap, "threshold_mads": best[0], "min_residual_gray": best[1]}
