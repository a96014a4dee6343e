"""In worlds where nothing moves by itself: what a plain detector would raise as motion, and what the full one raises.

Every region found there is the model's error. Two shares say how much of it is kept from the user:

- **labelled**: of the *blobs*, the regions of the full detector whatever their label, those labelled ``model_error``.
- **suppressed**: of the *candidates*, the regions of the plain detector (``plain_config``: the photometric residual,
  no texture normalisation, no shape rule), those that are not raised. A candidate is *raised* when at least one of its
  pixels lies in a region that the full detector labels ``independent_motion``; one whose pixels are in no region at
  all (dropped), or only in regions labelled ``model_error``, is suppressed.

The first share alone can be had by finding many harmless blobs; the second is of what a user would have been shown.
A pair on which the full detector abstains raises nothing, and is counted as such.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from viflow_anomaly.config import DetectorConfig
from viflow_anomaly.detection import Detection, decode_mask_rle
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.evaluation.detection_scores import rounded
from viflow_anomaly.evaluation.labelled_pairs import BoolArray
from viflow_anomaly.sensor_data import FramePair

GOAL_SHARE = 0.95
PLAIN_MIN_RESIDUAL_GRAY = 12.0
"""Of the residual that is not normalised: twice what the normalised one is cut at by default."""

# What makes a detector plain. A field that changes the evidence (another kind of it than the residual) belongs here.
PLAIN_EVIDENCE: dict[str, Any] = {"evidence": "residual", "photometric_compensation": False, "residual": "winner"}
PLAIN_REGIONS: dict[str, Any] = {
    "texture_softening_gray": 0.0,
    "min_residual_gray": PLAIN_MIN_RESIDUAL_GRAY,
    "shape_rule": "none",
    "motion_score": 0.5,
}


def plain_config(config: DetectorConfig, *, corrected: bool) -> DetectorConfig:
    """The configuration that finds candidates.

    Args:
        config: of the full detector; what is not evidence or shape stays (morphology, smallest area).
        corrected: the motion as the full detector corrects it; False: as predicted, the paper's.
    """
    correction = config.correction if corrected else config.correction.model_copy(update={"enabled": False})
    regions = config.regions.model_copy(update=PLAIN_REGIONS)
    changes = {**PLAIN_EVIDENCE, "correction": correction, "regions": regions, "include_masks": True}
    return config.model_copy(update=changes)


def count_raised(candidates: Sequence[BoolArray], alarms: Sequence[BoolArray]) -> int:
    """How many of the masks [H, W] have a pixel in common with one of ``alarms``."""
    return sum(any(bool((candidate & alarm).any()) for alarm in alarms) for candidate in candidates)


@dataclass
class CandidateCounts:
    """Counts over pairs.

    Attributes:
        frames: pairs judged; ``abstained``: of these, by the full detector.
        blobs: regions of the full detector; ``alarms``: those labelled as motion.
        candidates: regions of the plain detector; ``raised``: those that an alarm overlaps.
    """

    frames: int = 0
    abstained: int = 0
    blobs: int = 0
    alarms: int = 0
    candidates: int = 0
    raised: int = 0

    def add(self, full: Detection, plain: Detection) -> None:
        """Count one pair; both detections hold masks."""
        alarms = _masks(full, moving_only=True)
        candidates = _masks(plain, moving_only=False)
        self.merge(
            CandidateCounts(
                frames=1,
                abstained=int(full.status == "abstained"),
                blobs=len(full.rois),
                alarms=len(alarms),
                candidates=len(candidates),
                raised=count_raised(candidates, alarms),
            )
        )

    def merge(self, other: CandidateCounts) -> None:
        """Count all of ``other``, too."""
        self.frames += other.frames
        self.abstained += other.abstained
        self.blobs += other.blobs
        self.alarms += other.alarms
        self.candidates += other.candidates
        self.raised += other.raised

    def summary(self) -> dict[str, Any]:
        """Counts and both shares; None where there was nothing to share out."""
        return {
            "frames": self.frames,
            "abstained": self.abstained,
            "blobs": self.blobs,
            "model_error_blobs": self.blobs - self.alarms,
            "model_error_share": rounded(1 - self.alarms / self.blobs if self.blobs else None),
            "alarms_per_frame": rounded(self.alarms / self.frames if self.frames else None),
            "candidates": self.candidates,
            "raised_candidates": self.raised,
            "suppressed_share": rounded(1 - self.raised / self.candidates if self.candidates else None),
        }


def _masks(detection: Detection, *, moving_only: bool) -> list[BoolArray]:
    rois = [roi for roi in detection.rois if roi.label == "independent_motion" or not moving_only]
    masks = []
    for roi in rois:
        assert roi.mask_rle is not None, "the detectors here are told to give masks"
        masks.append(decode_mask_rle(roi.mask_rle))
    return masks


def count_candidates(
    full: AnomalyDetector, plain: Sequence[AnomalyDetector], pairs: Iterable[FramePair]
) -> tuple[CandidateCounts, ...]:
    """The counts of ``full`` against the candidates of each of ``plain``, over static pairs.

    Args:
        full: as it is configured; masks are switched on.
        plain: under a ``plain_config``.
        pairs: of scenes in which nothing moves by itself.

    Raises:
        InvalidInputError: a pair that cannot be used.
    """
    full = full.with_config(full.config.model_copy(update={"include_masks": True}))
    counts = tuple(CandidateCounts() for _ in plain)
    for pair in pairs:
        detection = full.detect(pair)
        for one, detector in zip(counts, plain, strict=True):
            one.add(detection, detector.detect(pair))
    return counts
