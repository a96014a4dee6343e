"""Candidates, and which of them are raised, on masks that are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import pytest
from drawn_methods import SHAPE, mask_of

from viflow_anomaly.config import CorrectionConfig, DetectorConfig, RegionConfig
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.detection import (
    AnalyzedRegion,
    Detection,
    ImageSize,
    ModelInfo,
    ResidualSummary,
    Roi,
    encode_mask_rle,
)
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.evaluation.candidate_alarms import CandidateCounts, count_candidates, count_raised, plain_config
from viflow_anomaly.regions import BoundingBox, RegionLabel

SAMPLE = Path(__file__).resolve().parents[2] / "samples" / "drone"
HEIGHT, WIDTH = SHAPE
POLE = BoundingBox(10, 5, 3, 40)
RAIL = BoundingBox(5, 50, 80, 3)
BUSH = BoundingBox(60, 10, 12, 12)
MOVES: RegionLabel = "independent_motion"
RESTS: RegionLabel = "model_error"


def roi(box: BoundingBox, label: RegionLabel) -> Roi:
    score = 0.8 if label == MOVES else 0.2
    sides = (float(box.width), float(box.height))
    mask = encode_mask_rle(mask_of(box))
    return Roi(1, label, score, box, *sides, sides[0] * sides[1], min(sides), 20.0, 30.0, mask_rle=mask)


def detection(*found: tuple[BoundingBox, RegionLabel], status: Literal["ok", "abstained"] = "ok") -> Detection:
    return Detection(
        source_timestamp_ns=0,
        target_timestamp_ns=1,
        image=ImageSize(WIDTH, HEIGHT),
        status=status,
        reasons=(),
        model=ModelInfo("drawn", "1", "0"),
        rois=tuple(roi(*one) for one in found),
        region_analyzed=AnalyzedRegion(0, 0, WIDTH, HEIGHT),
        residual=ResidualSummary(1.0, 1.0, 1.0),
    )


@pytest.mark.parametrize(
    ("alarms", "raised"),
    [
        ([], 0),
        ([POLE], 1),
        ([BoundingBox(12, 44, 5, 5)], 1),  # one pixel in common
        ([BoundingBox(13, 5, 5, 40)], 0),  # beside it
        ([BoundingBox(0, 0, 96, 64)], 3),  # one alarm over everything raises all
        ([POLE, BoundingBox(10, 5, 1, 1)], 1),  # two alarms on one candidate raise one
    ],
)
def test_a_candidate_is_raised_by_a_common_pixel(alarms: Sequence[BoundingBox], raised: int) -> None:
    candidates = [mask_of(box) for box in (POLE, RAIL, BUSH)]
    assert count_raised(candidates, [mask_of(box) for box in alarms]) == raised


def test_only_regions_labelled_as_motion_raise() -> None:
    counts = CandidateCounts()
    plain = detection((POLE, MOVES), (RAIL, MOVES), (BUSH, MOVES))
    counts.add(detection((POLE, RESTS), (BUSH, MOVES)), plain)  # labelled, dropped, raised
    summary = counts.summary()
    assert (summary["blobs"], summary["model_error_blobs"], summary["model_error_share"]) == (2, 1, 0.5)
    assert (summary["candidates"], summary["raised_candidates"]) == (3, 1)
    assert summary["suppressed_share"] == pytest.approx(2 / 3, abs=1e-4)
    assert summary["alarms_per_frame"] == 1.0


def test_a_candidate_counts_whatever_the_plain_detector_calls_it() -> None:
    counts = CandidateCounts()
    counts.add(detection((POLE, MOVES)), detection((POLE, RESTS), (RAIL, MOVES)))
    assert (counts.candidates, counts.raised) == (2, 1)


def test_counts_add_up_over_frames() -> None:
    counts, other = CandidateCounts(), CandidateCounts()
    counts.add(detection((POLE, MOVES)), detection((POLE, MOVES)))
    other.add(detection(status="abstained"), detection((POLE, MOVES), (RAIL, MOVES), (BUSH, MOVES)))
    counts.merge(other)
    assert counts == CandidateCounts(frames=2, abstained=1, blobs=1, alarms=1, candidates=4, raised=1)
    assert counts.summary()["suppressed_share"] == 0.75
    assert counts.summary()["alarms_per_frame"] == 0.5


def test_nothing_found_is_no_share() -> None:
    counts = CandidateCounts()
    assert counts.summary()["alarms_per_frame"] is None
    counts.add(detection(), detection())
    summary = counts.summary()
    assert (summary["model_error_share"], summary["suppressed_share"], summary["frames"]) == (None, None, 1)


def test_the_plain_detector_has_neither_shape_rule_nor_other_evidence() -> None:
    regions = RegionConfig(threshold_mads=7.0, motion_score=0.9, shape_rule="oriented", min_area_fraction=0.002)
    config = DetectorConfig(
        regions=regions, residual="minimum", photometric_compensation=True, correction=CorrectionConfig(rounds=2)
    )
    for corrected in (True, False):
        plain = plain_config(config, corrected=corrected)
        assert DetectorConfig.from_mapping(plain.model_dump(), where="plain") == plain
        assert (plain.residual, plain.photometric_compensation, plain.include_masks) == ("winner", False, True)
        assert (plain.correction.enabled, plain.correction.rounds) == (corrected, 2)
        assert (plain.regions.shape_rule, plain.regions.texture_softening_gray) == ("none", 0.0)
        assert (plain.regions.motion_score, plain.regions.min_residual_gray) == (0.5, 12.0)
        assert (plain.regions.threshold_mads, plain.regions.min_area_fraction) == (7.0, 0.002)


def test_detectors_are_counted_on_the_same_pairs() -> None:
    full = AnomalyDetector.from_checkpoint(threads=1)
    plain = [full.with_config(plain_config(full.config, corrected=corrected)) for corrected in (True, False)]
    pairs = RecordingPairs(open_recording(SAMPLE), motor_source=full.motor_source)[:2]
    corrected, predicted = count_candidates(full, plain, pairs)
    assert corrected.frames == predicted.frames == 2
    assert (corrected.blobs, corrected.alarms) == (predicted.blobs, predicted.alarms)
    assert corrected.blobs == sum(len(full.detect(pair).rois) for pair in pairs)
    assert corrected.candidates == sum(len(plain[0].detect(pair).rois) for pair in pairs)
    assert 0 <= corrected.raised <= corrected.candidates
