"""What motors say, in closed form; and that a simulated recording has it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_sequences import small

from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.simulator import sequence as sequences
from viflow_anomaly.simulator.motion import axis_rotations
from viflow_anomaly.simulator.motor import (
    CAR_NAMES,
    COMMAND_NOISE_M_S,
    DRONE_NAMES,
    WHEEL_NOISE_M_S,
    WHEEL_SCALE_SD,
    commanded_velocities,
    record_car,
    record_drone,
    wheel_speeds,
)

RATE_HZ = 200


def circle(count: int, speed_m_s: float = 4.0, rate_rad_s: float = 0.5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, velocities and headings of something that drives in a circle, nose first."""
    times = np.arange(count) / RATE_HZ
    angles = rate_rad_s * times
    velocities = speed_m_s * np.stack([np.cos(angles), np.sin(angles), np.zeros(count)], axis=1)
    return times, velocities, axis_rotations(2, angles)


def stamps_of(times: np.ndarray) -> np.ndarray:
    return np.round(times * 1e9).astype(np.int64)


def test_a_car_in_a_circle_drives_forward_at_its_speed() -> None:
    _, velocities, rotations = circle(50)
    np.testing.assert_allclose(wheel_speeds(velocities, rotations), np.full((50, 1), 4.0), atol=1e-12)
    np.testing.assert_allclose(wheel_speeds(velocities, rotations, 1.01), np.full((50, 1), 4.04), atol=1e-12)


def test_reverse_is_negative_and_sideways_is_nothing() -> None:
    velocities = np.array([[-2.0, 0, 0], [0, 3.0, 0], [0, 0, 1.0]])
    np.testing.assert_allclose(wheel_speeds(velocities, np.stack([np.eye(3)] * 3))[:, 0], [-2, 0, 0])


def test_a_command_is_the_body_velocity_of_later() -> None:
    times, _, rotations = circle(60)
    velocities = np.stack([times, np.zeros_like(times), 2 * times], axis=1)  # in the world
    commands = commanded_velocities(velocities, rotations, 20)
    assert commands.shape == (40, 3)
    later = times[20:]
    expected = np.stack([later * np.cos(0.5 * later), -later * np.sin(0.5 * later), 2 * later], axis=1)
    np.testing.assert_allclose(commands, expected, atol=1e-12)


def test_without_errors_both_are_exact() -> None:
    times, velocities, rotations = circle(60)
    rng = np.random.default_rng(0)
    car = record_car(rng, stamps_of(times), velocities, rotations, errors=False)
    assert car.names == CAR_NAMES
    np.testing.assert_allclose(car.values, np.full((60, 1), 4.0), atol=1e-12)
    drone = record_drone(rng, stamps_of(times), velocities, rotations, rate_hz=RATE_HZ, errors=False)
    assert drone.names == DRONE_NAMES
    np.testing.assert_array_equal(drone.stamps_ns, stamps_of(times)[:40])  # 100 ms are 20 samples
    np.testing.assert_allclose(drone.values, np.tile((4.0, 0, 0), (40, 1)), atol=1e-12)


def test_errors_have_the_stated_size() -> None:
    times, velocities, rotations = circle(4000)
    scales = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        speeds = record_car(rng, stamps_of(times), velocities, rotations, errors=True).values[:, 0]
        scales.append(speeds.mean() / 4.0)
        assert speeds.std() == pytest.approx(WHEEL_NOISE_M_S, rel=0.1)
    assert np.std(scales) == pytest.approx(WHEEL_SCALE_SD, rel=0.2)
    assert np.mean(scales) == pytest.approx(1.0, abs=3e-3)
    drone = record_drone(
        np.random.default_rng(0), stamps_of(times), velocities, rotations, rate_hz=RATE_HZ, errors=True
    )
    noise = drone.values - (4.0, 0.0, 0.0)
    np.testing.assert_allclose(noise.std(axis=0), COMMAND_NOISE_M_S, rtol=0.1)
    np.testing.assert_allclose(noise.mean(axis=0), 0, atol=0.01)


@pytest.mark.parametrize("rig", ["drone", "car"])
def test_a_sequences_motor_is_drawn_from_its_seed_alone(rig: str) -> None:
    config = small(rig, imu_errors=True, frames=3)
    world = sequences.build_world(config, 5)
    first, again = (sequences.record_motor(config, 5, world) for _ in range(2))
    np.testing.assert_array_equal(first.values, again.values)
    assert not np.array_equal(first.values, sequences.record_motor(config, 6, world).values)
    assert first.stamps_ns[0] == world.stamps_ns[0]


def test_a_simulated_recording_has_its_motor(sequence: Path) -> None:
    recording = open_recording(sequence)
    rows = (sequence / "mav0/motor0/data.csv").read_text().splitlines()
    car = sequence.name.startswith("car")
    assert recording.motor_names == (CAR_NAMES if car else DRONE_NAMES)
    assert rows[0] == "#timestamp [ns]," + ",".join(recording.motor_names)
    states = np.loadtxt(sequence / "mav0/state_groundtruth_estimate0/data.csv", delimiter=",")
    speeds = np.linalg.norm(states[:, 8:11], axis=1)
    stamps = np.loadtxt(sequence / "mav0/imu0/data.csv", delimiter=",", usecols=0, dtype=np.int64)
    for k, stamp in enumerate(recording.frame_timestamps_ns):
        command = recording.motor_command(k)
        assert command is not None
        row = int(np.searchsorted(stamps, stamp))
        if car:  # heave and pitch are what is left
            assert command[0] == pytest.approx(speeds[row], rel=0.01)
        else:
            assert np.linalg.norm(command) == pytest.approx(speeds[row + 20], rel=1e-6)


def test_the_motors_generator_changes_no_other() -> None:
    """Numbers of the generators that draw everything else: sequences made before there was a motor stay as they are."""
    numbers = [sequences.STREAMS[name] for name in ("rig", "motion", "movers", "scene", "imu", "camera", "noise")]
    assert numbers == list(range(7))
    assert sequences.STREAMS["motor"] not in numbers
