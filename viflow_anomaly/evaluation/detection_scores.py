"""How good regions are: average precision of boxes, recall at a rate of false alarms, average precision of pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.evaluation.labelled_pairs import BoolArray, Labels
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.regions import BoundingBox

MIN_IOU = 0.3
"""A region finds a mover when their boxes overlap this much."""
IGNORED_SHARE = 0.5
"""A region that lies this far in ignored boxes is neither right nor wrong."""
PIXEL_BINS = 512
MOTION_SCORE = 0.5
"""Regions labelled ``independent_motion`` score at least this, others less; curves are over all of them."""


class ScoredBox(NamedTuple):
    """A region as the ruler sees it."""

    bbox: BoundingBox
    score: float


class _Judged(NamedTuple):
    score: float
    hit: bool


@dataclass
class DetectionScores:
    """Collects the frames of a run. Boxes are matched greedily, highest score first, each mover once."""

    frames: int = 0
    movers: int = 0
    judged: list[_Judged] = field(default_factory=list)
    _moving: NDArray[np.int64] = field(default_factory=lambda: np.zeros(PIXEL_BINS, np.int64))
    _static: NDArray[np.int64] = field(default_factory=lambda: np.zeros(PIXEL_BINS, np.int64))

    def add_frame(self, boxes: Sequence[ScoredBox], labels: Labels) -> None:
        """Match one frame's regions with its movers."""
        counted = [thing.bbox for thing in labels.objects if thing.counted]
        ignored = [thing.bbox for thing in labels.objects if not thing.counted]
        self.frames += 1
        self.movers += len(counted)
        free = set(range(len(counted)))
        for box in sorted(boxes, key=lambda one: -one.score):
            overlaps = [(iou(box.bbox, counted[k]), k) for k in sorted(free)]
            best, index = max(overlaps, default=(0.0, -1))
            if best >= MIN_IOU:
                free.discard(index)
                self.judged.append(_Judged(box.score, hit=True))
            elif not _is_ignored(box.bbox, ignored):
                self.judged.append(_Judged(box.score, hit=False))

    def add_pixels(self, evidence: Float32Array, inside: BoolArray, labels: Labels) -> None:
        """Count pixels by evidence [H, W] in 0..1; ignored movers and what left the image do not count."""
        bins = np.clip(evidence * PIXEL_BINS, 0, PIXEL_BINS - 1).astype(np.intp)
        judged = inside & ~labels.ignored
        self._moving += np.bincount(bins[judged & labels.moving], minlength=PIXEL_BINS)
        self._static += np.bincount(bins[judged & ~labels.moving], minlength=PIXEL_BINS)

    def summary(self) -> dict[str, float | int | None]:
        """All figures; None where there was nothing to find."""
        recall, precision, false_alarms = self._curve()
        return {
            "frames": self.frames,
            "movers": self.movers,
            "roi_ap": _rounded(_average_precision(recall, precision) if self.movers else None),
            "best_f1": _rounded(_best_f1(recall, precision) if self.movers else None),
            "recall_at_0.1_false_alarms": _rounded(self._recall_at(0.1, recall, false_alarms)),
            "recall_at_0.01_false_alarms": _rounded(self._recall_at(0.01, recall, false_alarms)),
            "false_alarms_per_frame": _rounded(self._alarms() / self.frames if self.frames else None),
            "pixel_ap": _rounded(self._pixel_ap()),
        }

    def _curve(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Recall, precision and false alarms, as the threshold on the score falls past each distinct score."""
        judged = sorted(self.judged, key=lambda one: -one.score)
        hits = np.cumsum([0, *(one.hit for one in judged)])
        scores = np.array([one.score for one in judged])
        ends = np.flatnonzero(np.append(np.diff(scores) != 0, True)) + 1 if judged else np.array([], np.intp)
        ends = np.concatenate([[0], ends])
        return (
            hits[ends] / max(self.movers, 1),
            hits[ends] / np.maximum(ends, 1),
            (ends - hits[ends]).astype(np.float64),
        )

    def _alarms(self) -> int:
        """False alarms as a user sees them: regions labelled as motion (their score is at least 0.5)."""
        return sum(not one.hit and one.score >= MOTION_SCORE for one in self.judged)

    def _recall_at(
        self, per_frame: float, recall: NDArray[np.float64], false_alarms: NDArray[np.float64]
    ) -> float | None:
        if not self.movers:
            return None
        return float(recall[false_alarms <= per_frame * self.frames].max(initial=0.0))

    def _pixel_ap(self) -> float | None:
        moving, static = (np.cumsum(counts[::-1]) for counts in (self._moving, self._static))
        if not moving[-1]:
            return None
        return _average_precision(moving / moving[-1], moving / np.maximum(moving + static, 1))


def iou(first: BoundingBox, second: BoundingBox) -> float:
    """Intersection over union of two boxes."""
    shared = _shared_px(first, second)
    return shared / (first.width * first.height + second.width * second.height - shared)


def _shared_px(first: BoundingBox, second: BoundingBox) -> int:
    width = min(first.x + first.width, second.x + second.width) - max(first.x, second.x)
    height = min(first.y + first.height, second.y + second.height) - max(first.y, second.y)
    return max(width, 0) * max(height, 0)


def _is_ignored(box: BoundingBox, ignored: Sequence[BoundingBox]) -> bool:
    return any(_shared_px(box, other) >= IGNORED_SHARE * box.width * box.height for other in ignored)


def _average_precision(recall: NDArray[np.float64], precision: NDArray[np.float64]) -> float:
    """Area under the curve, precision made monotone (as in PASCAL VOC since 2010)."""
    steps = np.diff(np.concatenate([[0.0], recall]))
    monotone = np.maximum.accumulate(precision[::-1])[::-1]
    return float((steps * monotone).sum())


def _best_f1(recall: NDArray[np.float64], precision: NDArray[np.float64]) -> float:
    return float((2 * recall * precision / np.maximum(recall + precision, 1e-9)).max())


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)
