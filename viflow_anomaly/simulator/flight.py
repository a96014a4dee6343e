"""A drone's motion: smooth position, attitude that partly follows the acceleration, yaw of its own.

Speeds and angular rates are drawn so that they cover what EuRoC's V1_02 and V2_03 show over 3 s windows: angular rate
0.17-1.09 rad/s rms, speed 0.26-1.39 m/s (5th to 95th percentile), yaw power below 0.5 Hz, tilt power at 0.5-2.5 Hz.
"""

from __future__ import annotations

import numpy as np

from viflow_anomaly.sensor_data import Float64Array
from viflow_anomaly.simulator.harmonics import Harmonics
from viflow_anomaly.simulator.motion import GRAVITY_M_S2, BodyMotion, compose_rotations, mounted

MAX_TILT_RAD = 0.6
MAX_RMS_ACCELERATION_M_S2 = 2.5


def _rms(values: Float64Array) -> float:
    return float(np.sqrt(np.mean(np.sum(values**2, axis=-1))))


def _positions(rng: np.random.Generator, times_s: Float64Array, speed_m_s: float) -> Float64Array:
    """[4, N, 3]: position, velocity, acceleration, jerk; the rms speed is as wanted where the acceleration allows."""
    bands = ((0.05, 0.5), (0.05, 0.5), (0.1, 1.0))
    axes = [Harmonics.random(rng, frequencies_hz=band) for band in bands]
    shares = (rng.uniform(0.6, 1.0), rng.uniform(0.6, 1.0), rng.uniform(0.15, 0.5))
    axes = [axis.with_rms(share, times_s, derivative=1) for axis, share in zip(axes, shares, strict=True)]
    motion = np.stack([np.stack([axis.at(times_s, order) for axis in axes], axis=-1) for order in range(4)])
    factor = speed_m_s / max(_rms(motion[1]), 1e-9)
    gentlest = MAX_RMS_ACCELERATION_M_S2 / max(_rms(motion[2]), 1e-9)
    return np.asarray(motion * min(factor, gentlest))


def _attitude(
    rng: np.random.Generator, times_s: Float64Array, accelerations: Float64Array, jerks: Float64Array, rate_rad_s: float
) -> tuple[list[Float64Array], list[Float64Array]]:
    """Angles about world x, world y, then body z, and their rates."""
    yaw_share = rng.uniform(0.4, 0.85)
    yaw = Harmonics.random(rng, frequencies_hz=(0.03, 0.4)).with_rms(yaw_share * rate_rad_s, times_s, derivative=1)
    tilt_target = np.sqrt(1 - yaw_share**2) * rate_rad_s
    coupled_rates = np.stack([-jerks[:, 1], jerks[:, 0]]) / GRAVITY_M_S2
    own_rate = max(0.5 * _rms(coupled_rates.T), 0.1)
    own = [
        Harmonics.random(rng, frequencies_hz=(0.4, 2.5), slope=1.2).with_rms(own_rate, times_s, derivative=1)
        for _ in range(2)
    ]
    angles = np.stack([-accelerations[:, 1], accelerations[:, 0]]) / GRAVITY_M_S2
    angles = angles + np.stack([part.at(times_s) for part in own])
    rates = coupled_rates + np.stack([part.at(times_s, 1) for part in own])
    factor = min(tilt_target / max(_rms(rates.T), 1e-9), MAX_TILT_RAD / max(float(np.abs(angles).max()), 1e-9))
    heading = rng.uniform(0, 2 * np.pi)
    return (
        [angles[0] * factor, angles[1] * factor, heading + yaw.at(times_s)],
        [rates[0] * factor, rates[1] * factor, yaw.at(times_s, 1)],
    )


def _bounded_lognormal(rng: np.random.Generator, median: float, sigma: float, low: float, high: float) -> float:
    return float(np.clip(median * np.exp(sigma * rng.standard_normal()), low, high))


def fly(
    rng: np.random.Generator, times_s: Float64Array, R_vehicle_imu: Float64Array, *, translates: bool, rotates: bool
) -> BodyMotion:
    """A drone's motion at ``times_s`` [N]; lowest point 0.9 to 1.8 m above the ground (z = 0)."""
    temper = np.exp(0.3 * rng.standard_normal())  # one factor for both: gentle or aggressive flights
    speed = _bounded_lognormal(rng, 0.75 * temper, 0.4, 0.08, 2.5)
    rate = _bounded_lognormal(rng, 0.6 * temper, 0.35, 0.06, 1.8)
    motion = _positions(rng, times_s, speed) * float(translates)
    angles, rates = _attitude(rng, times_s, motion[2], motion[3], rate)
    if not rotates:
        angles, rates = [angle * 0.0 + angle[0] for angle in angles], [angle_rate * 0.0 for angle_rate in rates]
    R_world_vehicle, rates_vehicle = compose_rotations((0, 1, 2), angles, rates)
    positions = motion[0] - motion[0].mean(axis=0)
    positions[:, 2] += rng.uniform(0.9, 1.8) - positions[:, 2].min()
    return mounted(positions, motion[1], motion[2], R_world_vehicle, rates_vehicle, R_vehicle_imu, times_s)
