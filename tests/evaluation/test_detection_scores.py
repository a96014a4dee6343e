"""The ruler, on frames drawn by hand whose figures can be worked out on paper."""

from __future__ import annotations

import pytest

from viflow_anomaly.evaluation.detection_scores import DetectionScores, ScoredBox, iou
from viflow_anomaly.evaluation.labelled_pairs import Labels, TrueObject
from viflow_anomaly.regions import BoundingBox

STEP_S = 0.1


def labels(
    *boxes: tuple[int, int, int, int],
    ignored: tuple[tuple[int, int, int, int], ...] = (),
    speed_px: float | None = 4.0,
) -> Labels:
    objects = [TrueObject(BoundingBox(*box), speed_px, counted=True) for box in boxes]
    objects += [TrueObject(BoundingBox(*box), 0.2, counted=False) for box in ignored]
    return Labels(tuple(objects))


def box(x: int, y: int, width: int, height: int, score: float) -> ScoredBox:
    return ScoredBox(BoundingBox(x, y, width, height), score, score >= 0.5)


def scored(*frames: tuple[list[ScoredBox], Labels]) -> DetectionScores:
    scores = DetectionScores()
    for boxes, truth in frames:
        scores.add_frame(boxes, truth, STEP_S)
    return scores


def test_iou_of_boxes() -> None:
    whole = BoundingBox(0, 0, 10, 10)
    assert iou(whole, whole) == 1.0
    assert iou(whole, BoundingBox(5, 0, 10, 10)) == pytest.approx(50 / 150)
    assert iou(whole, BoundingBox(10, 0, 5, 5)) == 0.0


def test_a_hit_a_miss_and_a_false_alarm() -> None:
    found = [box(0, 0, 10, 10, 0.9), box(40, 20, 8, 8, 0.6)]
    summary = scored((found, labels((1, 1, 10, 10), (20, 20, 10, 10)))).summary()
    assert (summary["frames"], summary["movers"], summary["false_alarms_per_frame"]) == (1, 2, 1.0)
    assert summary["roi_ap"] == 0.5
    assert summary["best_f1"] == pytest.approx(2 * 0.5 / 1.5, abs=1e-4)
    assert (summary["recall"], summary["precision"]) == (0.5, 0.5)
    assert summary["recall_at_0.1_false_alarms"] == 0.5


def test_false_alarms_a_minute_are_over_the_time_that_was_judged() -> None:
    alarm = [box(40, 20, 8, 8, 0.6)]
    summary = scored((alarm, labels()), ([], labels()), (alarm, labels())).summary()
    assert (summary["seconds"], summary["false_alarms_per_minute"]) == (0.3, 400.0)


def test_what_is_not_labelled_as_motion_is_no_alarm_but_on_the_curve() -> None:
    scores = scored(([box(40, 20, 8, 8, 0.45), box(0, 0, 10, 10, 0.4)], labels((0, 0, 10, 10))))
    summary = scores.summary()
    assert (summary["false_alarms_per_frame"], summary["recall"], summary["precision"]) == (0.0, 0.0, None)
    assert summary["roi_ap"] == 0.5
    assert scores.curve().recall.tolist() == [0, 0, 1]
    assert scores.curve().precision.tolist() == [0, 0, 0.5]
    assert scores.curve().false_alarms.tolist() == [0, 1, 1]


def test_precision_falls_with_false_alarms_above_the_hits() -> None:
    summary = scored(([box(40, 20, 8, 8, 0.9), box(0, 0, 10, 10, 0.5)], labels((0, 0, 10, 10)))).summary()
    assert summary["roi_ap"] == 0.5
    assert summary["recall_at_0.1_false_alarms"] == 0.0


def test_equal_scores_stand_or_fall_together() -> None:
    found = [box(0, 0, 10, 10, 0.5), box(40, 20, 8, 8, 0.5)]
    assert scored((found, labels((0, 0, 10, 10)))).summary()["roi_ap"] == 0.5


def test_a_mover_is_found_once() -> None:
    found = [box(0, 0, 10, 10, 0.9), box(0, 0, 10, 9, 0.8)]
    assert scored((found, labels((0, 0, 10, 10)))).summary()["false_alarms_per_frame"] == 1.0


def test_what_lies_in_an_ignored_box_does_not_count() -> None:
    found = [box(30, 20, 8, 8, 0.9), box(52, 30, 8, 8, 0.8)]
    summary = scored((found, labels((0, 0, 9, 9), ignored=((30, 20, 12, 12),)))).summary()
    assert (summary["movers"], summary["false_alarms_per_frame"], summary["roi_ap"]) == (1, 1.0, 0.0)


