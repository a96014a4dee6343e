"""Closed forms: rotations, projection there and back, and the flow that a moving camera sees."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from worlds import EUROC

from viflow_anomaly.geometry import (
    integrate_gyro,
    occluded_pixels,
    pixel_grid,
    project_rays,
    rigid_motion_flow,
    skew,
    so3_exp,
    so3_log,
    solve_few,
    unproject_pixels,
)
from viflow_anomaly.sensor_data import PinholeCamera

# EuRoC's cam0; TUM-VI's cam0 for the equidistant model; EuRoC's with a k3 for the five-coefficient form.
TUM_VI = PinholeCamera(
    fx=190.97847715128717,
    fy=190.9733070521226,
    cx=254.93170605935475,
    cy=256.8974428996504,
    width=512,
    height=512,
    distortion_model="equidistant",
    distortion_coeffs=(0.0034823894022493434, 0.0007150348452162257, -0.0020532361418706202, 0.00020293673591811182),
)
CAMERAS = {
    "none": PinholeCamera(fx=458.654, fy=457.296, cx=367.215, cy=248.375, width=752, height=480),
    "radtan": EUROC,
    "radtan with k3": replace(EUROC, distortion_coeffs=(*EUROC.distortion_coeffs, 0.01)),
    "equidistant": TUM_VI,
}
PLAIN = PinholeCamera(fx=100.0, fy=110.0, cx=31.5, cy=23.5, width=64, height=48)

vectors = arrays(np.float64, 3, elements=st.floats(-1.7, 1.7))


def transform(rotation_vector: tuple[float, float, float], translation: tuple[float, float, float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = so3_exp(np.array(rotation_vector))
    T[:3, 3] = translation
    return T


@given(vectors, vectors)
def test_skew_is_the_cross_product(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-12)


@given(vectors)
def test_so3_round_trip(vector: np.ndarray) -> None:  # below pi, where the logarithm is unique
    rotation = so3_exp(vector)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(so3_log(rotation), vector, atol=1e-6)


def test_so3_exp_turns_x_to_y_about_z() -> None:
    np.testing.assert_allclose(so3_exp(np.array([0, 0, np.pi / 2])) @ (1.0, 0, 0), (0, 1, 0), atol=1e-12)


def test_integrate_gyro_at_constant_rate() -> None:
    rate = np.array([0.3, -0.2, 0.7])
    stamps = np.array([0, 5, 17, 30, 200], dtype=np.int64) * 10_000_000
    rotation = integrate_gyro(stamps, np.tile(rate, (5, 1)))
    np.testing.assert_allclose(rotation, so3_exp(rate * 2.0), atol=1e-12)


def test_integrate_gyro_at_linear_rate_about_one_axis() -> None:
    stamps = np.arange(11, dtype=np.int64) * 100_000_000
    rates = np.outer(np.arange(11) * 0.1, (0, 1.0, 0))
    np.testing.assert_allclose(so3_log(integrate_gyro(stamps, rates)), (0, 0.5, 0), atol=1e-12)


def test_integrate_gyro_applies_body_rates_on_the_right() -> None:
    stamps = np.array([0, 1_000_000_000, 1_000_000_001, 2_000_000_001], dtype=np.int64)
    first, second = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    rotation = integrate_gyro(stamps, np.array([first, first, second, second]))
    np.testing.assert_allclose(rotation, so3_exp(first) @ so3_exp(second), atol=1e-8)


def test_integrate_gyro_of_one_sample_is_no_motion() -> None:
    np.testing.assert_array_equal(integrate_gyro(np.array([5], dtype=np.int64), np.ones((1, 3))), np.eye(3))


@given(arrays(np.float64, (6, 6), elements=st.floats(-3, 3)), arrays(np.float64, 6, elements=st.floats(-3, 3)))
def test_a_few_unknowns_are_solved(factor: np.ndarray, solution: np.ndarray) -> None:
    matrix = factor @ factor.T + np.eye(6)
    np.testing.assert_allclose(solve_few(matrix, matrix @ solution), solution, rtol=0, atol=1e-9)


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_what_has_no_solution_is_not_a_number(value: float) -> None:
    assert np.isnan(solve_few(np.full((6, 6), value), np.ones(6))).all()


def test_pixel_grid() -> None:
    grid = pixel_grid(2, 3)
    assert grid.shape == (2, 3, 2)
    assert grid[1, 2].tolist() == [2.0, 1.0]


@pytest.mark.parametrize("name", CAMERAS)
def test_unproject_then_project_is_the_identity_up_to_the_corners(name: str) -> None:
    camera = CAMERAS[name]
    pixels = pixel_grid(camera.height, camera.width).astype(np.float64)
    rays = unproject_pixels(camera, pixels)
    assert rays.shape == pixels.shape
    ahead = in_front(camera)
    assert ahead.all() == (camera is not TUM_VI)
    assert np.abs(project_rays(camera, rays) - pixels)[ahead].max() < 1e-3


def in_front(camera: PinholeCamera) -> np.ndarray:
    """Pixels less than 85 degrees off the axis: x/z says nothing of those beyond 90, which TUM-VI's corners are."""
    x, y = np.moveaxis(pixel_grid(camera.height, camera.width) - (camera.cx, camera.cy), -1, 0)
    return np.hypot(x / camera.fx, y / camera.fy) < np.radians(85)


