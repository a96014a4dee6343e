"""EuRoC MAV dataset, ASL layout (Burri et al., IJRR 2016).

```
mav0/
  cam0/
    data.csv          #timestamp [ns],filename
    data/*.png
    sensor.yaml       intrinsics, distortion, T_BS (optional: without it the camera is unknown)
  imu0/
    data.csv          #timestamp [ns],w_x,w_y,w_z [rad/s],a_x,a_y,a_z [m/s^2]
    sensor.yaml       T_BS (optional: without it the mounting is unknown)
  state_groundtruth_estimate0/
    data.csv          #timestamp,p_RS_R_x,p_RS_R_y,p_RS_R_z [m],q_RS_w,q_RS_x,q_RS_y,q_RS_z,... (optional)
  motor0/
    data.csv          #timestamp [ns],<names...>: the platform's commands or speeds; not EuRoC's (optional)
```

``T_BS`` maps sensor coordinates to the body, so ``T_cam_imu = inv(T_BS_cam) @ T_BS_imu``. A ``timeshift_cam_imu`` in
the camera's file (Kalibr's key, seconds, t_imu = t_cam + shift) is honoured, for the states too, whose clock is the
IMU's; EuRoC itself has none.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from viflow_anomaly.config import ImageLimits
from viflow_anomaly.datasets.motor_table import read_motor
from viflow_anomaly.datasets.recording import FileRecording, choose_camera
from viflow_anomaly.datasets.tables import csv_malformed, read_frame_list, read_lines, read_stamped_numbers, read_text
from viflow_anomaly.datasets.trajectory import Trajectory, rigid, rotations_of
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.imu_log import ImuLog
from viflow_anomaly.sensor_data import Float64Array, Int64Array, PinholeCamera

NEEDS = "mav0/ (or its content) with imu0/data.csv and cam*/data.csv"
MIN_QUATERNION_LENGTH = 1e-3
BODY_POSE_RULE = f"expected a later stamp than before and a quaternion longer than {MIN_QUATERNION_LENGTH:g}"
TIME_OFFSET_KEY = "timeshift_cam_imu"
DISTORTION_NAMES = {
    "radial-tangential": "radtan",
    "radtan": "radtan",
    "equidistant": "equidistant",
    "none": "none",
}
IMU_COLUMNS = ("timestamp", "w_x", "w_y", "w_z", "a_x", "a_y", "a_z")
POSE_COLUMNS = ("timestamp", "p_x", "p_y", "p_z", "q_w", "q_x", "q_y", "q_z")
STATE_COLUMNS = (*POSE_COLUMNS, "v_x", "v_y", "v_z", "b_w_x", "b_w_y", "b_w_z", "b_a_x", "b_a_y", "b_a_z")
"""EuRoC's own states; a trajectory from elsewhere may end with the pose."""


def find_root(path: Path) -> Path | None:
    """The folder that holds cam0 and imu0: ``path`` or ``path/mav0``; None when neither does."""
    for root in (path / "mav0", path):
        if (root / "imu0" / "data.csv").is_file() and _cameras(root):
            return root
    return None


def open_euroc(root: Path, *, camera: str | None, limits: ImageLimits) -> FileRecording:
    """Open the folder that ``find_root`` found.

    Args:
        root: holds ``imu0`` and the cameras.
        camera: ``cam0``, ``cam1``, ...; None takes the first.
        limits: on every image.

    Raises:
        DatasetError: ``camera_unknown``, ``csv_malformed``, ``timestamps_not_increasing``, ``image_missing``,
            ``yaml_malformed``, ``calibration_malformed``, ``motor_not_covering``; the trajectory is read when
            it is asked for.
    """
    chosen = choose_camera(root, _cameras(root), camera)
    folder = root / chosen
    frames = read_frame_list(folder / "data.csv", ("timestamp", "filename"), folder / "data", header="comment")
    imu_stamps, values = read_stamped_numbers(root / "imu0" / "data.csv", IMU_COLUMNS, header="comment")
    calibration = read_camera(folder / "sensor.yaml", root / "imu0" / "sensor.yaml")
    offset_ns = 0 if calibration is None else round(calibration.time_offset_s * 1e9)
    motor_names, commands = read_motor(root / "motor0" / "data.csv", frames.timestamps_ns + offset_ns)
    return FileRecording(
        name=(root.resolve().parent if root.resolve().name == "mav0" else root.resolve()).name,
        root=root,
        format="euroc",
        camera=calibration,
        camera_name=chosen,
        imu=ImuLog(imu_stamps, values[:, :3], values[:, 3:]),
        frame_timestamps_ns=frames.timestamps_ns,
        frame_paths=tuple(frames.paths),
        motor_commands=commands,
        motor_names=motor_names,
        limits=limits,
        read_trajectory=partial(
            read_trajectory, root / "state_groundtruth_estimate0" / "data.csv", folder / "sensor.yaml"
        ),
    )


