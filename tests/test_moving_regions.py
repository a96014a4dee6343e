"""Regions of drawn probability maps."""

from __future__ import annotations

import numpy as np
import pytest

from viflow_anomaly.config import RegionConfig, RegionScore
from viflow_anomaly.evidence_cues import GEOMETRIC_CUES, PHOTOMETRIC_CUES, EvidenceCues
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.moving_regions import (
    BAND_SCORE,
    REGION_FEATURES,
    MotionMaps,
    find_moving_regions,
    measure_regions,
    probability_of,
    sigmoid,
)
from viflow_anomaly.regions import Region

SHAPE = (96, 128)
CONFIG = RegionConfig()


def cues(**values: float) -> EvidenceCues:
    """Constant geometric cues, by name with _ for spaces."""
    geometric = np.zeros((len(GEOMETRIC_CUES), SHAPE[0] // 4, SHAPE[1] // 4), np.float32)
    for name, value in values.items():
        geometric[GEOMETRIC_CUES.index(name.replace("_", " "))] = value
    return EvidenceCues(np.zeros((len(PHOTOMETRIC_CUES), *SHAPE), np.float32), geometric)


def maps(*boxes: tuple[slice, slice], probability: float = 0.9, seam: tuple[slice, slice] | None = None) -> MotionMaps:
    motion, seams = np.full(SHAPE, 0.02, np.float32), np.full(SHAPE, -5, np.float32)
    for box in boxes:
        motion[box] = probability
    if seam is not None:
        seams[seam] = 2.0
    return MotionMaps(motion, seams, np.zeros((2, SHAPE[0] // 4, SHAPE[1] // 4), np.float32))


def regions_of(
    drawn: MotionMaps, config: RegionConfig = CONFIG, score: RegionScore | None = None, **values: float
) -> list[Region]:
    inside = np.ones(SHAPE, np.bool_)
    residual: Float32Array = np.full(SHAPE, 7.0, np.float32)
    return find_moving_regions(drawn, cues(**values), inside, config, residual=residual, score=score or RegionScore())


BOX = (slice(20, 50), slice(30, 60))


def test_a_box_is_found_where_it_is() -> None:
    (region,) = regions_of(maps(BOX))
    assert region.bbox == (30, 20, 30, 30)
    assert (region.label, region.area_px, region.residual_mean) == ("independent_motion", 900, 7.0)
    assert region.score == pytest.approx(0.9, abs=1e-3)
    assert region.evidence["rule"] == "extended_in_x_and_y"


def test_what_certainly_rests_is_not_told() -> None:
    score = RegionScore(weights=(0.0,) * len(REGION_FEATURES), bias=-7.0)  # 0.0009
    assert regions_of(maps(BOX), score=score) == []
    (told,) = regions_of(maps(BOX), RegionConfig(min_score=0.0), score=score)
    assert (told.label, told.score) == ("model_error", pytest.approx(0.0009, abs=1e-4))


def test_nothing_is_found_outside_or_below_the_threshold() -> None:
    assert regions_of(maps(BOX, probability=0.14)) == []
    inside = np.zeros(SHAPE, np.bool_)
    drawn = maps(BOX)
    assert find_moving_regions(drawn, cues(), inside, CONFIG, residual=drawn.motion, score=RegionScore()) == []


def test_a_faint_thing_is_found_beside_a_certain_one_and_not_around_it() -> None:
    drawn = maps(BOX, (slice(60, 80), slice(80, 110)))
    drawn.motion[60:80, 80:110] = 0.3
    drawn.motion[15:55, 25:65] = np.maximum(drawn.motion[15:55, 25:65], 0.3)  # a faint rim
    certain, faint = regions_of(drawn)
    assert certain.bbox == (30, 20, 30, 30)
    assert faint.bbox == (80, 60, 30, 20)
    assert (certain.label, faint.label) == ("independent_motion", "model_error")
    assert faint.score == pytest.approx(0.3, abs=1e-3)
    assert [region.evidence["min_probability"] for region in (certain, faint)] == [0.5, 0.15]
    assert len(regions_of(drawn, RegionConfig(faint_motion_probability=0.5))) == 1


def test_two_that_touch_are_cut_along_their_seam() -> None:
    wide = (slice(20, 50), slice(30, 90))
    assert len(regions_of(maps(wide))) == 1
    left, right = sorted(regions_of(maps(wide, seam=(slice(20, 50), slice(57, 63)))), key=lambda one: one.bbox.x)
    assert left.bbox == (30, 20, 30, 30)
    assert right.bbox == (60, 20, 30, 30)
    assert left.area_px + right.area_px == 1800


def test_two_that_touch_are_divided_by_their_middles() -> None:
    drawn = maps((slice(16, 48), slice(24, 88)))
    rows, columns = np.mgrid[0 : SHAPE[0] // 4, 0 : SHAPE[1] // 4].astype(np.float32)
    middle = np.where(columns < 14, 9.5, 17.5)
    drawn = drawn._replace(offsets=np.stack([7.5 - rows, middle - columns]).astype(np.float32))
    boxes = sorted(region.bbox for region in regions_of(drawn))
    assert boxes == [(24, 16, 32, 32), (56, 16, 32, 32)]


def test_what_is_nothing_but_seam_is_no_region() -> None:
    assert regions_of(maps(BOX, seam=BOX)) == []


def test_a_band_is_model_error_and_scores_below_a_half() -> None:
    (region,) = regions_of(maps((slice(40, 43), slice(10, 100)), probability=0.99))
    assert region.label == "model_error"
    assert region.score == BAND_SCORE


@pytest.mark.parametrize(("side_px", "label"), [(10, "independent_motion"), (9, "model_error")])
def test_what_is_narrow_has_a_limit_of_its_own(side_px: int, label: str) -> None:
    fraction = 9.5 / float(np.hypot(*SHAPE))
    for box in ((slice(20, 50), slice(30, 30 + side_px)), (slice(20, 20 + side_px), slice(30, 60))):
        config = CONFIG.model_copy(update={"min_motion_extent_fraction": fraction, "min_x_extent_fraction": 0.5})
        assert only(regions_of(maps(box), config)).label == label


def only(regions: list[Region]) -> Region:
    (region,) = regions
    return region


def test_what_is_most_of_the_picture_is_model_error() -> None:
    (region,) = regions_of(maps((slice(4, 92), slice(4, 120)), probability=0.99))
    assert (region.label, region.score, region.evidence["rule"]) == ("model_error", BAND_SCORE, "most_of_the_picture")
    (region,) = regions_of(maps((slice(4, 92), slice(4, 70)), probability=0.99))
    assert region.label == "independent_motion"


def test_a_higher_motion_score_changes_the_label_alone() -> None:
    (low,), (high,) = (regions_of(maps(BOX), RegionConfig(motion_score=motion_score)) for motion_score in (0.5, 0.95))
    assert (low.label, high.label) == ("independent_motion", "model_error")
    assert low.score == high.score


def test_specks_are_left_out_and_many_regions_are_limited() -> None:
    assert regions_of(maps((slice(40, 42), slice(40, 42)))) == []
    boxes = [(slice(y, y + 8), slice(x, x + 8)) for y in range(0, 90, 12) for x in range(0, 120, 12)]
    assert len(regions_of(maps(*boxes), RegionConfig(max_regions=5))) == 5


def test_the_order_is_that_of_the_contract() -> None:
    drawn = maps(BOX, (slice(60, 80), slice(80, 110)), (slice(60, 80), slice(10, 40)))
    drawn.motion[BOX] = 0.95
    found = regions_of(drawn)
    assert [region.bbox.x for region in found] == [30, 10, 80]


def test_evidence_is_told_in_pixels() -> None:
    (region,) = regions_of(maps(BOX), remaining_flow_across=0.75, parallax=0.5, remaining_flow_along=-0.5)
    assert region.evidence["across_epipolar_px"] == pytest.approx(3.0)
    assert region.evidence["along_epipolar_px"] == pytest.approx(1.0)
    assert region.evidence["parallax_px"] == pytest.approx(4.0)


def test_a_fitted_score_weighs_the_features() -> None:
    weights = [0.0] * len(REGION_FEATURES)
    weights[REGION_FEATURES.index("parallax")] = -4.0
    score = RegionScore(weights=tuple(weights), bias=1.0)
    (near,), (far,) = (regions_of(maps(BOX), score=score, parallax=value) for value in (0.0, 0.5))
    assert near.score == pytest.approx(1 / (1 + np.exp(-1.0)), abs=1e-4)
    assert far.score == pytest.approx(1 / (1 + np.exp(1.0)), abs=1e-4)
    assert far.label == "model_error"


def test_features_are_as_many_as_their_names_and_finite_at_the_ends() -> None:
    for probability in (0.0, 1.0):
        drawn = maps(BOX, probability=max(probability, 0.6))
        drawn.motion[BOX][0, 0] = 1.0
        (measured,) = measure_regions(drawn, cues(), np.ones(SHAPE, np.bool_), CONFIG)
        assert measured.features.shape == (len(REGION_FEATURES),)
        assert np.isfinite(measured.features).all()
        assert 0 <= probability_of(measured.features, RegionScore()) <= 1


def test_the_sigmoid_knows_its_ends() -> None:
    logits = np.array([[-500.0, -80.0, 0.0, 2.0, 80.0, 500.0]], np.float32)
    np.testing.assert_allclose(sigmoid(logits), [[0, 0, 0.5, 1 / (1 + np.exp(-2)), 1, 1]], atol=1e-6)
