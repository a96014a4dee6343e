"""The measurement: every method on the same labelled pairs, the same regions and the same ruler.

A rival's thresholds are those of ``RIVAL_THRESHOLDS`` that give its best average precision on the very frames it is
judged on; ours are the configuration's.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from viflow_anomaly.config import MotorSource
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.evaluation.detection_methods import DetectionMethod, Judgement, Thresholds
from viflow_anomaly.evaluation.detection_scores import DetectionScores
from viflow_anomaly.evaluation.labelled_pairs import LabelledPairs, Labels, every_nth
from viflow_anomaly.evaluation.pixel_scores import MaskScores, PixelScores
from viflow_anomaly.sensor_data import FramePair


@dataclass
class FindingScores:
    """Under one choice of thresholds: boxes, and the pixels of what is labelled as motion."""

    boxes: DetectionScores = field(default_factory=DetectionScores)
    masks: MaskScores = field(default_factory=MaskScores)

    def merge(self, other: FindingScores) -> None:
        """Count all of ``other``, too."""
        self.boxes.merge(other.boxes)
        self.masks.merge(other.masks)


@dataclass
class MethodScores:
    """One method on some pairs: findings by thresholds, pixels (which know no threshold)."""

    findings: dict[Thresholds, FindingScores] = field(default_factory=dict)
    pixels: PixelScores = field(default_factory=PixelScores)

    def add(self, judgement: Judgement, labels: Labels, seconds: float) -> None:
        """Count one pair."""
        for thresholds, boxes, motion in judgement.findings:
            scores = self.findings.setdefault(thresholds, FindingScores())
            scores.boxes.add_frame(boxes, labels, seconds)
            if labels.pixels is not None:
                scores.masks.add(motion, judgement.inside, labels.pixels)
        if labels.pixels is not None:
            self.pixels.add(judgement.evidence, judgement.inside, labels.pixels)

    def merge(self, other: MethodScores) -> None:
        """Count all of ``other``, too."""
        for thresholds, scores in other.findings.items():
            self.findings.setdefault(thresholds, FindingScores()).merge(scores)
        self.pixels.merge(other.pixels)

    def best(self) -> Thresholds | None:
        """The thresholds of the best average precision of boxes; None where there was nothing to find."""
        precisions = {key: scores.boxes.average_precision() for key, scores in self.findings.items()}
        known = {key: value for key, value in precisions.items() if value is not None}
        return max(known, key=lambda key: known[key]) if known else None


ByMethod = dict[str, MethodScores]


class SequenceKey(NamedTuple):
    """A sequence, and the group that it belongs to."""

    group: str
    sequence: str


@dataclass(frozen=True)
class DetectionMeasurement:
    """What a run found.

    Attributes:
        rivals: method -> whether thresholds are chosen for it, in the order that they were given.
        sequences: scores by sequence and method; a method without any answer there is not in them.
        skipped: pairs that were judged by no method (no usable IMU), by reason.
    """

    rivals: Mapping[str, bool]
    sequences: Mapping[SequenceKey, ByMethod]
    skipped: Mapping[str, int] = field(default_factory=dict)

    def groups(self) -> dict[str, ByMethod]:
        """By group, sorted."""
        names = sorted({key.group for key in self.sequences})
        return {name: self._merged(some for key, some in self.sequences.items() if key.group == name) for name in names}

    def total(self) -> ByMethod:
        """Of all pairs."""
        return self._merged(self.sequences.values())

    def _merged(self, parts: Iterable[ByMethod]) -> ByMethod:
        merged: ByMethod = {name: MethodScores() for name in self.rivals}
        for part in parts:
            for name, scores in part.items():
                merged[name].merge(scores)
        return {name: scores for name, scores in merged.items() if scores.findings}


def measure_detection(
    methods: Sequence[DetectionMethod],
    sequences: Sequence[LabelledPairs],
    *,
    every: int = 1,
    on_progress: Callable[[int, int], None] | None = None,
) -> DetectionMeasurement:
    """Judge every n-th pair of each sequence by every method.

    Args:
        methods: with names that differ.
        sequences: with labels.
        every: n.
        on_progress: called with (done, total) after each pair.

    Raises:
        DatasetError: ``ground_truth_missing`` when no pair can be judged; as the sequences raise.
    """
    assert len({method.name for method in methods}) == len(methods)
    chosen = every_nth(sequences, every)
    scores: dict[SequenceKey, ByMethod] = {}
    skipped: Counter[str] = Counter()
    for done, (pairs, index) in enumerate(chosen, start=1):
        try:
            judgements = _judge(methods, pairs, index)
        except InvalidInputError as err:
            skipped[err.code] += 1
        else:
            by_method = scores.setdefault(SequenceKey(pairs.group, pairs.sequence), {})
            labels = pairs.labels(index)
            for name, (judgement, seconds) in judgements.items():
                by_method.setdefault(name, MethodScores()).add(judgement, labels, seconds)
        if on_progress is not None:
            on_progress(done, len(chosen))
    if sum(skipped.values()) == len(chosen):
        raise DatasetError(
            f"expected a pair that can be judged, found none among {len(chosen)} (left out: {dict(skipped)})",
            code="ground_truth_missing",
        )
    return DetectionMeasurement({method.name: method.rival for method in methods}, scores, dict(skipped))


def _judge(methods: Sequence[DetectionMethod], pairs: LabelledPairs, index: int) -> dict[str, tuple[Judgement, float]]:
    """Each method's answer with the seconds to the next frame; a pair counts for all methods or for none."""
    read: dict[MotorSource | None, FramePair] = {}
    for motor_source in {method.motor_source for method in methods}:
        read[motor_source] = pairs.pair(index, motor_source)
    answers = {}
    for method in methods:
        pair = read[method.motor_source]
        judgement = method.judge(pair)
        if judgement is not None:
            answers[method.name] = (judgement, pair.interval_ns * 1e-9)
    return answers
