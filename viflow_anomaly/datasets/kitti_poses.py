"""KITTI's two kinds of ground-truth poses -> Trajectory: the odometry benchmark's files, and OXTS places.

``poses/01.txt`` of the odometry benchmark has a line a frame, 12 numbers: the rows of T_world_cam0 [3, 4], where cam0
is the rectified left gray camera and the world is its first pose.

An OXTS place becomes a pose as in the raw data's development kit (Geiger et al., IJRR 2013): Mercator coordinates at
the scale of the first record's latitude, and R = Rz(yaw) Ry(pitch) Rx(roll).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from viflow_anomaly.datasets.kitti_calibration import read_odometry_shift
from viflow_anomaly.datasets.kitti_files import finite_numbers, malformed
from viflow_anomaly.datasets.kitti_sequence import dataset_of
from viflow_anomaly.datasets.tables import read_lines
from viflow_anomaly.datasets.trajectory import Trajectory, rigid
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.sensor_data import Float64Array, Int64Array

EARTH_RADIUS_M = 6_378_137.0
ROTATION_TOLERANCE = 1e-3


def find_poses(sequence: Path) -> Path | None:
    """``../../poses/01.txt`` of ``sequences/01``, or the only file there whose name begins with the sequence's.

    Raises:
        DatasetError: ``poses_ambiguous``.
    """
    folder, name = dataset_of(sequence) / "poses", sequence.resolve().name
    exact = folder / f"{name}.txt"
    if exact.is_file() or not folder.is_dir():
        return exact if exact.is_file() else None
    # 01_first51.txt belongs to sequence 01; 011.txt does not.
    files = [file for file in sorted(folder.glob("*.txt")) if re.fullmatch(re.escape(name) + r"\D.*", file.stem)]
    if len(files) > 1:
        found = ", ".join(file.name for file in files[:6])
        raise DatasetError(f"{folder}: expected one file of poses of {name}, found {found}", code="poses_ambiguous")
    return files[0] if files else None


def read_poses(path: Path, count: int) -> Float64Array:
    """[count, 4, 4] T_world_cam0.

    Raises:
        DatasetError: ``poses_malformed`` (also another number of poses than ``count``: nobody knows then which frame a
            pose belongs to), ``file_missing``, ``text_not_utf8``.
    """
    lines = read_lines(path)
    if len(lines) != count:
        raise DatasetError(
            f"{path}: expected a pose for each of {count} frames, found {len(lines)}", code="poses_malformed"
        )
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, line in zip(poses, lines, strict=True):
        numbers = finite_numbers(path, line.number, "poses_malformed", line.text.split())
        if len(numbers) != 12:
            raise malformed(path, line.number, "poses_malformed", f"expected 12 numbers, found {len(numbers)}")
        pose[:3] = np.reshape(numbers, (3, 4))
        R = pose[:3, :3]
        if not np.allclose(R @ R.T, np.eye(3), atol=ROTATION_TOLERANCE) or np.linalg.det(R) < 0:
            raise malformed(path, line.number, "poses_malformed", "expected a rotation in columns 1 to 3 of its rows")
    return poses


def read_odometry_trajectory(sequence: Path, number: str, timestamps_ns: Int64Array) -> Trajectory | None:
    """The poses of the camera ``image_<number>`` of a sequence; None without a file of poses, or where no calibration
    says how that camera lies to the left gray one.

    Args:
        sequence: its folder.
        number: ``"0"`` to ``"3"``.
        timestamps_ns: [N] of all frames of the sequence, also of those whose image is not there.

    Raises:
        DatasetError: ``poses_ambiguous``, ``poses_malformed``, ``calibration_malformed``, ``file_missing``,
            ``text_not_utf8``.
    """
    T_cam_cam0 = read_odometry_shift(sequence, number)
    path = find_poses(sequence)
    if T_cam_cam0 is None or path is None:
        return None
    poses = read_poses(path, timestamps_ns.size)
    return Trajectory(timestamps_ns, poses @ np.linalg.inv(T_cam_cam0), str(path))


def oxts_poses(places: Float64Array) -> Float64Array:
    """[N, 6] latitude, longitude (degrees), altitude (m), roll, pitch, yaw (rad) -> [N, 4, 4] T_world_imu in metres.

    The world's axes point east, north and up; its origin is the first place.
    """
    latitudes, longitudes, altitudes = places[:, 0], places[:, 1], places[:, 2]
    scale = EARTH_RADIUS_M * np.cos(np.radians(latitudes[0]))
    east = scale * np.radians(longitudes)
    north = scale * np.log(np.tan(np.radians(90.0 + latitudes) / 2))
    positions = np.stack([east, north, altitudes], axis=1)
    rotations = _axis_rotations(2, places[:, 5]) @ _axis_rotations(1, places[:, 4]) @ _axis_rotations(0, places[:, 3])
    return rigid(rotations, positions - positions[0])


def _axis_rotations(axis: int, angles_rad: Float64Array) -> Float64Array:
    rotations = np.zeros((angles_rad.size, 3, 3))
    j, k = (axis + 1) % 3, (axis + 2) % 3
    rotations[:, axis, axis] = 1.0
    rotations[:, j, j] = rotations[:, k, k] = np.cos(angles_rad)
    rotations[:, k, j] = np.sin(angles_rad)
    rotations[:, j, k] = -rotations[:, k, j]
    return rotations


def oxts_trajectory(
    timestamps_ns: Int64Array, places: Float64Array, T_cam_imu: Float64Array | None, origin: str
) -> Trajectory | None:
    """The camera's poses from the places [N, 6] of OXTS records; None where the mounting is unknown.

    Of duplicate and disordered stamps (``_extract``) only the records that are later than all before them stay.
    """
    if T_cam_imu is None:
        return None
    latest = np.maximum.accumulate(timestamps_ns)
    later = np.append(True, timestamps_ns[1:] > latest[:-1])
    T_world_imu = oxts_poses(places[later])
    return Trajectory(timestamps_ns[later], T_world_imu @ np.linalg.inv(T_cam_imu), origin)
