"""A large picture is judged at a smaller size; nothing but its detail is lost on the way there and back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from viflow_anomaly.analysis import Analysis
from viflow_anomaly.cli.pair_files import PairFiles, load_pair
from viflow_anomaly.config import DetectorConfig, ImageLimits
from viflow_anomaly.detection import decode_mask_rle
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.geometry import pixel_grid
from viflow_anomaly.internal_size import InternalSize, internal_size
from viflow_anomaly.regions import BoundingBox
from viflow_anomaly.sensor_data import Frame, FramePair

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
def test_boxes_grow_outwards_and_stay_inside(width: int, height: int, short_side: int, data: st.DataObject) -> None:
    size = internal_size(width, height, short_side)
    if size is None:
        return
    x, y = data.draw(st.integers(0, size.width - 1)), data.draw(st.integers(0, size.height - 1))
    small = BoundingBox(x, y, data.draw(st.integers(1, size.width - x)), data.draw(st.integers(1, size.height - y)))
    box = size.box(small)
    assert 0 <= box.x < box.x + box.width <= width
    assert 0 <= box.y < box.y + box.height <= height
    for start, side, inner, inner_side, step in (
        (box.x, box.width, small.x, small.width, size.step_px[0]),
        (box.y, box.height, small.y, small.height, size.step_px[1]),
    ):
        assert start <= inner * step + 1e-6
        assert start + side >= (inner + inner_side) * step - 1e-6
        assert side <= inner_side * step + 2
    assert size.box(BoundingBox(0, 0, size.width, size.height)) == BoundingBox(0, 0, width, height)


def test_positions_come_back_in_source_pixels() -> None:
    size = InternalSize(376, 240, 752, 480)
    there_and_back = size.coordinates(pixel_grid(240, 376))
    inner = (slice(1, -1), slice(1, -1))  # beyond the outermost centres nothing is interpolated
    np.testing.assert_allclose(there_and_back[inner], pixel_grid(480, 752)[inner], atol=1e-3)
    assert size.map(np.full((240, 376), 3.0, np.float32)).shape == (480, 752)
    assert size.mask(np.ones((240, 376), np.bool_)).all()


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
    inner = (slice(1, -1), slice(1, -1))
    between = [large.flow_px[row::2, column::2] / 4 for row in (0, 1) for column in (0, 1)]
    np.testing.assert_allclose(sum(between)[inner], 2 * small.flow_px[inner], atol=0.1)


def test_without_the_head_every_pixel_is_looked_at(enlarged: FramePair) -> None:
    assert analyze(enlarged, 240).size is not None
    assert analyze(enlarged, 0).size is None
    assert analyze(enlarged, 240, evidence="residual").size is None
    assert analyze(enlarged, 240, correction={"enabled": False}).size is None


@pytest.mark.parametrize("short_side", [-1, 1, 63, 16385])
def test_a_size_that_shows_nothing_is_refused(short_side: int) -> None:
    with pytest.raises(ConfigError, match="expected 0 or 64 to 16384 pixels"):
        DetectorConfig.from_mapping({"internal_short_side_px": short_side}, where="here")