def test_recall_at_a_rate_of_false_alarms() -> None:
    frames = []
    for k in range(10):
        extra = [box(40, 20, 8, 8, 0.7)] if k == 0 else []
        frames.append(([box(0, 0, 10, 10, 0.9 if k < 5 else 0.6), *extra], labels((0, 0, 10, 10))))
    summary = scored(*frames).summary()
    assert summary["recall_at_0.1_false_alarms"] == 1.0
    assert summary["recall_at_0.01_false_alarms"] == 0.5


def test_frames_without_movers_have_no_precision_but_false_alarms() -> None:
    scores = scored(([box(0, 0, 5, 5, 0.9)], labels()), ([], labels()))
    summary = scores.summary()
    assert summary["roi_ap"] is None
    assert scores.average_precision() is None
    assert (summary["recall"], summary["precision"]) == (None, 0.0)
    assert summary["false_alarms_per_frame"] == 0.5


def test_nothing_at_all() -> None:
    summary = DetectionScores().summary()
    assert (summary["false_alarms_per_frame"], summary["false_alarms_per_minute"]) == (None, None)


def test_sizes_are_told_apart_and_alarms_belong_to_their_own() -> None:
    """A small mover is found, a large one missed; one small false alarm above the hit, one large one."""
    found = [box(0, 0, 10, 10, 0.8), box(100, 0, 10, 10, 0.9), box(100, 100, 60, 60, 0.95)]
    scores = scored((found, labels((0, 0, 10, 10), (200, 0, 60, 60))))
    small, large = scores.of_size("small"), scores.of_size("large")
    assert (len(small.movers), small.average_precision(), small.alarms()) == (1, 0.5, 1)
    assert (len(large.movers), large.average_precision(), large.alarms()) == (1, 0.0, 1)
    assert scores.of_size("medium").average_precision() is None
    assert (small.frames, small.seconds) == (1, STEP_S)


def test_what_found_a_mover_of_another_class_does_not_count() -> None:
    found = [box(0, 0, 10, 10, 0.9), box(100, 0, 60, 60, 0.8)]
    large = scored((found, labels((0, 0, 10, 10), (100, 0, 60, 60)))).of_size("large")
    assert (large.average_precision(), large.alarms()) == (1.0, 0)


def test_speeds_are_told_apart_and_every_alarm_counts() -> None:
    alarm = box(100, 0, 10, 10, 0.95)
    scores = scored(
        ([box(0, 0, 10, 10, 0.9), alarm], labels((0, 0, 10, 10), speed_px=1.5)),
        ([], labels((0, 0, 10, 10), speed_px=5.0)),
        ([], labels((0, 0, 10, 10), speed_px=None)),
    )
    assert {name: len(scores.of_speed(name).movers) for name in ("slow", "medium", "fast")} == {
        "slow": 1,
        "medium": 0,
        "fast": 1,
    }
    assert (scores.of_speed("slow").average_precision(), scores.of_speed("slow").alarms()) == (0.5, 1)
    assert (scores.of_speed("fast").average_precision(), scores.of_speed("fast").alarms()) == (0.0, 1)


def test_parts_add_up() -> None:
    frames = [
        ([box(0, 0, 10, 10, 0.9), box(40, 20, 8, 8, 0.6)], labels((0, 0, 10, 10))),
        ([box(40, 20, 8, 8, 0.7)], labels((0, 0, 10, 10))),
    ]
    merged = scored(frames[0])
    merged.merge(scored(frames[1]))
    assert merged.summary() == scored(*frames).summary()


def test_reliability_compares_scores_with_what_moves() -> None:
    scores = DetectionScores()
    mover = TrueObject(BoundingBox(0, 0, 10, 10), 5.0, counted=True)
    for hit in (True, True, True, False):  # three of four regions that score 0.8 find the mover
        scores.add_frame([box(0 if hit else 50, 0, 10, 10, 0.8)], Labels((mover,)), 0.1)
    scores.add_frame([box(50, 0, 10, 10, 1.0)], Labels(()), 0.1)
    low, high = scores.reliability()
    assert (low.regions, low.mean_score, low.share_moving) == (4, pytest.approx(0.8), 0.75)
    assert (high.low, high.high, high.regions, high.share_moving) == (0.9, 1.0, 1, 0.0)
    assert scores.calibration_error() == pytest.approx((4 * 0.05 + 1 * 1.0) / 5)
    assert DetectionScores().calibration_error() is None
    assert DetectionScores().reliability() == []


def test_the_label_decides_what_is_an_alarm() -> None:
    scores = DetectionScores()
    scores.add_frame([ScoredBox(BoundingBox(0, 0, 10, 10), 0.9, motion=False)], Labels(()), 0.1)
    assert scores.alarms() == 0