@pytest.mark.parametrize("name", CAMERAS)
def test_project_agrees_with_opencv(name: str) -> None:
    camera = CAMERAS[name]
    rays = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2))
    points = np.column_stack([rays, np.ones(50)]).reshape(-1, 1, 3)
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    coefficients = np.array(camera.distortion_coeffs) if camera.distortion_coeffs else np.zeros(4)
    if camera.distortion_model == "equidistant":
        expected, _ = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), K, coefficients)
    else:
        expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, coefficients)
    np.testing.assert_allclose(project_rays(camera, rays), expected.reshape(-1, 2), atol=1e-6)


def test_the_principal_point_looks_straight_ahead() -> None:
    for camera in CAMERAS.values():
        centre = np.array([camera.cx, camera.cy])
        np.testing.assert_allclose(unproject_pixels(camera, centre), (0, 0), atol=1e-12)
        np.testing.assert_allclose(project_rays(camera, np.zeros(2)), centre)


def test_no_motion_no_flow() -> None:
    for camera in CAMERAS.values():
        flow, valid = rigid_motion_flow(camera, np.full((camera.height, camera.width), 3.0), np.eye(4))
        assert valid.all()
        assert np.abs(flow)[in_front(camera)].max() < 1e-3


def test_sideways_motion_at_constant_depth_shifts_everything_alike() -> None:
    # The camera moves 0.2 m right, so points move 0.2 m left in it: du = -fx * 0.2 / 4.
    flow, valid = rigid_motion_flow(PLAIN, np.full((48, 64), 4.0), transform((0, 0, 0), (-0.2, 0, 0)))
    assert flow.dtype == np.float32
    assert valid.all()
    np.testing.assert_allclose(flow[..., 0], -5.0, atol=1e-4)
    np.testing.assert_allclose(flow[..., 1], 0.0, atol=1e-4)


def test_rotation_flow_does_not_depend_on_depth() -> None:
    T = transform((0.02, -0.03, 0.01), (0, 0, 0))
    near, _ = rigid_motion_flow(PLAIN, np.full((48, 64), 0.5), T)
    varied, _ = rigid_motion_flow(PLAIN, np.random.default_rng(0).uniform(1, 90, (48, 64)), T)
    far, valid = rigid_motion_flow(PLAIN, np.full((48, 64), np.inf), T)
    assert valid.all()
    np.testing.assert_allclose(near, far, atol=1e-4)
    np.testing.assert_allclose(varied, far, atol=1e-4)


def test_turning_right_moves_the_middle_left() -> None:
    # R_target_source is the inverse of the camera's own turn about y (down), which is to the right.
    flow, _ = rigid_motion_flow(
        replace(PLAIN, cx=31, cy=23), np.full((48, 64), np.inf), transform((0, -0.05, 0), (0, 0, 0))
    )
    np.testing.assert_allclose(flow[23, 31], (-100 * np.tan(0.05), 0), atol=1e-4)


