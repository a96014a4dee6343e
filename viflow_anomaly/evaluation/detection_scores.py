"""How good regions are: precision and recall of boxes, average precision, recall at a rate of false alarms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.evaluation.labelled_pairs import Labels, TrueObject
from viflow_anomaly.evaluation.pixel_scores import average_precision
from viflow_anomaly.regions import BoundingBox

MIN_IOU = 0.3
"""A region finds a mover when their boxes overlap this much."""
IGNORED_SHARE = 0.5
"""A region that lies this far in ignored boxes is neither right nor wrong."""
FALSE_ALARM_RATES = (0.1, 0.01)
"""False alarms a frame at which recall is told."""

SIZE_CLASSES: dict[str, tuple[float, float]] = {
    "small": (0, 400),
    "medium": (400, 2500),
    "large": (2500, float("inf")),
}
"""Area of a mover's box in pixels, from the first up to below the second: 20 x 20 and 50 x 50."""
SPEED_CLASSES: dict[str, tuple[float, float]] = {
    "slow": (0, 2),
    "medium": (2, 5),
    "fast": (5, float("inf")),
}
"""Independent motion in pixels a frame, likewise."""

RELIABILITY_BINS = 10

Curve = NDArray[np.float64]


class ScoredBox(NamedTuple):
    """A region as the ruler sees it; ``motion``: it is labelled ``independent_motion``. Curves are over all regions."""

    bbox: BoundingBox
    score: float
    motion: bool


class _Judged(NamedTuple):
    """A region that counts: what it found, or None for a false alarm."""

    score: float
    motion: bool
    found: TrueObject | None
    box_area_px: int


class ReliabilityBin(NamedTuple):
    """Regions that score from ``low`` up to below ``high``."""

    low: float
    high: float
    regions: int
    mean_score: float
    share_moving: float


class OperatingCurve(NamedTuple):
    """As the threshold on the score falls past each distinct score: [N] each, from (0, 0, 0) on."""

    recall: Curve
    precision: Curve
    false_alarms: Curve


