"""A remaining flow that a motion of the camera made, with and without what moves by itself."""

from __future__ import annotations

import numpy as np
import pytest

from viflow_anomaly.geometry import Float32Array, pixel_grid
from viflow_anomaly.motion_refinement import Line, MovedPoints, common_motion_px

ROWS, COLUMNS = 32, 48
FOCAL_PX = (300.0, 310.0)
MOVER = (slice(10, 18), slice(20, 30))


def points() -> MovedPoints:
    """A wall that is nearer on the right, seen under about 35 degrees."""
    grid = (pixel_grid(ROWS, COLUMNS) - ((COLUMNS - 1) / 2, (ROWS - 1) / 2)) * (4 / 300.0)
    x, y = (np.ascontiguousarray(grid[..., axis], dtype=np.float32) for axis in (0, 1))
    return MovedPoints(x, y, 0.3 + 0.5 * x)


def lines(parallax_px: float) -> Line:
    """Level ones, as of a camera that moves sideways."""
    ones = np.ones((ROWS, COLUMNS), np.float32)
    return Line(ones, 0 * ones, parallax_px * ones)


def flow_of(rotation: tuple[float, float, float], translation: tuple[float, float, float]) -> Float32Array:
    """[h, w, 2] by the rigid motion itself, not its derivative."""
    x, y, nearness = points()
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    moved = rays + np.cross(np.array(rotation), rays) + nearness[..., None] * np.array(translation)
    flow = moved[..., :2] / moved[..., 2:] - rays[..., :2]
    return np.asarray(flow * FOCAL_PX, dtype=np.float32)


def common(flow: Float32Array, *, trust: float = 1.0, parallax_px: float = 0.1) -> Float32Array:
    trusted = np.full((ROWS, COLUMNS), trust, np.float32)
    return common_motion_px(flow, trusted, points(), lines(parallax_px), FOCAL_PX)


@pytest.mark.parametrize(
    ("rotation", "translation"),
    [
        ((0.003, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((0.0, -0.003, 0.004), (0.0, 0.0, 0.0)),
        ((0.0, 0.002, 0.0), (0.0, 0.02, 0.03)),
    ],
)
def test_a_small_motion_of_the_camera_is_explained(
    rotation: tuple[float, float, float], translation: tuple[float, float, float]
) -> None:
    flow = flow_of(rotation, translation)
    left = np.abs(flow - common(flow))
    assert np.abs(flow).max() > 0.5
    assert left.max() < 0.25 * np.abs(flow).max()
    assert left.mean() < 0.1 * np.abs(flow).mean() + 0.02


def test_a_mover_is_outvoted() -> None:
    flow = flow_of((0.003, 0.0, 0.0), (0.0, 0.0, 0.0))
    flow[MOVER] += (0.0, 4.0)
    left = flow - common(flow)
    assert left[MOVER][..., 1].mean() == pytest.approx(4.0, abs=0.4)
    assert np.abs(left[:, 35:]).max() < 0.3


def test_what_is_not_trusted_explains_nothing() -> None:
    assert np.abs(common(flow_of((0.003, 0.002, 0.0), (0.0, 0.0, 0.0)), trust=0.0)).max() == 0.0


def test_along_the_line_a_depth_may_be_wrong_where_there_is_parallax() -> None:
    along = np.zeros((ROWS, COLUMNS, 2), np.float32)
    along[..., 0] = 1.0
    free, bound = (np.abs(common(along, parallax_px=parallax_px)[..., 0]).mean() for parallax_px in (30.0, 0.1))
    assert free < 0.5 * bound
    assert bound > 0.8
