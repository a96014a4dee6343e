"""The shape rule on pictures drawn as text, one character a cell, and what must hold for any residual."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pydantic import ValidationError

from viflow_anomaly.config import RegionConfig
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.regions import BoundingBox, Region, RegionResult, find_regions

# Nothing is smoothed or cleaned, so that a drawing means its pixels; the shape rule keeps its defaults.
LITERAL = RegionConfig(smoothing_fraction=0, opening_fraction=0, closing_fraction=0, min_area_fraction=0)
CELL_PX = 8

SQUARE = """
................
................
....####........
....####........
....####........
....####........
................
................
................
................
................
................
"""
HORIZONTAL_BAND = """
................
................
................
.##############.
................
................
................
................
................
................
................
................
"""
VERTICAL_BAND = """
................
.......#........
.......#........
.......#........
.......#........
.......#........
.......#........
.......#........
.......#........
.......#........
.......#........
................
"""
# Documented weakness of the paper's axis-aligned rule: thin, but extended in X and in Y.
DIAGONAL_BAND = """
................
..#.............
...#............
....#...........
.....#..........
......#.........
.......#........
........#.......
.........#......
..........#.....
...........#....
................
"""
L_SHAPE = """
................
..#.............
..#.............
..#.............
..#.............
..#.............
..#.............
..##########....
................
................
................
................
"""
TWO_SQUARES = """
................
................
..###.....###...
..###.....###...
..###.....###...
................
................
..###...........
..###...........
..###...........
................
................
"""
TOUCHING_AT_A_CORNER = """
................
................
..###...........
..###...........
..###...........
.....###........
.....###........
.....###........
................
................
................
................
"""


def drawn(picture: str, *, cell_px: int = CELL_PX, gray: float = 60.0, noise: bool = True) -> np.ndarray:
    """[H, W] float32: cells of '#' at ``gray``, the rest faint noise."""
    cells = np.array([[character == "#" for character in line] for line in picture.split()])
    mask = np.kron(cells, np.ones((cell_px, cell_px), dtype=np.bool_))
    background = np.random.default_rng(0).uniform(0, 4, mask.shape) if noise else np.zeros(mask.shape)
    return np.where(mask, gray, background).astype(np.float32)


def found(residual: np.ndarray, config: RegionConfig = LITERAL, inside: np.ndarray | None = None) -> RegionResult:
    return find_regions(residual, np.ones(residual.shape, np.bool_) if inside is None else inside, config)


def only(result: RegionResult) -> Region:
    (region,) = result.regions
    return region


class TestShapeRule:
    @pytest.mark.parametrize(
        ("picture", "cell_px", "label", "rule"),
        [
            (SQUARE, CELL_PX, "independent_motion", "extended_in_x_and_y"),
            (L_SHAPE, CELL_PX, "independent_motion", "extended_in_x_and_y"),
            (DIAGONAL_BAND, CELL_PX, "independent_motion", "extended_in_x_and_y"),
            (TOUCHING_AT_A_CORNER, CELL_PX, "independent_motion", "extended_in_x_and_y"),
            (HORIZONTAL_BAND, CELL_PX, "model_error", "band_by_aspect_ratio"),
            (VERTICAL_BAND, CELL_PX, "model_error", "band_by_aspect_ratio"),
        ],
    )
    def test_label(self, picture: str, cell_px: int, label: str, rule: str) -> None:
        region = only(found(drawn(picture, cell_px=cell_px)))
        assert (region.label, region.evidence["rule"]) == (label, rule)

    @pytest.mark.parametrize(
        ("width", "height", "rule"),
        [(2, 60, "narrow_in_x"), (60, 2, "narrow_in_y"), (2, 2, "narrow_in_x_and_y"), (20, 20, "extended_in_x_and_y")],
    )
    def test_each_side_is_judged_by_itself(self, width: int, height: int, rule: str) -> None:
        residual = np.zeros((100, 200), np.float32)
        residual[10 : 10 + height, 30 : 30 + width] = 80
        region = only(found(residual, LITERAL.model_copy(update={"max_aspect_ratio": 1000.0})))
        assert region.evidence["rule"] == rule
        assert (region.label == "model_error") == (rule != "extended_in_x_and_y")

    def test_the_limits_are_fractions_of_the_diagonal(self) -> None:
        residual = np.zeros((300, 400), np.float32)
        residual[10:20, 10:20] = 80
        for fraction, label in ((10 / 500, "independent_motion"), (10.1 / 500, "model_error")):
            for name in ("min_x_extent_fraction", "min_y_extent_fraction"):
                assert only(found(residual, LITERAL.model_copy(update={name: fraction}))).label == label

    def test_the_aspect_limit_is_inclusive(self) -> None:
        residual = np.zeros((100, 100), np.float32)
        residual[10:20, 10:60] = 80
        assert only(found(residual)).label == "independent_motion"
        assert only(found(residual, LITERAL.model_copy(update={"max_aspect_ratio": 4.9}))).label == "model_error"


class TestMeasures:
    def test_numbers_of_a_square(self) -> None:
        residual = drawn(SQUARE)
        residual[20, 40] = 90
        region = only(found(residual))
        assert region.bbox == BoundingBox(32, 16, 32, 32)
        assert (region.x_extent_px, region.y_extent_px, region.area_px) == (32, 32, 1024)
        assert region.thickness_px == pytest.approx(31, abs=1.5)
        assert region.residual_mean == pytest.approx(60 + 30 / 1024)
        assert region.residual_max == 90
        assert region.mask.shape == (32, 32)
        assert region.mask.all()
        assert region.evidence["fill_ratio"] == 1
        assert region.evidence["aspect_ratio"] == 1
        assert region.evidence["threshold_gray"] == pytest.approx(found(residual).threshold)

    def test_thickness_tells_a_diagonal_band_from_a_square(self) -> None:
        diagonal = only(found(drawn(DIAGONAL_BAND)))
        assert diagonal.x_extent_px == diagonal.y_extent_px == 10 * CELL_PX
        assert diagonal.thickness_px < 1.5 * CELL_PX
        assert diagonal.score < only(found(drawn(SQUARE))).score

    @pytest.mark.parametrize("side", [(1, 30), (30, 1)])
    def test_a_line_one_pixel_wide_is_one_pixel_thick(self, side: tuple[int, int]) -> None:
        residual = np.zeros((60, 60), np.float32)
        residual[5 : 5 + side[0], 5 : 5 + side[1]] = 80
        assert only(found(residual)).thickness_px == pytest.approx(1)

    def test_a_crop_shows_only_its_own_component(self) -> None:
        residual = drawn(L_SHAPE)
        residual[20:30, 60:70] = 80
        big, small = sorted(found(residual).regions, key=lambda region: -region.area_px)
        assert big.mask.sum() == big.area_px < big.mask.size
        assert small.bbox == BoundingBox(60, 20, 10, 10)


class TestThreshold:
    def test_it_follows_the_noise(self) -> None:
        noise = np.abs(np.random.default_rng(1).normal(0, 10, (120, 160))).astype(np.float32)
        median = float(np.median(noise))
        mad = float(np.median(np.abs(noise - median)))
        assert found(noise).threshold == pytest.approx(median + 6 * 1.4826 * mad, rel=0.05)

    def test_it_never_falls_below_the_minimum(self) -> None:
        residual = np.zeros((64, 64), np.float32)
        residual[10:30, 10:30] = 5.9
        result = found(residual)
        assert result.threshold == 6.0
        assert result.regions == ()
        assert only(found(residual, LITERAL.model_copy(update={"min_residual_gray": 5.0}))).area_px == 400

    def test_evidence_decides_and_the_residual_is_told(self) -> None:
        evidence, residual = np.zeros((64, 64), np.float32), np.full((64, 64), 3.0, np.float32)
        evidence[10:30, 10:30], residual[10:30, 10:30] = 40.0, 20.0
        residual[12, 12] = 50.0
        region = only(find_regions(evidence, np.ones((64, 64), np.bool_), LITERAL, residual=residual))
        assert region.residual_max == 50.0
        assert region.residual_mean == pytest.approx((399 * 20 + 50) / 400)

    def test_pixels_outside_have_no_say_and_no_region(self) -> None:
        residual = drawn(TWO_SQUARES)
        inside = np.ones(residual.shape, np.bool_)
        inside[:, :64] = False
        residual[:, :64] += 50
        region = only(found(residual, inside=inside))
        assert region.bbox == BoundingBox(80, 16, 24, 24)

    def test_closing_does_not_reach_outside(self) -> None:
        residual = np.zeros((100, 100), np.float32)
        residual[40:60, 20:40] = residual[40:60, 44:60] = 80
        inside = np.ones(residual.shape, np.bool_)
        inside[:, 41:43] = False
        config = LITERAL.model_copy(update={"closing_fraction": 0.08})
        result = found(residual, config, inside)
        assert not (result.mask & ~inside).any()

    @pytest.mark.parametrize("value", [0.0, 200.0])
    def test_nothing_inside(self, value: float) -> None:
        residual = np.full((48, 64), value, np.float32)
        result = found(residual, RegionConfig(), np.zeros(residual.shape, np.bool_))
        assert result.regions == ()
        assert result.threshold == RegionConfig().min_residual_gray
        assert not result.mask.any()

    @pytest.mark.parametrize("value", [0.0, 5.0, 255.0])
    def test_an_even_residual_has_no_regions(self, value: float) -> None:
        assert found(np.full((48, 64), value, np.float32), RegionConfig()).regions == ()


class TestCleaning:
    def test_opening_removes_specks(self) -> None:
        residual = drawn(SQUARE)
        residual[80:82, 100:102] = 80
        assert len(found(residual).regions) == 2
        assert only(found(residual, LITERAL.model_copy(update={"opening_fraction": 0.02}))).bbox.x == 32

    def test_closing_joins_the_parts_of_one_object(self) -> None:
        residual = np.zeros((100, 100), np.float32)
        residual[30:60, 20:40] = residual[30:60, 44:60] = 80
        assert len(found(residual).regions) == 2
        joined = only(found(residual, LITERAL.model_copy(update={"closing_fraction": 0.06})))
        assert joined.bbox == BoundingBox(20, 30, 40, 30)
        assert joined.area_px == 1200

    def test_parts_farther_than_the_closing_stay_apart(self) -> None:
        residual = np.zeros((100, 100), np.float32)
        residual[30:60, 20:40] = residual[30:60, 52:70] = 80
        assert len(found(residual, LITERAL.model_copy(update={"closing_fraction": 0.06})).regions) == 2

    def test_small_components_are_dropped(self) -> None:
        residual = np.zeros((100, 100), np.float32)
        residual[10:15, 10:15] = residual[40:60, 40:60] = 80
        for fraction, count in ((0.0024, 2), (0.0026, 1), (0.05, 0)):
            assert len(found(residual, LITERAL.model_copy(update={"min_area_fraction": fraction})).regions) == count

    def test_smoothing_lifts_a_broad_faint_patch_over_sharp_noise(self) -> None:
        noise = np.random.default_rng(2).uniform(0, 20, (120, 160)).astype(np.float32)
        noise[40:80, 50:100] += 15
        config = LITERAL.model_copy(update={"smoothing_fraction": 0.02, "min_area_fraction": 0.01})
        region = only(found(noise, config))
        assert (region.bbox.x, region.bbox.y) == (pytest.approx(50, abs=4), pytest.approx(40, abs=4))


class TestScoreAndOrder:
    def test_motion_scores_above_half_and_model_error_below(self) -> None:
        for picture in (SQUARE, HORIZONTAL_BAND, VERTICAL_BAND, DIAGONAL_BAND):
            for gray in (20.0, 60.0, 255.0):
                region = only(found(drawn(picture, gray=gray)))
                assert (region.score > 0.5) == (region.label == "independent_motion")
                assert 0 < region.score < 1

    @pytest.mark.parametrize("picture", [SQUARE, VERTICAL_BAND])
    def test_score_rises_with_contrast(self, picture: str) -> None:
        scores = [only(found(drawn(picture, gray=gray))).score for gray in (16, 24, 40, 80, 160, 255)]
        assert scores == sorted(set(scores))

    def test_highest_score_first(self) -> None:
        residual = drawn(TWO_SQUARES, noise=False)
        residual[56:80, 16:40] = 150
        first, *rest = found(residual).regions
        assert first.bbox.y == 56
        assert first.score > rest[0].score

    def test_ties_by_y_then_x(self) -> None:
        regions = found(drawn(TWO_SQUARES, noise=False)).regions
        assert len({region.score for region in regions}) == 1
        assert [(region.bbox.y, region.bbox.x) for region in regions] == [(16, 16), (16, 80), (56, 16)]

    def test_the_same_residual_gives_the_same_answer(self) -> None:
        first, second = found(drawn(TWO_SQUARES)).regions, found(drawn(TWO_SQUARES)).regions
        assert [(r.bbox, r.score, r.evidence) for r in first] == [(r.bbox, r.score, r.evidence) for r in second]


class TestScale:
    @pytest.mark.parametrize("picture", [SQUARE, HORIZONTAL_BAND, VERTICAL_BAND, DIAGONAL_BAND, L_SHAPE, TWO_SQUARES])
    def test_twice_the_image_gives_twice_the_boxes_and_the_same_labels(self, picture: str) -> None:
        config = RegionConfig(smoothing_fraction=0)
        small = found(drawn(picture, cell_px=16, noise=False), config).regions
        large = found(drawn(picture, cell_px=32, noise=False), config).regions
        assert [region.label for region in large] == [region.label for region in small]
        assert [tuple(region.bbox) for region in large] == [tuple(2 * side for side in region.bbox) for region in small]
        np.testing.assert_allclose([r.score for r in large], [r.score for r in small], atol=0.01)

    def test_with_smoothing_the_boxes_agree_to_a_few_pixels(self) -> None:
        small = only(found(drawn(SQUARE, cell_px=16, noise=False), RegionConfig()))
        large = only(found(drawn(SQUARE, cell_px=32, noise=False), RegionConfig()))
        assert large.label == small.label
        np.testing.assert_allclose(large.bbox, 2 * np.array(small.bbox), atol=4)


class TestWorstCase:
    @pytest.mark.parametrize("config", [LITERAL, RegionConfig()], ids=["literal", "default"])
    @pytest.mark.parametrize("pitch", [1, 2, 3])
    def test_lattices_of_dots_stay_bounded(self, pitch: int, config: RegionConfig) -> None:
        residual = np.zeros((240, 320), np.float32)
        residual[::pitch, ::pitch] = 200
        residual[1::2, 1::2] = 0
        assert len(found(residual, config).regions) <= config.max_regions

    def test_a_checkerboard_is_one_component_under_8_connectivity(self) -> None:
        y, x = np.mgrid[:60, :80]
        residual = np.where((x + y) % 2, 200.0, 0.0).astype(np.float32)
        config = LITERAL.model_copy(update={"threshold_mads": 0.01})
        assert only(found(residual, config)).area_px == 60 * 80 // 2

    def test_the_largest_are_kept(self) -> None:
        residual = np.zeros((200, 200), np.float32)
        for index in range(10):
            side = 3 + index
            residual[20 * index : 20 * index + side, :side] = 80
        kept = found(residual, LITERAL.model_copy(update={"max_regions": 3})).regions
        assert sorted(region.area_px for region in kept) == [100, 121, 144]


@settings(max_examples=60, deadline=None)
@given(
    residual=arrays(np.float32, (33, 47), elements=st.sampled_from([0.0, 3.0, 20.0, 120.0, 255.0])),
    inside=arrays(np.bool_, (33, 47)),
    closing=st.sampled_from([0.0, 0.05, 0.1]),
    smoothing=st.sampled_from([0.0, 0.01, 0.05]),
)
def test_every_region_is_finite_and_inside_the_image(
    residual: np.ndarray, inside: np.ndarray, closing: float, smoothing: float
) -> None:
    config = LITERAL.model_copy(update={"closing_fraction": closing, "smoothing_fraction": smoothing})
    result = found(residual, config, inside)
    assert np.isfinite(result.threshold)
    assert not (result.mask & ~inside).any()
    for region in result.regions:
        box = region.bbox
        assert 0 <= box.x < box.x + box.width <= 47
        assert 0 <= box.y < box.y + box.height <= 33
        assert region.mask.any(axis=1)[[0, -1]].all()
        assert region.mask.any(axis=0)[[0, -1]].all()
        assert region.mask.sum() == region.area_px
        numbers = [region.score, region.thickness_px, region.residual_mean, region.residual_max]
        assert np.isfinite(numbers + [value for value in region.evidence.values() if not isinstance(value, str)]).all()
        assert 0 <= region.score <= 1
        assert 1 <= region.thickness_px <= min(box.width, box.height) + 1


@pytest.mark.parametrize("count", [0, 4097])
def test_the_number_of_regions_is_bounded(count: int) -> None:
    """Components are ranked in 16 bits, and each one costs time that a request must not be able to ask for."""
    with pytest.raises(ValidationError, match="max_regions"):
        RegionConfig(max_regions=count)


@pytest.mark.parametrize("softening_gray", [1e-42, 0.05])
def test_a_softening_that_would_divide_by_nothing_is_refused(softening_gray: float) -> None:
    with pytest.raises(ConfigError, match=r"expected 0 or at least 0\.1"):
        RegionConfig.from_mapping({"texture_softening_gray": softening_gray}, where="test")
    assert RegionConfig(texture_softening_gray=0).texture_softening_gray == 0
