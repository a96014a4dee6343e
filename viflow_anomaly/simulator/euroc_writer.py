"""Writes the EuRoC ASL tree: sensor.yaml and data.csv of camera, IMU, state ground truth, and the motor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.sensor_data import Float64Array
from viflow_anomaly.simulator.imu import ImuRecord
from viflow_anomaly.simulator.motion import BodyMotion, quaternions_wxyz
from viflow_anomaly.simulator.motor import MotorRecord
from viflow_anomaly.simulator.rigs import Rig

Int64Array = NDArray[np.int64]

IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
STATE_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], "
    "b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]"
)


def _transform_yaml(transform: Float64Array) -> str:
    rows = [", ".join(format(value, ".15g") for value in row) for row in transform]
    data = ",\n         ".join(rows)
    return f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{data}]\n"


def _write_table(path: Path, header: str, stamps_ns: Int64Array, values: Float64Array) -> None:
    lines = [header]
    for stamp, row in zip(stamps_ns.tolist(), values.tolist(), strict=True):
        lines.append(f"{stamp}," + ",".join(format(value, ".12g") for value in row))
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def write_camera(mav0: Path, rig: Rig, frame_stamps_ns: Int64Array) -> None:
    """``cam0/sensor.yaml`` and ``cam0/data.csv`` (the images are written by the renderer's loop)."""
    camera = rig.camera
    folder = mav0 / "cam0"
    (folder / "data").mkdir(parents=True, exist_ok=True)
    intrinsics = ", ".join(format(value, ".10g") for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    (folder / "sensor.yaml").write_text(
        "sensor_type: camera\ncomment: simulated, global shutter, no distortion\n"
        + _transform_yaml(rig.T_imu_cam)
        + f"rate_hz: {rig.frame_rate_hz}\nresolution: [{camera.width}, {camera.height}]\ncamera_model: pinhole\n"
        f"intrinsics: [{intrinsics}] #fu, fv, cu, cv\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n",
        encoding="ascii",
    )
    rows = [f"{stamp},{stamp}.png" for stamp in frame_stamps_ns.tolist()]
    (folder / "data.csv").write_text("\n".join(["#timestamp [ns],filename", *rows]) + "\n", encoding="ascii")


def write_imu(mav0: Path, rig: Rig, stamps_ns: Int64Array, record: ImuRecord) -> None:
    """``imu0/sensor.yaml`` and ``imu0/data.csv``; the IMU is the body frame."""
    errors = rig.imu_errors
    folder = mav0 / "imu0"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sensor.yaml").write_text(
        "sensor_type: imu\ncomment: simulated\n" + _transform_yaml(np.eye(4)) + f"rate_hz: {rig.imu_rate_hz}\n"
        f"gyroscope_noise_density: {errors.gyro_noise_density:.6g}\n"
        f"gyroscope_random_walk: {errors.gyro_random_walk:.6g}\n"
        f"accelerometer_noise_density: {errors.accel_noise_density:.6g}\n"
        f"accelerometer_random_walk: {errors.accel_random_walk:.6g}\n",
        encoding="ascii",
    )
    _write_table(folder / "data.csv", IMU_HEADER, stamps_ns, np.hstack([record.gyro_rad_s, record.accel_m_s2]))


def write_states(mav0: Path, stamps_ns: Int64Array, motion: BodyMotion, record: ImuRecord) -> None:
    """``state_groundtruth_estimate0``: pose, velocity and true biases at every IMU stamp (frames among them)."""
    folder = mav0 / "state_groundtruth_estimate0"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sensor.yaml").write_text(
        "sensor_type: visual-inertial\ncomment: exact state of the simulated IMU\n" + _transform_yaml(np.eye(4)),
        encoding="ascii",
    )
    quaternions = quaternions_wxyz(motion.R_world_body)
    columns = [motion.positions_m, quaternions, motion.velocities_m_s, record.gyro_bias_rad_s, record.accel_bias_m_s2]
    _write_table(folder / "data.csv", STATE_HEADER, stamps_ns, np.hstack(columns))


def write_motor(mav0: Path, record: MotorRecord) -> None:
    """``motor0/data.csv``: the platform's speed or command; EuRoC itself has none."""
    folder = mav0 / "motor0"
    folder.mkdir(parents=True, exist_ok=True)
    header = "#" + ",".join(("timestamp [ns]", *record.names))
    _write_table(folder / "data.csv", header, record.stamps_ns, record.values)
