"""Do the IMU's numbers look like rad/s and m/s^2, and like a motion at all?

Wrong units raise where they are certain, else lower trust; single samples that no motion gives lower trust.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.sensor_data import Float64Array

GYRO_LIMIT_RAD_S = 40.0
"""Above the full scale of MEMS gyroscopes, 2000 deg/s = 34.9 rad/s."""
GYRO_SUSPICIOUS_RAD_S = 8.0
ACCEL_LIMIT_M_S2 = 160.0
"""Above the usual full scale of MEMS accelerometers, 16 g = 157 m/s^2."""
GYRO_SPIKE_RAD_S = 35.0
ACCEL_SPIKE_M_S2 = 157.0
"""2000 deg/s and 16 g: a few samples beyond are a fault of the sensor or its wiring, or a blow against it."""
ACCEL_ZERO_M_S2 = 0.05
ACCEL_IN_G = (0.7, 1.3)
ACCEL_NO_GRAVITY_M_S2 = 3.0


class ImuFault(NamedTuple):
    """Something about the IMU samples that a reader of the detection must know.

    Attributes:
        code: stable, machine-readable name.
        message: one sentence for a person.
        severity: ``abstain`` (the pair cannot be judged) or ``lowers_trust``.
    """

    code: str
    message: str
    severity: Literal["abstain", "lowers_trust"]


def check_gyroscope(gyro_rad_s: Float64Array) -> list[ImuFault]:
    """Faults of [N, 3] angular rates.

    Raises:
        InvalidInputError: ``imu_gyro_in_deg_s``, a rate beyond what MEMS gyroscopes measure.
    """
    fastest = float(np.abs(gyro_rad_s).max())
    if fastest > GYRO_LIMIT_RAD_S:
        raise InvalidInputError(
            f"gyro_rad_s: expected rad/s, at most {GYRO_LIMIT_RAD_S:.0f} about any axis, found {fastest:.1f}, "
            "which looks like deg/s",
            code="imu_gyro_in_deg_s",
            field="imu.gyro_rad_s",
        )
    median = float(np.median(np.linalg.norm(gyro_rad_s, axis=1)))
    if median <= GYRO_SUSPICIOUS_RAD_S:
        return []
    message = (
        f"The gyroscope turns at {median:.1f} rad/s ({np.degrees(median):.0f} degrees per second) in the median; "
        "are these deg/s?"
    )
    return [ImuFault("imu_gyro_maybe_deg_s", message, "lowers_trust")]


def check_accelerometer(accel_m_s2: Float64Array) -> list[ImuFault]:
    """Faults of [N, 3] specific forces, judged by their norms.

    Raises:
        InvalidInputError: ``imu_accel_in_g`` (median norm 0.7 to 1.3), ``imu_accel_out_of_range`` (above 16 g).
    """
    norms = np.linalg.norm(accel_m_s2, axis=1)
    if norms.max() < ACCEL_ZERO_M_S2:
        message = "The accelerometer reads zero throughout; at rest it should read 9.81 m/s^2 against gravity."
        return [ImuFault("imu_accel_zero", message, "abstain")]
    median = float(np.median(norms))
    if ACCEL_IN_G[0] <= median <= ACCEL_IN_G[1]:
        raise InvalidInputError(
            f"accel_m_s2: expected m/s^2 (about 9.81 at rest), found a median norm of {median:.2f}, "
            "which looks like g (multiples of 9.81 m/s^2)",
            code="imu_accel_in_g",
            field="imu.accel_m_s2",
        )
    if median > ACCEL_LIMIT_M_S2:
        raise InvalidInputError(
            f"accel_m_s2: expected m/s^2 (about 9.81 at rest, at most {ACCEL_LIMIT_M_S2:.0f}), "
            f"found a median norm of {median:.0f}",
            code="imu_accel_out_of_range",
            field="imu.accel_m_s2",
        )
    if median >= ACCEL_NO_GRAVITY_M_S2:
        return []
    message = (
        f"The accelerometer reads {median:.2f} m/s^2 in the median; either gravity was removed from it or the camera "
        "is in free fall."
    )
    return [ImuFault("imu_no_gravity", message, "lowers_trust")]


def check_spikes(gyro_rad_s: Float64Array, accel_m_s2: Float64Array) -> list[ImuFault]:
    """Single samples of [N, 3] rates (about any axis) and [N, 3] specific forces (norms) beyond any plausible motion.

    They stay in the window as they are: what was measured in their place is not known.
    """
    fastest, hardest = np.abs(gyro_rad_s).max(axis=1), np.linalg.norm(accel_m_s2, axis=1)
    spinning, struck = fastest > GYRO_SPIKE_RAD_S, hardest > ACCEL_SPIKE_M_S2
    parts = []
    if struck.any():
        parts.append(f"the accelerometer up to {hardest.max():.0f} m/s^2 (16 g are {ACCEL_SPIKE_M_S2:.0f})")
    if spinning.any():
        parts.append(f"the gyroscope up to {fastest.max():.1f} rad/s (2000 deg/s are {GYRO_SPIKE_RAD_S:.0f})")
    if not parts:
        return []
    message = (
        f"{np.count_nonzero(spinning | struck)} of {len(fastest)} IMU samples are spikes beyond any plausible motion: "
        + ", ".join(parts)
        + "."
    )
    return [ImuFault("imu_spike", message, "lowers_trust")]
