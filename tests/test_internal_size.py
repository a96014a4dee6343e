"""A large picture is judged at a smaller size; nothing but its detail is lost on the way there and back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from viflow_anomaly.analysis import Analysis
from viflow_anomaly.checkpoint import save_checkpoint
from viflow_anomaly.cli.pair_files import PairFiles, load_pair
from viflow_anomaly.config import DetectorConfig, ImageLimits, ModelConfig, ViewConfig
from viflow_anomaly.detection import decode_mask_rle
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.geometry import pixel_grid
from viflow_anomaly.internal_size import internal_size
from viflow_anomaly.model.builder import build_model
from viflow_anomaly.regions import BoundingBox, Region, region_of
from viflow_anomaly.sensor_data import Frame, FramePair, PinholeCamera

SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "drone"
SIZES = st.integers(32, 4096)


@pytest.mark.parametrize(
    ("width", "height", "judged_at"),
    [
        (752, 480, (376, 240)),
        (1242, 375, (795, 240)),
        (1280, 720, (427, 240)),
        (480, 640, (240, 320)),
        (384, 256, None),
        (2000, 300, None),
        (2000, 301, (1595, 240)),
    ],
)
def test_the_shorter_side_decides(width: int, height: int, judged_at: tuple[int, int] | None) -> None:
    size = internal_size(width, height, 240)
    assert (None if size is None else (size.width, size.height)) == judged_at
    assert internal_size(width, height, 0) is None


@given(SIZES, SIZES, st.integers(64, 512), st.data())
def test_every_source_pixel_belongs_to_one_internal_pixel(
    width: int, height: int, short_side: int, data: st.DataObject
) -> None:
    size = internal_size(width, height, short_side)
    if size is None:
        return
    x, y = data.draw(st.integers(0, size.width - 1)), data.draw(st.integers(0, size.height - 1))
    small = BoundingBox(x, y, data.draw(st.integers(1, size.width - x)), data.draw(st.integers(1, size.height - y)))
    box = size.box(small)
    assert box.width > 0
    assert box.height > 0
    for first, side, inner, inner_side, step in (
        (box.x, box.width, small.x, small.width, size.step_px[0]),
        (box.y, box.height, small.y, small.height, size.step_px[1]),
    ):
        assert inner * step - 1e-6 <= first + 0.5  # middles
        assert first - 0.5 < inner * step + 1e-6
        assert first + side - 0.5 < (inner + inner_side) * step + 1e-6
        assert first + side + 0.5 >= (inner + inner_side) * step - 1e-6
    left = size.box(BoundingBox(0, 0, x, size.height)) if x else BoundingBox(0, 0, 0, height)
    assert left.width == box.x  # what touches does not overlap
    assert size.box(BoundingBox(0, 0, size.width, size.height)) == BoundingBox(0, 0, width, height)


@pytest.mark.parametrize(("width", "height"), [(1242, 375), (752, 480), (1280, 720), (375, 1242)])
def test_masks_neither_grow_nor_move(width: int, height: int) -> None:
    size = internal_size(width, height, 240)
    assert size is not None
    labels = np.random.default_rng(0).integers(0, 2, (size.height // 8 + 1, size.width // 8 + 1)).astype(np.uint8)
    picture = labels.repeat(8, axis=0).repeat(8, axis=1)[: size.height, : size.width] != 0
    whole = size.mask(picture)
    rows, columns = (
        (np.arange(side) + 0.5) / step for side, step in ((height, size.step_px[1]), (width, size.step_px[0]))
    )
    np.testing.assert_array_equal(whole, picture[rows.astype(int)[:, None], columns.astype(int)])
    box = BoundingBox(11, 13, 70, 50)
    inside_it = size.region(region(box, picture[box.pixels]))
    np.testing.assert_array_equal(inside_it.mask, whole[inside_it.bbox.pixels])
    assert inside_it.area_px == np.count_nonzero(inside_it.mask)
    assert inside_it.evidence["fill_ratio"] == inside_it.area_px / inside_it.mask.size
    assert (inside_it.x_extent_px, inside_it.y_extent_px) == inside_it.mask.shape[::-1]


def region(box: BoundingBox, mask: NDArray[np.bool_]) -> Region:
    numbers = {"fill_ratio": 0.0, "aspect_ratio": 0.0, "across_epipolar_px": 1.0}
    return region_of(
        np.ones(int(mask.sum()), np.float32), box, mask, moves=True, score=0.9, thickness_px=5.0, evidence={**numbers}
    )


@pytest.mark.parametrize(("width", "height"), [(752, 480), (1242, 375), (2001, 1501)])
def test_positions_come_back_in_source_pixels(width: int, height: int) -> None:
    size = internal_size(width, height, 240)
    assert size is not None
    at_rest = size.coordinates(pixel_grid(size.height, size.width))
    np.testing.assert_allclose(at_rest, pixel_grid(height, width), atol=1e-3)
    moved = size.coordinates(pixel_grid(size.height, size.width) + np.float32(1))
    np.testing.assert_allclose(moved - at_rest, np.broadcast_to(size.step_px, moved.shape), atol=1e-3)
    assert size.map(np.full((size.height, size.width), 3.0, np.float32)).shape == (height, width)


@pytest.mark.parametrize(("width", "height"), [(752, 480), (1242, 375), (2001, 1501)])
def test_what_is_thinned_out_is_of_the_middles(width: int, height: int) -> None:
    size = internal_size(width, height, 240)
    assert size is not None
    rows, columns = (size.thin_out(positions) for positions in np.indices((height, width)))
    for kept, step in ((rows[:, 0], size.step_px[1]), (columns[0], size.step_px[0])):
        assert np.abs(kept + 0.5 - (np.arange(kept.size) + 0.5) * step).max() <= 0.5
    numbers = np.arange(size.width * size.height).reshape(size.height, size.width)
    np.testing.assert_array_equal(size.thin_out(size.mask(numbers)), numbers)


@pytest.fixture(scope="module")
def sample() -> FramePair:
    files = PairFiles(*(SAMPLE / name for name in ("source.png", "target.png", "imu.json", "camera.json")))
    return load_pair(files, limits=ImageLimits())[0]


@pytest.fixture(scope="module")
def enlarged(sample: FramePair) -> FramePair:
    """Every pixel as four, so that half the size is the sample again."""
    height, width = sample.source.image.shape
    source, target = (
        Frame(
            frame.timestamp_ns, np.asarray(cv2.resize(frame.image, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST))
        )
        for frame in (sample.source, sample.target)
    )
    assert sample.camera is not None
    return replace(sample, source=source, target=target, camera=sample.camera.scaled_to(2 * width, 2 * height))


def analyze(pair: FramePair, short_side_px: int, **settings: object) -> Analysis:
    config = DetectorConfig.model_validate({"internal_short_side_px": short_side_px, "include_masks": True, **settings})
    return AnomalyDetector.from_checkpoint(config=config).analyze(pair)


def test_twice_the_pixels_give_the_same_regions_twice_as_large(sample: FramePair, enlarged: FramePair) -> None:
    height, width = sample.source.image.shape
    small, large = analyze(sample, 0), analyze(enlarged, min(height, width))
    assert small.detection.rois
    assert (large.detection.image.width, large.detection.image.height) == (2 * width, 2 * height)
    for one, other in zip(small.detection.rois, large.detection.rois, strict=True):
        assert (other.label, other.score) == (one.label, one.score)
        assert other.bbox == BoundingBox(*(2 * value for value in one.bbox))
        assert (other.area_px, other.thickness_px) == (4 * one.area_px, 2 * one.thickness_px)
        assert (other.x_extent_px, other.y_extent_px) == (2 * one.x_extent_px, 2 * one.y_extent_px)
        for name in ("across_epipolar_px", "along_epipolar_px", "parallax_px"):
            assert other.evidence[name] == pytest.approx(2 * float(one.evidence[name] or 0), rel=1e-3, abs=1e-3)
        for name in ("static_flow_u_px", "static_flow_v_px"):  # told at the middles, half a pixel apart
            assert other.evidence[name] == pytest.approx(2 * float(one.evidence[name] or 0), abs=0.2)
        assert other.mask_rle is not None
        assert np.count_nonzero(decode_mask_rle(other.mask_rle)) == other.area_px
    before, after = small.detection.region_analyzed, large.detection.region_analyzed
    assert (after.width, after.height) == (2 * before.width, 2 * before.height)
    assert large.size is not None
    for name in ("residual", "evidence", "reconstruction"):
        np.testing.assert_array_equal(getattr(large, name), large.size.map(getattr(small, name)))
    between = [large.flow_px[row::2, column::2] / 4 for row in (0, 1) for column in (0, 1)]
    inner = (slice(1, -1), slice(1, -1))  # towards the border the mean of four is not the one in the middle
    np.testing.assert_allclose(sum(between)[inner], 2 * small.flow_px[inner], atol=0.1)


def test_without_the_head_every_pixel_is_looked_at(enlarged: FramePair) -> None:
    assert analyze(enlarged, 240).size is not None
    assert analyze(enlarged, 0).size is None
    assert analyze(enlarged, 240, evidence="residual").size is None
    assert analyze(enlarged, 240, correction={"enabled": False}).size is None


def test_a_lens_that_would_have_no_focal_length_left_keeps_its_size() -> None:
    wide = PinholeCamera(fx=10.0, fy=10.0, cx=2000.0, cy=1500.0, width=4000, height=3000)
    assert internal_size(4000, 3000, 240, wide) is None
    assert internal_size(4000, 3000, 240, replace(wide, fx=1000.0, fy=1000.0)) is not None


@pytest.mark.parametrize("config", [ModelConfig(preset="compact"), ModelConfig(view=ViewConfig(mode="center_crop"))])
def test_networks_that_know_no_depth_or_a_crop_look_at_every_pixel(
    config: ModelConfig, enlarged: FramePair, tmp_path: Path
) -> None:
    path = save_checkpoint(tmp_path / "model.safetensors", build_model(config), config, name="small", version="0")
    analysis = AnomalyDetector.from_checkpoint(path, runtime="torch").analyze(enlarged)
    assert analysis.size is None
    assert analysis.residual.shape == enlarged.source.image.shape


def test_a_large_pair_that_cannot_be_judged_is_told_in_its_own_size(enlarged: FramePair) -> None:
    dark = np.zeros_like(enlarged.source.image)
    nothing = replace(
        enlarged, source=Frame(enlarged.source.timestamp_ns, dark), target=Frame(enlarged.target.timestamp_ns, dark)
    )
    analysis = analyze(nothing, 240)
    assert (analysis.detection.status, analysis.detection.rois) == ("abstained", ())
    assert analysis.size is not None
    assert analysis.evidence.shape == dark.shape
    assert not analysis.evidence.any()


@pytest.mark.parametrize("short_side", [-1, 1, 127, 16385])
def test_a_size_that_shows_nothing_is_refused(short_side: int) -> None:
    with pytest.raises(ConfigError, match="expected 0 or 128 to 16384 pixels"):
        DetectorConfig.from_mapping({"internal_short_side_px": short_side}, where="here")
