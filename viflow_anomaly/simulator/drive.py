"""A car's motion: along a road at a gently varying speed, with small pitch, roll and heave."""

from __future__ import annotations

import numpy as np

from viflow_anomaly.sensor_data import Float64Array
from viflow_anomaly.simulator.harmonics import Harmonics
from viflow_anomaly.simulator.motion import BodyMotion, compose_rotations, mounted
from viflow_anomaly.simulator.road import Road, draw_road

CAMERA_HEIGHT_M = (1.2, 1.8)


def drive(
    rng: np.random.Generator, times_s: Float64Array, R_vehicle_imu: Float64Array, camera_above_imu_m: float
) -> tuple[BodyMotion, Road, Float64Array]:
    """A car's motion at ``times_s`` [N] (0 at the first frame), its road, and where it is along it [N] (metres).

    The IMU follows the road's curve; the camera is ``camera_above_imu_m`` above it and 1.2 to 1.8 m above the ground.
    """
    speed = 3.0 + 13.0 * rng.random() ** 1.3  # m/s, a little more often slow than fast
    gentle = Harmonics.random(rng, frequencies_hz=(0.03, 0.2), count=4)
    largest = max(float(np.abs(gentle.at(times_s, 1)).max()), 1e-9)
    strongest = max(float(np.abs(gentle.at(times_s, 2)).max()), 1e-9)
    gentle = gentle.scaled(min(rng.uniform(0.02, 0.3) * speed / largest, 2.0 / strongest))
    arc = speed * times_s + gentle.at(times_s) - gentle.at(np.zeros(1))
    arc_rate, arc_acceleration = speed + gentle.at(times_s, 1), gentle.at(times_s, 2)
    road = draw_road(rng, float(arc_rate.max()), float(arc.max()))
    heave = Harmonics.random(rng, frequencies_hz=(0.8, 3.0), count=4).with_rms(rng.uniform(0.002, 0.012), times_s)
    pitch = Harmonics.random(rng, frequencies_hz=(0.5, 3.0), count=5).with_rms(rng.uniform(0.001, 0.007), times_s)
    roll = Harmonics.random(rng, frequencies_hz=(0.4, 2.5), count=5).with_rms(rng.uniform(0.001, 0.006), times_s)
    heading, curvature = road.heading(arc), road.curvature(arc)
    tangent = np.stack([np.cos(heading), np.sin(heading), np.zeros_like(heading)], axis=-1)
    normal = np.stack([-tangent[:, 1], tangent[:, 0], tangent[:, 2]], axis=-1)
    up = np.array([0.0, 0.0, 1.0])
    height = rng.uniform(*CAMERA_HEIGHT_M) - camera_above_imu_m
    positions = np.concatenate([road.position(arc), (height + heave.at(times_s))[:, None]], axis=-1)
    velocities = tangent * arc_rate[:, None] + up * heave.at(times_s, 1)[:, None]
    accelerations = tangent * arc_acceleration[:, None] + normal * (curvature * arc_rate**2)[:, None]
    accelerations = accelerations + up * heave.at(times_s, 2)[:, None]
    R_world_vehicle, rates = compose_rotations(
        (2, 1, 0),
        [heading, pitch.at(times_s), roll.at(times_s)],
        [curvature * arc_rate, pitch.at(times_s, 1), roll.at(times_s, 1)],
    )
    motion = mounted(positions, velocities, accelerations, R_world_vehicle, rates, R_vehicle_imu, times_s)
    return motion, road, arc


def park(rng: np.random.Generator, motion: BodyMotion, R_vehicle_imu: Float64Array, *, rotates: bool) -> BodyMotion:
    """The same car standing still where it was at its first frame, or (``rotates``) turning about its IMU there.

    For tests and for training on pure rotation; no car moves like that.
    """
    times_s = motion.times_s
    first = int(np.argmin(np.abs(times_s)))
    start = motion.R_world_body[first] @ R_vehicle_imu.T
    heading = float(np.arctan2(start[1, 0], start[0, 0]))
    angles, rates = [], []
    for rms in (0.3, 0.05, 0.05):
        turn = Harmonics.random(rng, frequencies_hz=(0.1, 1.0)).with_rms(rms * float(rotates), times_s, derivative=1)
        angles.append(turn.at(times_s))
        rates.append(turn.at(times_s, 1))
    angles[0] = angles[0] + heading
    R_world_vehicle, vehicle_rates = compose_rotations((2, 1, 0), angles, rates)
    nothing = np.zeros_like(motion.positions_m)
    positions = nothing + motion.positions_m[first]
    return mounted(positions, nothing, nothing, R_world_vehicle, vehicle_rates, R_vehicle_imu, times_s)