def _cameras(root: Path) -> list[str]:
    return sorted(folder.parent.name for folder in root.glob("cam*/data.csv"))


def read_camera(cam_yaml: Path, imu_yaml: Path) -> PinholeCamera | None:
    """Calibration from the two ``sensor.yaml``; None without the camera's, ``T_cam_imu`` None without the IMU's.

    Raises:
        DatasetError: ``yaml_malformed``, ``calibration_malformed``.
    """
    if not cam_yaml.is_file():
        return None
    sensor = _read_yaml(cam_yaml)
    if sensor.get("camera_model", "pinhole") != "pinhole":
        raise _malformed(cam_yaml, f"camera_model: expected pinhole, found {sensor['camera_model']!r:.40}")
    distortion = sensor.get("distortion_model", "none")
    model: Any = DISTORTION_NAMES.get(distortion) if isinstance(distortion, str) else None
    if model is None:
        known = ", ".join(DISTORTION_NAMES)
        raise _malformed(cam_yaml, f"distortion_model: expected one of {known}, found {distortion!r:.40}")
    fx, fy, cx, cy = _numbers(cam_yaml, sensor, "intrinsics", 4)
    width, height = _numbers(cam_yaml, sensor, "resolution", 2)
    if not width.is_integer() or not height.is_integer():
        raise _malformed(cam_yaml, f"resolution: expected whole pixels, found {width}x{height}")
    coefficients = _numbers(cam_yaml, sensor, "distortion_coefficients", None) if model != "none" else []
    try:
        return PinholeCamera(
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            width=int(width),
            height=int(height),
            distortion_model=model,
            distortion_coeffs=tuple(coefficients),
            T_cam_imu=_mounting(cam_yaml, sensor, imu_yaml),
            time_offset_s=_time_offset_s(cam_yaml, sensor),
        )
    except InvalidInputError as err:
        raise _malformed(cam_yaml, err.message) from err


def read_trajectory(states: Path, cam_yaml: Path) -> Trajectory | None:
    """Poses of the camera, in its clock, from the body's states and the camera's file; None where either is not there.

    Raises:
        DatasetError: as ``read_body_poses`` and ``read_camera_on_body``.
    """
    mounting = read_camera_on_body(cam_yaml)
    if mounting is None or not states.is_file():
        return None
    stamps, T_world_body = read_body_poses(states)
    return mounting.trajectory(stamps, T_world_body, str(states))


def read_body_poses(path: Path) -> tuple[Int64Array, Float64Array]:
    """Stamps [N], as the file has them, and T_world_body [N, 4, 4] from a table of states or of poses alone.

    Raises:
        DatasetError: ``csv_malformed`` (also stamps that do not increase, or a quaternion of no length),
            ``file_missing``, ``text_not_utf8``.
    """
    lines = [line for line in read_lines(path) if not line.text.startswith("#")]
    pose_only = bool(lines) and lines[0].text.count(",") == len(POSE_COLUMNS) - 1
    stamps, values = read_stamped_numbers(path, POSE_COLUMNS if pose_only else STATE_COLUMNS, header="comment")
    later = np.append(True, np.diff(stamps) > 0)
    wrong = np.flatnonzero(~later | (np.linalg.norm(values[:, 3:7], axis=1) < MIN_QUATERNION_LENGTH))
    if wrong.size:
        problem = f"{BODY_POSE_RULE}, found {lines[wrong[0]].text[:160]!r}"
        raise csv_malformed(path, lines[wrong[0]].number, problem)
    return stamps, rigid(rotations_of(values[:, 3:7]), values[:, :3])


