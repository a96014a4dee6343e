"""What the static world explains of a remaining flow is explained; what moves by itself is left."""

from __future__ import annotations

import numpy as np
import pytest
from test_evidence_cues import pair_of, predicted
from worlds import textured_image

from viflow_anomaly.alignment import AlignedPair, align, remaining_evidence
from viflow_anomaly.config import DetectorConfig, ViewConfig
from viflow_anomaly.explanation import explain
from viflow_anomaly.geometry import pixel_grid, sample_bilinear
from viflow_anomaly.model_input import ModelInput
from viflow_anomaly.motion_input import MotionWindow
from viflow_anomaly.sensor_data import Float64Array, PinholeCamera, Uint8Array
from viflow_anomaly.view import make_view

WIDTH, HEIGHT = 384, 256
FOCAL_PX = 116.0
CONFIG = DetectorConfig(photometric_compensation=False)


@pytest.fixture(scope="module")
def source() -> Uint8Array:
    return np.asarray(textured_image(WIDTH, HEIGHT, seed=4), np.uint8)


def moved(source: Uint8Array, flow_px: Float64Array) -> Uint8Array:
    """The target in which source pixels have gone by a smooth flow [H, W, 2]."""
    at = (pixel_grid(HEIGHT, WIDTH) - flow_px).astype(np.float32)
    return np.asarray(np.rint(sample_bilinear(source.astype(np.float32), at)), np.uint8)


def aligned(source: Uint8Array, target: Uint8Array, *, depth: bool = True) -> AlignedPair:
    """Under the prediction that nothing moves, by a camera that went to the left past a plane."""
    view = make_view(ViewConfig(), width=WIDTH, height=HEIGHT, camera=None)
    model_input = ModelInput(source, target, MotionWindow(np.zeros((16, 6), np.float32), 0.05, ()), view)
    flows = predicted((view.width, view.height), (0.05, 0.0, 0.0) if depth else None)
    pair = pair_of(source, target)
    alignment = align(pair, model_input, flows, focal_px=FOCAL_PX)
    explained = explain(pair, model_input, flows, CONFIG, coordinates=alignment.target_coordinates)
    return remaining_evidence(explained, alignment)


def inner(values: np.ndarray) -> np.ndarray:
    """Away from the border."""
    return values[6:-6, 6:-6]


def rolled(angle_rad: float) -> Float64Array:
    offsets = pixel_grid(HEIGHT, WIDTH) - np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2], np.float32)
    return np.stack([-angle_rad * offsets[..., 1], angle_rad * offsets[..., 0]], axis=-1).astype(np.float64)


def test_a_missed_roll_is_found_and_the_source_rebuilt(source: Uint8Array) -> None:
    flow = rolled(0.015)
    pair = aligned(source, moved(source, flow))
    found = pair.explained.target_coordinates - pixel_grid(HEIGHT, WIDTH)
    assert np.abs(found - flow)[24:-24, 24:-24].mean() < 0.15
    assert np.abs(inner(pair.remaining.flow_px)).mean() < 0.1
    assert np.median(np.abs(pair.rebuilt.astype(int) - pair.source)[24:-24, 24:-24]) < 4


def test_a_neighbourhood_that_is_nearer_is_brought_nearer(source: Uint8Array) -> None:
    flow = np.zeros((HEIGHT, WIDTH, 2))
    flow[..., 0] = 2.0 * np.linspace(-1, 1, HEIGHT)[:, None]  # the lower half is nearer, the upper farther
    pair = aligned(source, moved(source, flow))
    assert np.abs(inner(pair.remaining.flow_px)).mean() < 0.25
    upper, lower = inner(pair.log_depth)[:10], inner(pair.log_depth)[-10:]
    assert upper.mean() < -0.05
    assert lower.mean() > 0.05


def test_what_moves_across_is_left(source: Uint8Array) -> None:
    target = source.copy()
    target[84:116, 112:152] = source[80:112, 112:152]
    pair = aligned(source, target)
    assert np.median(pair.remaining.flow_px[22:26, 30:36, 1]) == pytest.approx(4.0, abs=0.6)
    assert np.abs(pair.remaining.flow_px[4:12]).mean() < 0.1


def test_what_needs_no_alignment_is_not_moved(source: Uint8Array) -> None:
    pair = aligned(source, source)
    np.testing.assert_array_equal(pair.explained.target_coordinates, pixel_grid(HEIGHT, WIDTH))
    assert not pair.log_depth.any() or np.abs(pair.log_depth).max() < 0.01


def test_without_depth_nothing_is_taken_off(source: Uint8Array) -> None:
    pair = aligned(source, moved(source, rolled(0.015)), depth=False)
    np.testing.assert_array_equal(pair.explained.target_coordinates, pixel_grid(HEIGHT, WIDTH))
    assert np.abs(pair.remaining.flow_px[-10:]).mean() > 0.5


def test_halves_are_not_looked_at_where_the_view_shows_as_much() -> None:
    for width, height in ((160, 96), (256, 48)):
        image = np.asarray(textured_image(width, height, seed=4), np.uint8)
        target = np.roll(image, 3, axis=0)
        view = make_view(ViewConfig(), width=width, height=height, camera=None)
        model_input = ModelInput(image, target, MotionWindow(np.zeros((16, 6), np.float32), 0.05, ()), view)
        flows = predicted((view.width, view.height), (0.05, 0.0, 0.0))
        alignment = align(pair_of(image, target), model_input, flows, focal_px=FOCAL_PX)
        np.testing.assert_array_equal(alignment.target_coordinates, pixel_grid(height, width))


def test_what_the_view_does_not_show_has_no_say(source: Uint8Array) -> None:
    camera = PinholeCamera(fx=180.0, fy=180.0, cx=300.0, cy=220.0, width=640, height=480)
    wide = np.asarray(textured_image(640, 480, seed=4), np.uint8)
    view = make_view(ViewConfig(max_pinhole_width=192, max_pinhole_height=160), width=640, height=480, camera=camera)
    x, y, width, height = view.region()
    assert width * height < 0.5 * wide.size
    target = np.roll(wide, 4, axis=1)
    target[y : y + height, x : x + width] = wide[y : y + height, x : x + width]
    model_input = ModelInput(wide, target, MotionWindow(np.zeros((16, 6), np.float32), 0.05, ()), view)
    flows = predicted((view.width, view.height), (0.05, 0.0, 0.0))
    alignment = align(pair_of(wide, target), model_input, flows, focal_px=FOCAL_PX)
    np.testing.assert_array_equal(alignment.target_coordinates, view.target_coordinates(flows.flow_px, 4))
