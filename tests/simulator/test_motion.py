"""The IMU agrees with the motion, in closed form: no picture is drawn here."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from small_sequences import small

from viflow_anomaly.geometry import integrate_gyro, so3_log
from viflow_anomaly.simulator.harmonics import Harmonics
from viflow_anomaly.simulator.imu import measure
from viflow_anomaly.simulator.motion import axis_rotations, quaternions_wxyz
from viflow_anomaly.simulator.rigs import draw_rig
from viflow_anomaly.simulator.road import draw_road
from viflow_anomaly.simulator.sequence import World, build_world

SEEDS = (1, 2, 3)
GRAVITY = np.array([0.0, 0.0, -9.81])


def ideal_imu(world: World) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    record = measure(np.random.default_rng(0), world.motion, world.rig.imu_errors, world.rig.imu_rate_hz)
    return record.gyro_rad_s, record.accel_m_s2


@pytest.mark.parametrize("rig", ["drone", "car"])
@pytest.mark.parametrize("seed", SEEDS)
def test_gyro_integrates_to_the_rotation_between_frames(rig: str, seed: int) -> None:
    world = build_world(small(rig, frames=10, movers=(0, 0)), seed)
    gyro, _ = ideal_imu(world)
    for first, last in zip(world.frame_indices[:-1], world.frame_indices[1:], strict=True):
        window = slice(first, last + 1)
        integrated = integrate_gyro(world.stamps_ns[window], gyro[window])
        true = world.motion.R_world_body[first].T @ world.motion.R_world_body[last]
        assert np.linalg.norm(so3_log(integrated.T @ true)) < 2e-4


@pytest.mark.parametrize("rig", ["drone", "car"])
@pytest.mark.parametrize("seed", SEEDS)
def test_accelerometer_integrates_to_velocity_and_position(rig: str, seed: int) -> None:
    world = build_world(small(rig, frames=10, movers=(0, 0)), seed)
    _, accel = ideal_imu(world)
    motion = world.motion
    in_world = np.einsum("nij,nj->ni", motion.R_world_body, accel) + GRAVITY
    step = np.diff(motion.times_s)[:, None]
    velocity = motion.velocities_m_s[0] + np.cumsum(0.5 * step * (in_world[1:] + in_world[:-1]), axis=0)
    np.testing.assert_allclose(velocity, motion.velocities_m_s[1:], atol=2e-3)
    path = motion.positions_m[0] + np.cumsum(
        0.5 * step * (motion.velocities_m_s[1:] + motion.velocities_m_s[:-1]), axis=0
    )
    np.testing.assert_allclose(path, motion.positions_m[1:], atol=2e-3)


@pytest.mark.parametrize("rig", ["drone", "car"])
def test_at_rest_the_accelerometer_reads_gravity_upwards(rig: str) -> None:
    world = build_world(small(rig, motion="static", movers=(0, 0)), 5)
    gyro, accel = ideal_imu(world)
    assert np.abs(gyro).max() == 0.0
    up_in_body = world.motion.R_world_body[0].T @ np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(accel, np.tile(9.81 * up_in_body, (len(accel), 1)), atol=1e-9)
    assert np.ptp(world.camera_poses, axis=0).max() == 0.0


@pytest.mark.parametrize("rig", ["drone", "car"])
def test_rotation_mode_keeps_the_camera_in_its_place(rig: str) -> None:
    world = build_world(small(rig, motion="rotation", movers=(0, 0)), 5)
    assert np.ptp(world.camera_poses[:, :3, 3], axis=0).max() < 1e-12
    assert np.linalg.norm(world.motion.rates_rad_s, axis=1).max() > 0.05


def test_car_imu_axes_are_forward_left_up() -> None:
    for seed in SEEDS:
        world = build_world(small("car", movers=(0, 0)), seed)
        in_body = np.einsum("nji,nj->ni", world.motion.R_world_body, world.motion.velocities_m_s)
        assert (in_body[:, 0] > 0.95 * np.linalg.norm(in_body, axis=1)).all()
        assert (world.motion.R_world_body[:, 2, 2] > 0.95).all()
        assert np.abs(world.motion.rates_rad_s).max() < 0.6


def test_stamps_cover_the_frames_with_room_to_spare() -> None:
    for rig, step_ns in (("drone", 50_000_000), ("car", 100_000_000)):
        world = build_world(small(rig, movers=(0, 0)), 1)
        frames = world.frame_stamps_ns
        assert set(np.diff(frames)) == {step_ns}
        assert frames[0] - world.stamps_ns[0] >= 300_000_000
        assert world.stamps_ns[-1] - frames[-1] >= 300_000_000


def test_measurement_errors_have_the_stated_sizes() -> None:
    config = small("drone", frames=200, movers=(0, 0), imu_errors=True, motion="static")
    world = build_world(config, 9)
    errors = world.rig.imu_errors
    record = measure(np.random.default_rng(1), world.motion, errors, 200)
    expected_sd = np.hypot(errors.gyro_noise_density * np.sqrt(200), errors.gyro_vibration_rad_s)
    np.testing.assert_allclose((record.gyro_rad_s - record.gyro_bias_rad_s).std(), expected_sd, rtol=0.1)
    np.testing.assert_allclose(record.gyro_rad_s.mean(axis=0), errors.gyro_bias_rad_s, atol=6 * expected_sd / 40)


def test_half_of_the_drones_carry_the_imu_as_euroc_does() -> None:
    turned = 0
    for seed in range(60):
        rig = draw_rig(np.random.default_rng(seed), small("drone"))
        euroc = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        turned += np.linalg.norm(so3_log(euroc.T @ rig.T_imu_cam[:3, :3])) < 0.3
        assert 0.89 * 235 / 6 < rig.camera.fx < 1.11 * 235 / 6
    assert 20 <= turned <= 40


def test_road_is_as_long_as_its_arc_and_turns_as_its_curvature_says() -> None:
    road = draw_road(np.random.default_rng(4), 9.0, 60.0)
    s = np.arange(road.start_m, road.end_m + 30, 0.1)
    steps = np.diff(road.position(s), axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 0.1, atol=1e-4)
    inside = s[(s > road.start_m + 1) & (s < road.end_m - 1)]
    slope = (road.heading(inside + 1e-4) - road.heading(inside - 1e-4)) / 2e-4
    np.testing.assert_allclose(road.curvature(inside), slope, atol=1e-6)
    assert np.abs(road.curvature(inside)).max() * 9.0 <= 0.4 + 1e-9
    left = road.position(inside, 2.0) - road.position(inside)
    np.testing.assert_allclose(np.linalg.norm(left, axis=1), 2.0, atol=1e-9)


def test_harmonics_derivatives() -> None:
    curve = Harmonics.random(np.random.default_rng(0), frequencies_hz=(0.1, 2.0))
    x, h = np.linspace(0, 5, 50), 1e-5
    for order in range(3):
        slope = (curve.at(x + h, order) - curve.at(x - h, order)) / (2 * h)
        np.testing.assert_allclose(curve.at(x, order + 1), slope, rtol=1e-4, atol=1e-5)


def test_quaternions_give_back_their_rotations_without_jumps() -> None:
    angles = np.linspace(0, 4 * np.pi, 400)
    rotations = axis_rotations(2, angles) @ axis_rotations(0, 0.5 * angles)
    w, x, y, z = quaternions_wxyz(rotations).T
    np.testing.assert_allclose(rotations[:, 2, 2], 1 - 2 * (x * x + y * y), atol=1e-12)
    np.testing.assert_allclose(rotations[:, 0, 1], 2 * (x * y - w * z), atol=1e-12)
    np.testing.assert_allclose(rotations[:, 1, 2], 2 * (y * z - w * x), atol=1e-12)
    assert np.linalg.norm(np.diff(np.stack([w, x, y, z]), axis=1), axis=0).max() < 0.1
