"""Labelled pairs and methods that are drawn, so that every figure can be worked out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from viflow_anomaly.config import MotorSource
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.evaluation.detection_methods import Finding, Judgement, Thresholds
from viflow_anomaly.evaluation.detection_scores import ScoredBox
from viflow_anomaly.evaluation.labelled_pairs import Labels, Pixels, TrueObject
from viflow_anomaly.regions import BoundingBox
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples

SHAPE = (64, 96)
STAMPS = np.arange(0, 400_000_001, 5_000_000)
IMU = ImuSamples(STAMPS, np.zeros((len(STAMPS), 3)), None)
LOW, HIGH = Thresholds(3.0, 6.0), Thresholds(6.0, 12.0)
MOVER = BoundingBox(10, 10, 10, 10)
ELSEWHERE = BoundingBox(60, 40, 10, 10)


def mask_of(box: BoundingBox) -> np.ndarray:
    mask = np.zeros(SHAPE, np.bool_)
    mask[box.y : box.y + box.height, box.x : box.x + box.width] = True
    return mask


@dataclass
class DrawnPairs:
    """Frames 100 ms apart; in each the objects of ``movers``."""

    sequence: str
    group: str
    frames: int = 2
    movers: Sequence[TrueObject] = (TrueObject(MOVER, 4.0, counted=True),)
    masks: bool = True
    unusable: Sequence[int] = ()

    def __len__(self) -> int:
        return self.frames

    def pair(self, index: int, motor_source: MotorSource | None = None) -> FramePair:
        if index in self.unusable:
            raise InvalidInputError("no IMU", code="imu_not_covering")
        image = np.full(SHAPE, 10 * index, np.uint8)
        command = None if motor_source is None else np.ones(2)
        return FramePair(Frame(100_000_000, image), Frame(200_000_000, image), IMU, None, command)

    def labels(self, index: int) -> Labels:
        pixels = None
        if self.masks:
            pixels = Pixels(np.zeros(SHAPE, np.bool_), np.zeros(SHAPE, np.bool_))
            for thing in self.movers:
                pixels.moving[mask_of(thing.bbox)] = True
        return Labels(tuple(self.movers), pixels)


@dataclass
class DrawnMethod:
    """Boxes under each pair of thresholds; what is found with a score from 0.5 on is labelled as motion."""

    name: str
    boxes: dict[Thresholds, Sequence[tuple[BoundingBox, float]]]
    rival: bool = False
    motor_source: MotorSource | None = None
    answers: Callable[[FramePair], bool] = lambda pair: True
    seen: list[FramePair] = field(default_factory=list)

    def judge(self, pair: FramePair) -> Judgement | None:
        self.seen.append(pair)
        if not self.answers(pair):
            return None
        findings = []
        evidence = np.zeros(SHAPE, np.float32)
        for thresholds, boxes in self.boxes.items():
            motion = np.zeros(SHAPE, np.bool_)
            for box, score in boxes:
                evidence[mask_of(box)] = score
                motion |= mask_of(box) & (score >= 0.5)
            findings.append(Finding(thresholds, tuple(ScoredBox(*one, one[1] >= 0.5) for one in boxes), motion))
        return Judgement(evidence, np.ones(SHAPE, np.bool_), tuple(findings))
