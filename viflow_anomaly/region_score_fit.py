"""Fit what a region scores to what it is: logistic regression on regions of recordings whose movers are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.config import RegionScore
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.evaluation.detection_scores import DetectionScores, ScoredBox
from viflow_anomaly.evaluation.labelled_pairs import SimulatedPairs
from viflow_anomaly.moving_regions import REGION_FEATURES, measure_regions
from viflow_anomaly.sensor_data import Float64Array

RIDGE = 1.0
"""Inverse variance of the prior on each standardised weight: a feature that a few regions show is worth little."""
MIN_DEVIATION = 0.1
"""A feature that hardly varies here may vary anywhere else; it must not decide."""
NEWTON_ROUNDS = 25


class LabelledRegions(NamedTuple):
    """features [N, 13] (``REGION_FEATURES``), moving [N]."""

    features: Float64Array
    moving: NDArray[np.bool_]


def labelled_regions(
    detector: AnomalyDetector,
    recordings: Sequence[Path],
    *,
    on_progress: Callable[[int, int], None] | None = None,
) -> LabelledRegions:
    """The regions of labelled recordings that the head was not trained on, and which of them find a mover.

    The rule is that of ``DetectionScores``; what counts neither way is left out.

    Args:
        detector: with the trained head.
        recordings: with masks of what moves.
        on_progress: called with (done, total) after each recording.

    Raises:
        DatasetError: ``ground_truth_missing`` where no region counts; as ``SimulatedPairs``.
    """
    features: list[Float64Array] = []
    moving: list[bool] = []
    for done, path in enumerate(recordings, start=1):
        pairs = SimulatedPairs(path)
        for index in range(len(pairs)):
            try:
                pair = pairs.pair(index)
                answer = detector.judge_cues(pair)
            except InvalidInputError:
                continue
            if answer is None:
                continue
            judged, inside = answer
            found = measure_regions(judged.maps, judged.cues, inside, detector.config.regions)
            measured = [one for one in found if one.shape.passes]  # a band scores by the shape rule, not by this fit
            measured.sort(key=lambda one: -one.features[0])  # of two on one mover the likelier one finds it
            size = detector.internal_size(pair)
            found_at = [one.box if size is None else size.box(one.box) for one in measured]
            boxes = [ScoredBox(box, float(one.features[0]), True) for box, one in zip(found_at, measured, strict=True)]
            for one, hit in zip(measured, DetectionScores.hits(boxes, pairs.labels(index)), strict=True):
                if hit is not None:
                    features.append(one.features)
                    moving.append(hit)
        if on_progress is not None:
            on_progress(done, len(recordings))
    if not features:
        raise DatasetError(
            f"calibration: expected regions that count in {len(recordings)} recordings, found none: the head marks "
            "nothing there yet (more steps?), or nothing moves",
            code="ground_truth_missing",
            field="calibration",
        )
    return LabelledRegions(np.array(features), np.array(moving))


def fit_region_score(regions: LabelledRegions) -> RegionScore:
    """Logistic regression on standardised features with a weak pull to zero, by Newton's method."""
    mean, deviation = regions.features.mean(axis=0), np.maximum(regions.features.std(axis=0), MIN_DEVIATION)
    design = np.column_stack([(regions.features - mean) / deviation, np.ones(len(regions.moving))])
    prior = np.full(design.shape[1], RIDGE)
    prior[-1] = 1e-6
    solution = np.zeros(design.shape[1])
    for _ in range(NEWTON_ROUNDS):
        probability = 1 / (1 + np.exp(-np.clip(design @ solution, -30, 30)))
        gradient = design.T @ (regions.moving - probability) - prior * solution
        curvature = (design * (probability * (1 - probability))[:, None]).T @ design + np.diag(prior)
        solution = solution + np.linalg.solve(curvature, gradient)
    weights = solution[:-1] / deviation
    assert len(weights) == len(REGION_FEATURES)
    return RegionScore(weights=tuple(map(float, weights)), bias=float(solution[-1] - weights @ mean))
