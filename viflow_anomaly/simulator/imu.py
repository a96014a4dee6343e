"""What an IMU measures along a motion: rates and specific force, with biases, noise and vibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from viflow_anomaly.sensor_data import Float64Array
from viflow_anomaly.simulator.motion import GRAVITY_M_S2, BodyMotion
from viflow_anomaly.simulator.rigs import ImuErrors


@dataclass(frozen=True, eq=False)
class ImuRecord:
    """[N, 3] each, in the IMU frame: measurements and the biases inside them."""

    gyro_rad_s: Float64Array
    accel_m_s2: Float64Array
    gyro_bias_rad_s: Float64Array
    accel_bias_m_s2: Float64Array


def _wandering_bias(
    rng: np.random.Generator, start: Float64Array, random_walk: float, count: int, step_s: float
) -> Float64Array:
    steps = rng.standard_normal((count, 3)) * random_walk * np.sqrt(step_s)
    return np.asarray(start + np.cumsum(steps, axis=0))


def measure(rng: np.random.Generator, motion: BodyMotion, errors: ImuErrors, rate_hz: int) -> ImuRecord:
    """Gyro: body rate. Accelerometer: R^T (a - g) with g = (0, 0, -9.81); both plus bias(t), noise and vibration.

    White noise has the standard deviation density * sqrt(rate); vibration is white too.
    """
    count, step_s = len(motion.times_s), 1.0 / rate_hz
    gyro_bias = _wandering_bias(rng, errors.gyro_bias_rad_s, errors.gyro_random_walk, count, step_s)
    accel_bias = _wandering_bias(rng, errors.accel_bias_m_s2, errors.accel_random_walk, count, step_s)
    gyro_sd = np.hypot(errors.gyro_noise_density * np.sqrt(rate_hz), errors.gyro_vibration_rad_s)
    accel_sd = np.hypot(errors.accel_noise_density * np.sqrt(rate_hz), errors.accel_vibration_m_s2)
    specific_force = motion.accelerations_m_s2 + np.array([0.0, 0.0, GRAVITY_M_S2])
    in_body = np.einsum("nji,nj->ni", motion.R_world_body, specific_force)
    return ImuRecord(
        gyro_rad_s=motion.rates_rad_s + gyro_bias + gyro_sd * rng.standard_normal((count, 3)),
        accel_m_s2=in_body + accel_bias + accel_sd * rng.standard_normal((count, 3)),
        gyro_bias_rad_s=gyro_bias,
        accel_bias_m_s2=accel_bias,
    )
