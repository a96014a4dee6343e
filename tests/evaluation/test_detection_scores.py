"""The ruler, on frames drawn by hand whose figures can be worked out on paper."""

from __future__ import annotations

import numpy as np
import pytest

from viflow_anomaly.evaluation.detection_scores import DetectionScores, ScoredBox, iou
from viflow_anomaly.evaluation.labelled_pairs import Labels, TrueObject
from viflow_anomaly.regions import BoundingBox

SHAPE = (40, 60)


def labels(*boxes: tuple[int, int, int, int], ignored: tuple[tuple[int, int, int, int], ...] = ()) -> Labels:
    objects = [TrueObject(BoundingBox(*box), 4.0, counted=True) for box in boxes]
    objects += [TrueObject(BoundingBox(*box), 0.2, counted=False) for box in ignored]
    masks = [np.zeros(SHAPE, np.bool_), np.zeros(SHAPE, np.bool_)]
    for thing in objects:
        x, y, width, height = thing.bbox
        masks[0 if thing.counted else 1][y : y + height, x : x + width] = True
    return Labels(tuple(objects), masks[0], masks[1])


def box(x: int, y: int, width: int, height: int, score: float) -> ScoredBox:
    return ScoredBox(BoundingBox(x, y, width, height), score)


def test_iou_of_boxes() -> None:
    whole = BoundingBox(0, 0, 10, 10)
    assert iou(whole, whole) == 1.0
    assert iou(whole, BoundingBox(5, 0, 10, 10)) == pytest.approx(50 / 150)
    assert iou(whole, BoundingBox(10, 0, 5, 5)) == 0.0


def test_a_hit_a_miss_and_a_false_alarm() -> None:
    scores = DetectionScores()
    scores.add_frame([box(0, 0, 10, 10, 0.9), box(40, 20, 8, 8, 0.6)], labels((1, 1, 10, 10), (20, 20, 10, 10)))
    summary = scores.summary()
    assert (summary["frames"], summary["movers"], summary["false_alarms_per_frame"]) == (1, 2, 1.0)
    assert summary["roi_ap"] == 0.5
    assert summary["best_f1"] == pytest.approx(2 * 0.5 / 1.5, abs=1e-4)
    assert summary["recall_at_0.1_false_alarms"] == 0.5


def test_precision_falls_with_false_alarms_above_the_hits() -> None:
    scores = DetectionScores()
    scores.add_frame([box(40, 20, 8, 8, 0.9), box(0, 0, 10, 10, 0.5)], labels((0, 0, 10, 10)))
    summary = scores.summary()
    assert summary["roi_ap"] == 0.5
    assert summary["recall_at_0.1_false_alarms"] == 0.0


def test_equal_scores_stand_or_fall_together() -> None:
    scores = DetectionScores()
    scores.add_frame([box(0, 0, 10, 10, 0.5), box(40, 20, 8, 8, 0.5)], labels((0, 0, 10, 10)))
    assert scores.summary()["roi_ap"] == 0.5


def test_a_mover_is_found_once() -> None:
    scores = DetectionScores()
    scores.add_frame([box(0, 0, 10, 10, 0.9), box(0, 0, 10, 9, 0.8)], labels((0, 0, 10, 10)))
    assert scores.summary()["false_alarms_per_frame"] == 1.0


def test_what_lies_in_an_ignored_box_does_not_count() -> None:
    scores = DetectionScores()
    scores.add_frame(
        [box(30, 20, 8, 8, 0.9), box(52, 30, 8, 8, 0.8)], labels((0, 0, 9, 9), ignored=((30, 20, 12, 12),))
    )
    summary = scores.summary()
    assert (summary["movers"], summary["false_alarms_per_frame"], summary["roi_ap"]) == (1, 1.0, 0.0)


def test_recall_at_a_rate_of_false_alarms() -> None:
    scores = DetectionScores()
    for k in range(10):
        extra = [box(40, 20, 8, 8, 0.7)] if k == 0 else []
        scores.add_frame([box(0, 0, 10, 10, 0.9 if k < 5 else 0.6), *extra], labels((0, 0, 10, 10)))
    summary = scores.summary()
    assert summary["recall_at_0.1_false_alarms"] == 1.0
    assert summary["recall_at_0.01_false_alarms"] == 0.5


def test_frames_without_movers_have_no_precision_but_false_alarms() -> None:
    scores = DetectionScores()
    scores.add_frame([box(0, 0, 5, 5, 0.9)], labels())
    scores.add_frame([], labels())
    summary = scores.summary()
    assert summary["roi_ap"] is None
    assert summary["pixel_ap"] is None
    assert summary["false_alarms_per_frame"] == 0.5


def test_nothing_at_all() -> None:
    assert DetectionScores().summary()["false_alarms_per_frame"] is None


def test_pixels_by_their_evidence() -> None:
    truth = labels((0, 0, 10, 10), ignored=((20, 0, 10, 10),))
    inside = np.ones(SHAPE, np.bool_)
    perfect = truth.moving.astype(np.float32)
    scores = DetectionScores()
    scores.add_pixels(perfect + 0.9 * truth.ignored, inside, truth)
    assert scores.summary()["pixel_ap"] is None or scores.movers == 0
    assert scores._pixel_ap() == pytest.approx(1.0)
    blind = DetectionScores()
    blind.add_pixels(np.zeros(SHAPE, np.float32), inside, truth)
    assert blind._pixel_ap() == pytest.approx(100 / (40 * 60 - 100))
    outside = DetectionScores()
    outside.add_pixels(perfect, ~truth.moving, truth)
    assert outside._pixel_ap() is None
