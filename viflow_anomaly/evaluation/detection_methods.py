"""What is measured: detectors as they are configured, and rivals under several thresholds to choose from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import cv2
import numpy as np

from viflow_anomaly.config import MotorSource, RegionConfig
from viflow_anomaly.detection import decode_mask_rle
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.evaluation.detection_scores import ScoredBox
from viflow_anomaly.evaluation.labelled_pairs import BoolArray
from viflow_anomaly.evaluation.rivals import RIVALS, Evidence
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.regions import BoundingBox, find_regions
from viflow_anomaly.sensor_data import FramePair

OURS = "viflow-anomaly"
PLAIN_RESIDUAL = "plain residual"
PIXEL_SMOOTHING_PX = 1.2
"""Evidence is smoothed by this before pixels are judged, every method's alike."""


class Thresholds(NamedTuple):
    """What evidence is cut at (``RegionConfig``): gray levels have the first two, probabilities the last."""

    threshold_mads: float | None = None
    min_residual_gray: float | None = None
    min_motion_probability: float | None = None


RIVAL_THRESHOLDS = tuple(Thresholds(mads, gray) for mads in (3.0, 6.0, 12.0) for gray in (6.0, 12.0, 24.0, 48.0))


class Finding(NamedTuple):
    """Regions under one choice of thresholds.

    Attributes:
        thresholds: which.
        boxes: all regions.
        motion: [H, W] pixels of those labelled as independent motion.
    """

    thresholds: Thresholds
    boxes: tuple[ScoredBox, ...]
    motion: BoolArray


class Judgement(NamedTuple):
    """What a method says of a pair: evidence [H, W] float32 >= 0 where it is ``inside``, and its findings."""

    evidence: Float32Array
    inside: BoolArray
    findings: tuple[Finding, ...]


class DetectionMethod(Protocol):
    """Finds what moves. ``rival``: of its thresholds the best on the very frames that it is judged on are told."""

    @property
    def name(self) -> str:
        """Of its row."""

    @property
    def rival(self) -> bool:
        """Whether thresholds are chosen for it."""

    @property
    def motor_source(self) -> MotorSource | None:
        """What ``FramePair.motor_command`` must hold."""

    def judge(self, pair: FramePair) -> Judgement | None:
        """None where it has no answer (no calibration).

        Raises:
            InvalidInputError: the pair cannot be used.
        """


class DetectorMethod:
    """A detector, as a user runs it.

    Args:
        name: of its row.
        detector: with the configuration that is to be measured.
    """

    rival = False

    def __init__(self, name: str, detector: AnomalyDetector) -> None:
        self.name = name
        self.motor_source = detector.motor_source
        self._detector = detector.with_config(detector.config.model_copy(update={"include_masks": True}))

    def judge(self, pair: FramePair) -> Judgement:
        analysis = self._detector.analyze(pair)
        regions = self._detector.config.regions
        boxes, motion = [], np.zeros(analysis.inside.shape, np.bool_)
        for roi in analysis.detection.rois:
            box = roi.bbox
            moves = roi.label == "independent_motion"
            boxes.append(ScoredBox(BoundingBox(box.x, box.y, box.width, box.height), roi.score, moves))
            if moves and roi.mask_rle is not None:
                motion |= decode_mask_rle(roi.mask_rle)
        if analysis.learned:
            thresholds = Thresholds(min_motion_probability=regions.min_motion_probability)
        else:
            thresholds = Thresholds(regions.threshold_mads, regions.min_residual_gray)
        finding = Finding(thresholds, tuple(boxes), motion)
        return Judgement(_smoothed(analysis.evidence), analysis.inside, (finding,))


class RivalMethod:
    """Evidence of another kind, on our regions and the paper's shape rule, under ``RIVAL_THRESHOLDS``.

    Args:
        name: of its row.
        evidence: of a pair; None where it has no answer.
        config: of the regions, besides the thresholds.
        motor_source: what the evidence needs.
    """

    rival = True

    def __init__(
        self,
        name: str,
        evidence: Callable[[FramePair], Evidence | None],
        config: RegionConfig,
        motor_source: MotorSource | None = None,
    ) -> None:
        self.name = name
        self.motor_source = motor_source
        self._evidence = evidence
        self._configs = {
            thresholds: config.model_copy(
                update={
                    "threshold_mads": thresholds.threshold_mads,
                    "min_residual_gray": thresholds.min_residual_gray,
                    "shape_rule": "axis_aligned",
                    "motion_score": 0.5,
                }
            )
            for thresholds in RIVAL_THRESHOLDS
        }

    def judge(self, pair: FramePair) -> Judgement | None:
        found = self._evidence(pair)
        if found is None:
            return None
        findings = tuple(_finding(thresholds, found, config) for thresholds, config in self._configs.items())
        return Judgement(_smoothed(found.evidence), found.inside, findings)


def _finding(thresholds: Thresholds, found: Evidence, config: RegionConfig) -> Finding:
    regions = find_regions(found.evidence, found.inside, config).regions
    motion = np.zeros(found.inside.shape, np.bool_)
    for region in regions:
        if region.label == "independent_motion":
            x, y, width, height = region.bbox
            motion[y : y + height, x : x + width] |= region.mask
    boxes = (ScoredBox(region.bbox, region.score, region.label == "independent_motion") for region in regions)
    return Finding(thresholds, tuple(boxes), motion)


def plain_residual(detector: AnomalyDetector) -> RivalMethod:
    """The paper's own detector on the same weights: the winner's residual, neither corrected nor normalised."""
    config = detector.config
    plain = detector.with_config(
        config.model_copy(
            update={
                "correction": config.correction.model_copy(update={"enabled": False}),
                "regions": config.regions.model_copy(update={"texture_softening_gray": 0.0}),
                "evidence": "residual",
                "photometric_compensation": False,
                "residual": "winner",
            }
        )
    )

    def evidence(pair: FramePair) -> Evidence:
        analysis = plain.analyze(pair)
        return Evidence(analysis.residual, analysis.inside)

    return RivalMethod(PLAIN_RESIDUAL, evidence, config.regions, detector.motor_source)


def rival_methods(detector: AnomalyDetector, names: Sequence[str] | None = None) -> list[RivalMethod]:
    """The classical detectors and the plain residual, or those of ``names``."""
    config = detector.config.regions
    methods = [
        plain_residual(detector),
        *(RivalMethod(name, evidence, config) for name, evidence in RIVALS.items()),
    ]
    return [method for method in methods if names is None or method.name in names]


def _smoothed(evidence: Float32Array) -> Float32Array:
    return np.asarray(cv2.GaussianBlur(evidence, (0, 0), PIXEL_SMOOTHING_PX), dtype=np.float32)
