"""What regions are found in: the evidence head's probabilities of motion, or the residual alone (the paper's)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from viflow_anomaly.checkpoint_record import EvidenceRecord
from viflow_anomaly.config import MAX_OFFSET_BLOCKS, DetectorConfig, ModelConfig
from viflow_anomaly.errors import CheckpointError
from viflow_anomaly.evidence_cues import CUES_VERSION, GEOMETRIC_CUES, PHOTOMETRIC_CUES, EvidenceCues
from viflow_anomaly.explanation import Explanation
from viflow_anomaly.moving_regions import REGION_FEATURES, MotionMaps, find_moving_regions, sigmoid
from viflow_anomaly.prediction import PredictedFlow
from viflow_anomaly.regions import Region, find_regions
from viflow_anomaly.runtime.loading import LoadedEvidence


class JudgedCues(NamedTuple):
    """What the evidence head was shown, and what it says."""

    cues: EvidenceCues
    maps: MotionMaps


def require_our_cues(record: EvidenceRecord) -> None:
    """A head must have learned from the cues of this version, and score what this version measures of a region.

    Raises:
        CheckpointError: ``evidence_cues_differ``, ``checkpoint_record_invalid``.
    """
    expected = (PHOTOMETRIC_CUES, GEOMETRIC_CUES, CUES_VERSION)
    found = (record.photometric_cues, record.geometric_cues, record.cues_version)
    if expected[:2] == found[:2] and record.cues_version != CUES_VERSION:
        raise CheckpointError(
            f"evidence head {record.name} {record.version}: expected one trained on cues_version {CUES_VERSION}, "
            f"found {record.cues_version}; train it anew (train-evidence)",
            code="evidence_cues_differ",
            field="evidence_head",
        )
    if expected != found:
        raise CheckpointError(
            f"evidence head {record.name} {record.version}: expected one that was trained on the cues (names, "
            f"version) {expected}, found {found}",
            code="evidence_cues_differ",
            field="evidence_head",
        )
    if len(record.region_score.weights) not in (0, len(REGION_FEATURES)):
        raise CheckpointError(
            f"evidence head {record.name} {record.version}: expected {len(REGION_FEATURES)} weights in region_score "
            f"(or none), found {len(record.region_score.weights)}",
            code="checkpoint_record_invalid",
            field="evidence_head",
        )


def takes_head(head: LoadedEvidence | None, config: DetectorConfig, *, depth_is_known: bool) -> bool:
    """Whether the head judges a pair: "auto" wants a network that knows depth, as the head was trained on."""
    if head is None or config.evidence == "residual":
        return False
    return config.evidence == "learned" or depth_is_known


def will_know_depth(model: ModelConfig, config: DetectorConfig) -> bool:
    """Before a pair is seen: of the networks the calibrated one knows depth, where it is corrected."""
    return model.preset == "calibrated" and config.correction.enabled


def knows_depth(predicted: PredictedFlow) -> bool:
    """What a network said of a pair comes of depth and a camera's motion."""
    return predicted.correction is not None and predicted.correction.motion is not None


def judge_cues(head: LoadedEvidence, cues: EvidenceCues, explanation: Explanation) -> JudgedCues:
    """The head's probabilities of one pair, at the source image's size."""
    height, width = explanation.source.shape
    answer = head.runtime.judge(*cues)
    logits = answer.logits[:, :height, :width]
    offsets = np.clip(answer.offsets, -MAX_OFFSET_BLOCKS, MAX_OFFSET_BLOCKS)
    return JudgedCues(cues, MotionMaps(sigmoid(np.ascontiguousarray(logits[0])), logits[1], offsets))


def regions_of(
    explanation: Explanation, judged: JudgedCues | None, head: LoadedEvidence | None, config: DetectorConfig
) -> Sequence[Region]:
    """All regions, highest score first; ``judged`` None: in the normalised residual."""
    residual, inside = explanation.residual, explanation.inside
    if judged is None or head is None:
        return find_regions(explanation.normalised, inside, config.regions, residual=residual).regions
    score = head.record.region_score
    return find_moving_regions(judged.maps, judged.cues, inside, config.regions, residual=residual, score=score)
