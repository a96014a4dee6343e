"""The two rigs: intrinsics, mounting and IMU errors, drawn within the ranges that docs/simulator.md states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from viflow_anomaly.geometry import so3_exp
from viflow_anomaly.sensor_data import Float64Array, PinholeCamera
from viflow_anomaly.simulator.config import DEFAULT_SIZES_PX, SimulatorConfig
from viflow_anomaly.simulator.motion import inverse_rigid

NOMINAL_FOCAL_PX = {"drone": 235.0, "car": 240.0}
FRAME_RATE_HZ = {"drone": 20, "car": 10}
IMU_RATE_HZ = {"drone": 200, "car": 100}
# Vehicle axes: x forward, y left, z up. Camera axes: x right, y down, z forward.
R_VEHICLE_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# EuRoC's cam0 sensor.yaml, rounded to a quarter turn about the optical axis.
R_EUROC_IMU_CAMERA = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
EUROC_CAMERA_IN_IMU_M = np.array([-0.0216, -0.0647, 0.0098])


@dataclass(frozen=True, eq=False)
class ImuErrors:
    """What the measurements add to the truth. Densities as in EuRoC's sensor.yaml (continuous time, per sqrt(Hz))."""

    gyro_bias_rad_s: Float64Array
    accel_bias_m_s2: Float64Array
    gyro_noise_density: float
    accel_noise_density: float
    gyro_random_walk: float
    accel_random_walk: float
    gyro_vibration_rad_s: float
    accel_vibration_m_s2: float


@dataclass(frozen=True, eq=False)
class Rig:
    """One sequence's hardware: ``camera.T_cam_imu`` and its inverse, ``R_vehicle_imu`` [3, 3] (IMU to vehicle axes)."""

    camera: PinholeCamera
    T_imu_cam: Float64Array
    R_vehicle_imu: Float64Array
    frame_rate_hz: int
    imu_rate_hz: int
    imu_errors: ImuErrors


def _random_rotation(rng: np.random.Generator) -> Float64Array:
    quaternion = rng.standard_normal(4)
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _camera_mounting(rng: np.random.Generator, rig: str) -> tuple[Float64Array, Float64Array]:
    """R_vehicle_camera [3, 3] and T_imu_cam [4, 4]."""
    T_imu_cam = np.eye(4)
    if rig == "drone":
        tilt_down = rng.uniform(-5.0, 25.0)
        R_vehicle_cam = R_VEHICLE_CAMERA @ so3_exp(np.radians([-tilt_down, *rng.uniform(-2, 2, 2)]))
        euroc_like = rng.random() < 0.5
        nominal = R_EUROC_IMU_CAMERA @ so3_exp(np.radians(rng.normal(0, 2, 3)))
        T_imu_cam[:3, :3] = nominal if euroc_like else _random_rotation(rng)
        T_imu_cam[:3, 3] = EUROC_CAMERA_IN_IMU_M + rng.uniform(-0.05, 0.05, 3)
        return R_vehicle_cam, T_imu_cam
    R_vehicle_cam = R_VEHICLE_CAMERA @ so3_exp(np.radians(rng.uniform((-3, -2, -1), (1, 2, 1))))
    R_vehicle_imu = so3_exp(np.radians(rng.normal(0, 1, 3)))
    T_imu_cam[:3, :3] = R_vehicle_imu.T @ R_vehicle_cam
    T_imu_cam[:3, 3] = rng.uniform((0.3, -0.4, 0.3), (1.3, 0.4, 0.8))
    return R_vehicle_cam, T_imu_cam


def _draw_imu_errors(rng: np.random.Generator, config: SimulatorConfig) -> ImuErrors:
    drone = config.rig == "drone"
    on = float(config.imu_errors)
    scale = np.exp(rng.uniform(np.log(0.5), np.log(3.0), 4))  # data sheets of consumer parts differ by that much
    vibration = np.exp(rng.uniform(np.log((0.002, 0.05)), np.log((0.02, 0.5) if drone else (0.005, 0.3))))
    return ImuErrors(
        gyro_bias_rad_s=on * rng.normal(0, 0.005 if drone else 0.002, 3),
        accel_bias_m_s2=on * rng.normal(0, 0.05 if drone else 0.03, 3),
        gyro_noise_density=on * 1.7e-4 * float(scale[0]),
        accel_noise_density=on * 2.0e-3 * float(scale[1]),
        gyro_random_walk=on * 1.9e-5 * float(scale[2]),
        accel_random_walk=on * 3.0e-3 * float(scale[3]),
        gyro_vibration_rad_s=on * float(vibration[0]),
        accel_vibration_m_s2=on * float(vibration[1]),
    )


def draw_rig(rng: np.random.Generator, config: SimulatorConfig) -> Rig:
    """Draw one sequence's hardware.

    In rotation mode the camera sits in the IMU's origin, so that the camera itself only rotates.
    """
    focal = NOMINAL_FOCAL_PX[config.rig] * config.width / DEFAULT_SIZES_PX[config.rig][0] * rng.uniform(0.9, 1.1)
    aspect = rng.uniform(0.995, 1.005)
    centre = (
        (config.width - 1) / 2 + config.width * rng.uniform(-0.02, 0.02),
        (config.height - 1) / 2 + config.height * rng.uniform(-0.02, 0.02),
    )
    R_vehicle_cam, T_imu_cam = _camera_mounting(rng, config.rig)
    if config.motion == "rotation":
        T_imu_cam[:3, 3] = 0.0
    camera = PinholeCamera(
        fx=round(focal, 4),
        fy=round(focal * aspect, 4),
        cx=round(centre[0], 4),
        cy=round(centre[1], 4),
        width=config.width,
        height=config.height,
        T_cam_imu=inverse_rigid(T_imu_cam),
    )
    return Rig(
        camera=camera,
        T_imu_cam=T_imu_cam,
        R_vehicle_imu=R_vehicle_cam @ T_imu_cam[:3, :3].T,
        frame_rate_hz=FRAME_RATE_HZ[config.rig],
        imu_rate_hz=IMU_RATE_HZ[config.rig],
        imu_errors=_draw_imu_errors(rng, config),
    )
