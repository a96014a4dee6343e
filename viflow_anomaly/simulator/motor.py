"""What the platform says of its own speed: wheel odometry of a car, commanded velocity of a drone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.sensor_data import Float64Array

CAR_NAMES = ("forward_speed_m_s",)
DRONE_NAMES = ("velocity_x_m_s", "velocity_y_m_s", "velocity_z_m_s")
WHEEL_SCALE_SD = 0.01
"""Of one sequence: tyre pressure and wear change the circumference of a wheel by about that much."""
WHEEL_NOISE_M_S = 0.05
COMMAND_NOISE_M_S = 0.1
COMMAND_LEAD_S = 0.1
"""A drone follows its command by about that much later."""


@dataclass(frozen=True, eq=False)
class MotorRecord:
    """Rows [N, M] of ``names``, at the instants ``stamps_ns`` [N]."""

    names: tuple[str, ...]
    stamps_ns: NDArray[np.int64]
    values: Float64Array


def wheel_speeds(velocities_m_s: Float64Array, R_world_vehicle: Float64Array, scale: float = 1.0) -> Float64Array:
    """[N, 3] in the world and [N, 3, 3] -> [N, 1]: speed along the vehicle's x axis, times the wheels' scale."""
    return np.asarray(scale * np.einsum("ni,ni->n", velocities_m_s, R_world_vehicle[:, :, 0])[:, None])


def commanded_velocities(velocities_m_s: Float64Array, R_world_body: Float64Array, lead: int) -> Float64Array:
    """[N, 3] in the world and [N, 3, 3] -> [N - lead, 3]: in row k the velocity in body axes of row k + lead."""
    return np.asarray(np.einsum("nji,nj->ni", R_world_body[lead:], velocities_m_s[lead:]))


def record_car(
    rng: np.random.Generator,
    stamps_ns: NDArray[np.int64],
    velocities_m_s: Float64Array,
    R_world_vehicle: Float64Array,
    *,
    errors: bool,
) -> MotorRecord:
    """Wheel odometry at every stamp; exact without ``errors``."""
    scale = 1.0 + WHEEL_SCALE_SD * float(rng.standard_normal()) * errors
    speeds = wheel_speeds(velocities_m_s, R_world_vehicle, scale)
    return MotorRecord(CAR_NAMES, stamps_ns, speeds + errors * WHEEL_NOISE_M_S * rng.standard_normal(speeds.shape))


def record_drone(
    rng: np.random.Generator,
    stamps_ns: NDArray[np.int64],
    velocities_m_s: Float64Array,
    R_world_body: Float64Array,
    *,
    rate_hz: int,
    errors: bool,
) -> MotorRecord:
    """The commanded velocity in IMU axes, 100 ms ahead of the motion, up to 100 ms before the last stamp."""
    lead = round(COMMAND_LEAD_S * rate_hz)
    commands = commanded_velocities(velocities_m_s, R_world_body, lead)
    commands = commands + errors * COMMAND_NOISE_M_S * rng.standard_normal(commands.shape)
    return MotorRecord(DRONE_NAMES, stamps_ns[: len(commands)], commands)
