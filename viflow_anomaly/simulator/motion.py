"""The platform's motion at given instants, and how it is composed from smooth angles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from viflow_anomaly.sensor_data import Float64Array

GRAVITY_M_S2 = 9.81


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """Motion of the IMU (the body frame) in a z-up world, exact at every instant.

    Args:
        times_s: [N], 0 at the first frame.
        positions_m, velocities_m_s, accelerations_m_s2: [N, 3] in the world.
        R_world_body: [N, 3, 3].
        rates_rad_s: [N, 3] angular rate in the body frame.
    """

    times_s: Float64Array
    positions_m: Float64Array
    velocities_m_s: Float64Array
    accelerations_m_s2: Float64Array
    R_world_body: Float64Array
    rates_rad_s: Float64Array

    def poses(self) -> Float64Array:
        """[N, 4, 4] T_world_body."""
        return rigid_transforms(self.R_world_body, self.positions_m)


def rigid_transforms(rotations: Float64Array, translations: Float64Array) -> Float64Array:
    """[N, 3, 3] and [N, 3] -> [N, 4, 4]."""
    transforms = np.zeros((len(rotations), 4, 4))
    transforms[:, :3, :3] = rotations
    transforms[:, :3, 3] = translations
    transforms[:, 3, 3] = 1.0
    return transforms


def inverse_rigid(transform: Float64Array) -> Float64Array:
    """[4, 4] -> [4, 4]."""
    inverse = np.eye(4)
    inverse[:3, :3] = transform[:3, :3].T
    inverse[:3, 3] = -transform[:3, :3].T @ transform[:3, 3]
    return inverse


def axis_rotations(axis: int, angles: Float64Array) -> Float64Array:
    """Rotations about a coordinate axis (0, 1, 2): [N] rad -> [N, 3, 3]."""
    rotations = np.zeros((len(angles), 3, 3))
    j, k = (axis + 1) % 3, (axis + 2) % 3
    cos, sin = np.cos(angles), np.sin(angles)
    rotations[:, axis, axis] = 1.0
    rotations[:, j, j] = rotations[:, k, k] = cos
    rotations[:, k, j] = sin
    rotations[:, j, k] = -sin
    return rotations


def compose_rotations(
    axes: tuple[int, ...], angles: list[Float64Array], angle_rates: list[Float64Array]
) -> tuple[Float64Array, Float64Array]:
    """Product of axis rotations, first axis outermost, and its exact angular rate.

    Returns:
        R [N, 3, 3] (maps body to world) and the rate [N, 3] in body coordinates (rad/s).
    """
    total = np.broadcast_to(np.eye(3), (len(angles[0]), 3, 3))
    rate = np.zeros((len(angles[0]), 3))
    for axis, angle, angle_rate in zip(axes, angles, angle_rates, strict=True):
        rotation = axis_rotations(axis, angle)
        total = total @ rotation
        rate = np.einsum("nji,nj->ni", rotation, rate)
        rate[:, axis] += angle_rate
    return total, rate


def mounted(
    positions_m: Float64Array,
    velocities_m_s: Float64Array,
    accelerations_m_s2: Float64Array,
    R_world_vehicle: Float64Array,
    rates_vehicle_rad_s: Float64Array,
    R_vehicle_imu: Float64Array,
    times_s: Float64Array,
) -> BodyMotion:
    """The body motion of an IMU that sits at the moving point with the given mounting."""
    return BodyMotion(
        times_s,
        positions_m,
        velocities_m_s,
        accelerations_m_s2,
        R_world_vehicle @ R_vehicle_imu,
        rates_vehicle_rad_s @ R_vehicle_imu,
    )


def quaternion_wxyz(rotation: Float64Array) -> Float64Array:
    """Rotation [3, 3] -> unit quaternion [4] w x y z, by the largest of the four (never divides by a small number)."""
    m = rotation
    squares = np.array(
        [
            1 + m[0, 0] + m[1, 1] + m[2, 2],
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
        ]
    )
    a, b, c = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    d, e, f = m[1, 0] + m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2]
    rows = np.array([[squares[0], a, b, c], [a, squares[1], d, e], [b, d, squares[2], f], [c, e, f, squares[3]]])
    best = rows[int(np.argmax(squares))]
    return np.asarray(best / np.linalg.norm(best))


def quaternions_wxyz(rotations: Float64Array) -> Float64Array:
    """[N, 3, 3] -> [N, 4] unit quaternions w x y z, each on its predecessor's side."""
    result = np.stack([quaternion_wxyz(rotation) for rotation in rotations])
    flips = np.cumprod(np.where((result[1:] * result[:-1]).sum(axis=1) < 0, -1.0, 1.0))
    result[1:] *= flips[:, None]
    return result
