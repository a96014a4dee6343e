"""Poses for the frames of a recording, from a trajectory or from a trajectory file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np

from viflow_anomaly.datasets.euroc import (
    BODY_POSE_RULE,
    MIN_QUATERNION_LENGTH,
    read_body_poses,
    read_camera_on_body,
)
from viflow_anomaly.datasets.tables import csv_malformed, parse_numbers, read_lines
from viflow_anomaly.datasets.trajectory import Trajectory, rigid, rotations_of
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.sensor_data import MAX_TIMESTAMP_NS, Float64Array, Int64Array

MAX_GAP_NS = 10_000_000
"""Between poses this close a pose may be interpolated: EuRoC's states come every 5 ms. At 20 Hz a flying camera's
acceleration alone would be worth pixels."""

MAX_STAMP_DIFFERENCE_NS = 1_000_000
"""Where nothing can be interpolated, a pose this close in time is taken for the frame's own."""

POSE_RULE = "interpolated between two at most 10 ms apart, else the nearest one within 1 ms"
"""``poses_of_frames`` in words; help and documentation have the same."""

TUM_COLUMNS = ("time", "p_x", "p_y", "p_z", "q_x", "q_y", "q_z", "q_w")


def read_trajectory_file(path: Path, cam_yaml: Path) -> Trajectory:
    """Poses of a body from a file, as those of the camera in its clock: ``T_world_body T_BS``, stamps less its offset.

    With commas: EuRoC's states, also as OpenVINS writes them (stamp in nanoseconds, position, quaternion w x y z, and
    perhaps velocity and biases). With spaces: TUM's (seconds, position, quaternion x y z w).

    Args:
        path: the file; its stamps are in the body's (the IMU's) clock.
        cam_yaml: the camera's ``sensor.yaml``, for its ``T_BS`` and time offset.

    Raises:
        DatasetError: ``trajectory_missing`` (no ``cam_yaml``), ``csv_malformed``, ``yaml_malformed``,
            ``calibration_malformed``, ``file_missing``, ``text_not_utf8``.
    """
    mounting = read_camera_on_body(cam_yaml)
    if mounting is None:
        raise DatasetError(
            f"{cam_yaml}: expected the camera's sensor.yaml with T_BS, found no such file", code="trajectory_missing"
        )
    lines = [line for line in read_lines(path) if not line.text.startswith("#")]
    is_tum = bool(lines) and "," not in lines[0].text
    stamps, T_world_body = _read_tum(path) if is_tum else read_body_poses(path)
    return mounting.trajectory(stamps, T_world_body, str(path))


def _read_tum(path: Path) -> tuple[Int64Array, Float64Array]:
    stamps: list[int] = []
    rows = []
    for line in read_lines(path):
        if line.text.startswith("#"):
            continue
        cells = line.text.split()
        if len(cells) != len(TUM_COLUMNS) or not re.fullmatch(r"\d{1,10}(\.\d+)?([eE]\+?0?\d)?", cells[0], re.ASCII):
            raise csv_malformed(path, line.number, f"expected {' '.join(TUM_COLUMNS)}, found {line.text[:80]!r}")
        stamp = round(Decimal(cells[0]) * 1_000_000_000)
        values = parse_numbers(path, line.number, cells[1:])
        later = not stamps or stamp > stamps[-1]
        if not later or stamp > MAX_TIMESTAMP_NS or np.linalg.norm(values[3:]) < MIN_QUATERNION_LENGTH:
            raise csv_malformed(path, line.number, f"{BODY_POSE_RULE}, found {line.text[:160]!r}")
        stamps.append(stamp)
        rows.append(values)
    poses = np.array(rows)
    return np.array(stamps, dtype=np.int64), rigid(rotations_of(poses[:, [6, 3, 4, 5]]), poses[:, :3])


def poses_of_frames(trajectory: Trajectory, stamps_ns: Sequence[int]) -> dict[int, Float64Array]:
    """{stamp: T_world_cam [4, 4]} of the frames with a pose, by ``POSE_RULE``."""
    found = {}
    times = trajectory.timestamps_ns
    for stamp in stamps_ns:
        after = int(np.searchsorted(times, stamp))
        near = [k for k in (after - 1, after) if 0 <= k < times.size]
        best = min(near, key=lambda k: abs(int(times[k]) - stamp))
        if len(near) == 2 and int(times[after] - times[after - 1]) <= MAX_GAP_NS:
            found[stamp] = trajectory.pose(stamp)
        elif abs(int(times[best]) - stamp) <= MAX_STAMP_DIFFERENCE_NS:
            found[stamp] = trajectory.T_world_cam[best].copy()
    return found


def quaternion_of(rotation: Float64Array) -> Float64Array:
    """Rotation matrix [3, 3] -> quaternion w x y z: the first eigenvector of Horn's matrix (JOSA A 1987)."""
    R = rotation
    horn = np.array(
        [
            [R[0, 0] + R[1, 1] + R[2, 2], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [0.0, R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
            [0.0, 0.0, R[1, 1] - R[0, 0] - R[2, 2], R[1, 2] + R[2, 1]],
            [0.0, 0.0, 0.0, R[2, 2] - R[0, 0] - R[1, 1]],
        ]
    )
    quaternion = np.linalg.eigh(horn, UPLO="U").eigenvectors[:, -1]
    return np.asarray(quaternion if quaternion[0] >= 0 else -quaternion)