@dataclass
class DetectionScores:
    """Collects the frames of a run. Boxes are matched greedily, highest score first, each mover once.

    Attributes:
        frames: that were judged.
        seconds: from each of them to its next frame, added up.
        movers: that were to be found.
    """

    frames: int = 0
    seconds: float = 0.0
    movers: list[TrueObject] = field(default_factory=list)
    _judged: list[_Judged] = field(default_factory=list)

    def add_frame(self, boxes: Sequence[ScoredBox], labels: Labels, seconds: float) -> None:
        """Match one frame's regions with its movers."""
        self.frames += 1
        self.seconds += seconds
        self.movers += [thing for thing in labels.objects if thing.counted]
        self._judged += [one for one in _matched(boxes, labels) if one is not None]

    @staticmethod
    def hits(boxes: Sequence[ScoredBox], labels: Labels) -> list[bool | None]:
        """Of each box, highest score first: whether it finds a mover; None where it counts neither way."""
        return [None if one is None else one.found is not None for one in _matched(boxes, labels)]

    def merge(self, other: DetectionScores) -> None:
        """Count all of ``other``, too."""
        self.frames += other.frames
        self.seconds += other.seconds
        self.movers += other.movers
        self._judged += other._judged

    def of_size(self, name: str) -> DetectionScores:
        """The movers of one of ``SIZE_CLASSES``; the others, what found them, and false alarms of another size are
        left out (as in COCO)."""
        low, high = SIZE_CLASSES[name]
        return self._part(lambda thing: low <= thing.box_area_px < high, lambda area_px: low <= area_px < high)

    def of_speed(self, name: str) -> DetectionScores:
        """The movers of one of ``SPEED_CLASSES``; the others and what found them are left out. A false alarm has no
        speed: all of them count in every class."""
        low, high = SPEED_CLASSES[name]
        return self._part(
            lambda thing: thing.independent_flow_px is not None and low <= thing.independent_flow_px < high,
            lambda _: True,
        )

    def _part(self, kept: Callable[[TrueObject], bool], alarm_counts: Callable[[int], bool]) -> DetectionScores:
        judged = [
            one for one in self._judged if (alarm_counts(one.box_area_px) if one.found is None else kept(one.found))
        ]
        return DetectionScores(self.frames, self.seconds, [thing for thing in self.movers if kept(thing)], judged)

    def average_precision(self) -> float | None:
        """None where there was nothing to find."""
        curve = self.curve()
        return average_precision(curve.recall, curve.precision) if self.movers else None

    def alarms(self) -> int:
        """False alarms as a user sees them: regions labelled as motion."""
        return sum(one.found is None and one.motion for one in self._judged)

    def summary(self) -> dict[str, Any]:
        """All figures; None where there was nothing to find, or nothing found."""
        curve = self.curve()
        any_movers = bool(self.movers)
        hits = sum(one.found is not None and one.motion for one in self._judged)
        alarms = self.alarms()
        return {
            "frames": self.frames,
            "seconds": round(self.seconds, 3),
            "movers": len(self.movers),
            "roi_ap": rounded(self.average_precision()),
            "best_f1": rounded(_best_f1(curve) if any_movers else None),
            "recall": rounded(hits / len(self.movers) if any_movers else None),
            "precision": rounded(hits / (hits + alarms) if hits + alarms else None),
            **{f"recall_at_{rate:g}_false_alarms": rounded(self._recall_at(rate, curve)) for rate in FALSE_ALARM_RATES},
            "score_ece": rounded(self.calibration_error()),
            "false_alarms_per_frame": rounded(alarms / self.frames if self.frames else None),
            "false_alarms_per_minute": rounded(60 * alarms / self.seconds if self.seconds else None),
        }

    def reliability(self) -> list[ReliabilityBin]:
        """Of the regions in each tenth of the score that holds any: their mean score, and which share moves."""
        edges = np.linspace(0, 1, RELIABILITY_BINS + 1)
        bins = []
        for low, high in pairwise(edges):
            inside = [one for one in self._judged if low <= one.score < high or (high == 1 and one.score == 1)]
            if inside:
                mean_score = float(np.mean([one.score for one in inside]))
                share = sum(one.found is not None for one in inside) / len(inside)
                bins.append(ReliabilityBin(float(low), float(high), len(inside), mean_score, share))
        return bins

    def calibration_error(self) -> float | None:
        """Expected calibration error: the mean gap between score and share, weighted by regions; None without any."""
        bins = self.reliability()
        total = sum(one.regions for one in bins)
        return sum(one.regions * abs(one.mean_score - one.share_moving) for one in bins) / total if total else None

    def curve(self) -> OperatingCurve:
        """Recall, precision and false alarms, as the threshold on the score falls past each distinct score."""
        judged = sorted(self._judged, key=lambda one: -one.score)
        hits = np.cumsum([0, *(one.found is not None for one in judged)])
        scores = np.array([one.score for one in judged])
        ends = np.flatnonzero(np.append(np.diff(scores) != 0, True)) + 1 if judged else np.array([], np.intp)
        ends = np.concatenate([[0], ends])
        return OperatingCurve(
            hits[ends] / max(len(self.movers), 1),
            hits[ends] / np.maximum(ends, 1),
            (ends - hits[ends]).astype(np.float64),
        )

    def _recall_at(self, per_frame: float, curve: OperatingCurve) -> float | None:
        if not self.movers:
            return None
        return float(curve.recall[curve.false_alarms <= per_frame * self.frames].max(initial=0.0))


def _matched(boxes: Sequence[ScoredBox], labels: Labels) -> list[_Judged | None]:
    """What each box found, highest score first; None: neither right nor wrong."""
    counted = [thing for thing in labels.objects if thing.counted]
    ignored = [thing.bbox for thing in labels.objects if not thing.counted]
    free = set(range(len(counted)))
    matched: list[_Judged | None] = []
    for box in sorted(boxes, key=lambda one: -one.score):
        overlaps = [(iou(box.bbox, counted[k].bbox), k) for k in sorted(free)]
        best, index = max(overlaps, default=(0.0, -1))
        area_px = box.bbox.width * box.bbox.height
        if best >= MIN_IOU:
            free.discard(index)
            matched.append(_Judged(box.score, box.motion, counted[index], area_px))
        elif _is_ignored(box.bbox, ignored):
            matched.append(None)
        else:
            matched.append(_Judged(box.score, box.motion, None, area_px))
    return matched


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


def _best_f1(curve: OperatingCurve) -> float:
    recall, precision = curve.recall, curve.precision
    return float((2 * recall * precision / np.maximum(recall + precision, 1e-9)).max())


def rounded(value: float | None) -> float | None:
    """Four digits; None stays."""
    return None if value is None else round(value, 4)