def test_infinite_depth_ignores_translation() -> None:
    flow, valid = rigid_motion_flow(PLAIN, np.full((48, 64), np.inf), transform((0, 0, 0), (1, 2, 3)))
    assert valid.all()
    np.testing.assert_allclose(flow, 0.0, atol=1e-4)


def test_forward_motion_is_radial() -> None:
    # Depth 5 becomes 4: everything moves away from the principal point by a quarter of its distance.
    flow, valid = rigid_motion_flow(PLAIN, np.full((48, 64), 5.0), transform((0, 0, 0), (0, 0, -1.0)))
    assert valid.all()
    np.testing.assert_allclose(flow, 0.25 * (pixel_grid(48, 64) - (PLAIN.cx, PLAIN.cy)), atol=1e-3)


def test_points_behind_the_target_camera_are_invalid() -> None:
    depth = np.full((48, 64), 5.0)
    depth[:, :20] = 0.5
    flow, valid = rigid_motion_flow(PLAIN, depth, transform((0, 0, 0), (0, 0, -1.0)))
    assert not valid[:, :20].any()
    assert valid[:, 20:].all()
    assert not flow[:, :20].any()
    assert np.isfinite(flow).all()


def test_flow_there_and_back_with_distortion() -> None:
    depth = np.full((EUROC.height, EUROC.width), 2.0)
    T = transform((0, 0, 0.03), (0.05, -0.02, 0.0))  # stays at depth 2
    there, _ = rigid_motion_flow(EUROC, depth, T)
    back, _ = rigid_motion_flow(EUROC, depth, np.linalg.inv(T))
    u, v = np.array([376, 100, 700]), np.array([240, 60, 420])
    landed = pixel_grid(EUROC.height, EUROC.width)[v, u] + there[v, u]
    returned = (
        landed
        + np.dstack([cv2.remap(back[..., c], landed[:, :1], landed[:, 1:], cv2.INTER_LINEAR) for c in (0, 1)])[:, 0]
    )
    np.testing.assert_allclose(returned, np.column_stack([u, v]), atol=0.02)


def test_occluded_pixels_are_those_behind_something_nearer_in_the_target() -> None:
    """A wall at 4 m; in the target a board at 2 m covers columns 40 to 59; the camera moves 5.5 px to the right."""
    camera = PinholeCamera(fx=50.0, fy=50.0, cx=49.5, cy=19.5, width=100, height=40)
    wall = np.full((40, 100), 4.0)
    target = wall.copy()
    target[:, 40:60] = 2.0
    motion = np.eye(4)
    motion[0, 3] = -0.44  # 5.5 px at 4 m
    expected = np.zeros((40, 100), dtype=bool)
    expected[:, 46:65] = True
    np.testing.assert_array_equal(occluded_pixels(camera, wall, target, motion), expected)


@pytest.mark.parametrize("unknown", ["source", "target"])
def test_unknown_depth_is_not_occluded_and_hides_nothing(unknown: str) -> None:
    camera = PinholeCamera(fx=50.0, fy=50.0, cx=49.5, cy=19.5, width=100, height=40)
    depths = {"source": np.full((40, 100), 4.0), "target": np.full((40, 100), 2.0)}
    depths[unknown][:] = np.inf
    assert not occluded_pixels(camera, depths["source"], depths["target"], np.eye(4)).any()


def test_what_leaves_the_image_or_falls_behind_is_not_occluded() -> None:
    camera = PinholeCamera(fx=50.0, fy=50.0, cx=49.5, cy=19.5, width=100, height=40)
    near = np.full((40, 100), 2.0)
    for shift in ((-10.0, 0.0, 0.0), (0.0, 10.0, 0.0), (0.0, 0.0, -5.0)):
        motion = np.eye(4)
        motion[:3, 3] = shift
        assert not occluded_pixels(camera, 2 * near, near, motion).any()