class CameraOnBody(NamedTuple):
    """T_body_cam [4, 4], and what to add to a stamp of the camera's clock to have the body's (the IMU's)."""

    T_body_cam: Float64Array
    time_offset_ns: int

    def trajectory(self, body_stamps_ns: Int64Array, T_world_body: Float64Array, origin: str) -> Trajectory:
        """Poses of the body [N, 4, 4] at stamps [N] of its clock -> those of the camera in the camera's clock."""
        return Trajectory(body_stamps_ns - self.time_offset_ns, T_world_body @ self.T_body_cam, origin)


def read_camera_on_body(cam_yaml: Path) -> CameraOnBody | None:
    """The camera's ``T_BS`` and time offset; None without the file.

    Raises:
        DatasetError: ``yaml_malformed``, ``calibration_malformed``.
    """
    if not cam_yaml.is_file():
        return None
    sensor = _read_yaml(cam_yaml)
    return CameraOnBody(_read_T_BS(cam_yaml, sensor), round(_time_offset_s(cam_yaml, sensor) * 1e9))


def _mounting(cam_yaml: Path, sensor: Mapping[str, Any], imu_yaml: Path) -> Float64Array | None:
    if not imu_yaml.is_file() or "T_BS" not in sensor:
        return None
    T_BS_cam = _read_T_BS(cam_yaml, sensor)
    T_BS_imu = _read_T_BS(imu_yaml, _read_yaml(imu_yaml))
    return np.asarray(np.linalg.inv(T_BS_cam) @ T_BS_imu)


def read_cloud_pose(path: Path) -> Float64Array:
    """T_world_cloud [4, 4] from the ``sensor.yaml`` beside a room's point cloud: its ``T_WS`` or ``T_BS``; the identity
    without the file or the key.

    Raises:
        DatasetError: ``yaml_malformed``, ``calibration_malformed``.
    """
    sensor = _read_yaml(path) if path.is_file() else {}
    key = next((key for key in ("T_WS", "T_BS") if key in sensor), None)
    return np.eye(4) if key is None else _read_T_BS(path, {"T_BS": sensor[key]})


def _read_T_BS(path: Path, sensor: Mapping[str, Any]) -> Float64Array:
    matrix = sensor.get("T_BS")
    if not isinstance(matrix, Mapping):
        raise _malformed(path, "T_BS: expected a matrix of 4 rows and 4 columns, found none")
    T_BS = np.array(_numbers(path, matrix, "data", 16)).reshape(4, 4)
    rotation = T_BS[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise _malformed(path, "T_BS: expected a rigid transform, found a matrix whose first 3x3 is no rotation")
    if T_BS[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise _malformed(path, f"T_BS: expected a rigid transform with the last row 0 0 0 1, found {T_BS[3].tolist()}")
    return T_BS


def _time_offset_s(path: Path, sensor: Mapping[str, Any]) -> float:
    return _numbers(path, {TIME_OFFSET_KEY: [sensor.get(TIME_OFFSET_KEY, 0.0)]}, TIME_OFFSET_KEY, 1)[0]


def _read_yaml(path: Path) -> Mapping[str, Any]:
    # EuRoC's imu0/sensor.yaml has OpenCV's "%YAML:1.0", which is no valid YAML directive.
    text = re.sub(r"^%YAML.*$", "", read_text(path), flags=re.MULTILINE)
    try:
        content = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as err:  # ValueError: an impossible date
        mark = getattr(err, "problem_mark", None)
        line = "" if mark is None else f", line {mark.line + 1}"
        problem = getattr(err, "problem", None) or str(err)[:120]
        raise DatasetError(f"{path}{line}: expected YAML, found: {problem}", code="yaml_malformed") from err
    if not isinstance(content, Mapping):
        raise DatasetError(f"{path}: expected YAML keys, found {type(content).__name__}", code="yaml_malformed")
    return content


def _numbers(path: Path, mapping: Mapping[str, Any], name: str, count: int | None) -> list[float]:
    values = mapping.get(name)
    try:
        # YAML 1.1 reads 1e-5 (no point) as a string, hence float() and no check of the type.
        numbers = [float(value) for value in values] if isinstance(values, list) else None
    except (TypeError, ValueError):
        numbers = None
    if numbers is None or (count is not None and len(numbers) != count) or not np.isfinite(numbers).all():
        wanted = "a list of finite" if count is None else f"{count} finite"
        raise _malformed(path, f"{name}: expected {wanted} numbers, found {values!r:.80}")
    return numbers


def _malformed(path: Path, problem: str) -> DatasetError:
    return DatasetError(f"{path}: {problem}", code="calibration_malformed")
