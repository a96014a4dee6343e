"""KITTI odometry sequences with an IMU file, which the benchmark itself does not have.

```
sequences/01/
  image_0/000000.png ...           or image_1, image_2, image_3
  times.txt                        seconds since the first frame; or oxts_timestamps*.txt with the raw data's stamps
  imu_10perframe*.csv              sample,ax,ay,az,wx,wy,wz; or imu.csv as in the plain layout
  calib.txt                        optional: P0: ... P3: and Tr:; or calib_*.txt with unnamed lines in that order
  calib_imu_to_velo.txt            optional
  oxts*.txt                        optional: one OXTS record a line and frame, for the forward speed
poses/01.txt                       optional: 12 numbers a line and frame, T_world_cam0; or one other file 01*.txt
```

The samples of ``imu_<n>perframe*.csv`` carry no stamps. Sample n * i belongs to frame i (it agrees with OXTS record i
of the same drive to the sensor's noise) and the n - 1 between are spread evenly between the stamps of the two frames,
so a file for F frames has n * (F - 1) + 1 rows.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np

from viflow_anomaly.config import ImageLimits
from viflow_anomaly.datasets.kitti_calibration import read_odometry_camera
from viflow_anomaly.datasets.kitti_files import (
    SPEED_NAMES,
    first_image_size,
    image_files,
    parse_oxts,
    read_seconds,
    read_stamps,
)
from viflow_anomaly.datasets.kitti_poses import read_odometry_trajectory
from viflow_anomaly.datasets.kitti_sequence import cameras_of, frame_stamps
from viflow_anomaly.datasets.plain import read_imu
from viflow_anomaly.datasets.recording import FileRecording, choose_camera
from viflow_anomaly.datasets.tables import parse_numbers, read_csv, read_lines
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.imu_log import ImuLog
from viflow_anomaly.sensor_data import Float64Array, Int64Array

NEEDS = "image_0..3/, times.txt or oxts_timestamps*.txt, and imu_<n>perframe*.csv or imu.csv"
IMU_COLUMNS = ("sample", "ax", "ay", "az", "wx", "wy", "wz")


def find_root(path: Path) -> Path | None:
    """``path`` itself when it is a sequence with an IMU file, else None."""
    found = cameras_of(path) and _stamps_file(path) and (_per_frame_file(path) or (path / "imu.csv").is_file())
    return path if found else None


def open_kitti_odometry(root: Path, *, camera: str | None, limits: ImageLimits) -> FileRecording:
    """Open the sequence that ``find_root`` found.

    Args:
        root: the sequence's folder.
        camera: ``image_0`` to ``image_3``; None takes image_0, else image_2, else what there is.
        limits: on every image.

    Raises:
        DatasetError: ``camera_unknown``, ``no_frames``, ``timestamps_malformed``, ``timestamps_missing``,
            ``timestamps_not_increasing``, ``csv_malformed``, ``oxts_malformed``, ``file_name_malformed``,
            ``calibration_malformed``.
    """
    chosen = choose_camera(root, cameras_of(root), camera)
    images = image_files(root / chosen)
    stamps_file = _stamps_file(root)
    assert stamps_file is not None
    stamps = read_seconds(stamps_file) if stamps_file.name == "times.txt" else read_stamps(stamps_file)
    timestamps_ns, every_stamp = frame_stamps(stamps_file, stamps, list(images))
    per_frame = _per_frame_file(root)
    speeds = _read_speeds(root, list(images))
    return FileRecording(
        name=root.resolve().name,
        root=root,
        format="kitti_odometry",
        camera=read_odometry_camera(root, chosen[-1], first_image_size(images.values(), limits=limits)),
        imu=read_imu(root / "imu.csv") if per_frame is None else _read_per_frame(per_frame, every_stamp),
        frame_timestamps_ns=timestamps_ns,
        camera_name=chosen,
        frame_paths=tuple(images.values()),
        motor_commands=speeds,
        motor_names=() if speeds is None else SPEED_NAMES,
        limits=limits,
        read_trajectory=partial(read_odometry_trajectory, root, chosen[-1], every_stamp),
    )


def _stamps_file(root: Path) -> Path | None:
    times = root / "times.txt"
    return times if times.is_file() else next(iter(sorted(root.glob("oxts_timestamps*.txt"))), None)


def _per_frame_file(root: Path) -> Path | None:
    return next((file for file in sorted(root.glob("imu_*.csv")) if _samples_per_frame(file)), None)


def _samples_per_frame(path: Path) -> int:
    match = re.match(r"imu_([1-9][0-9]{0,3})perframe", path.name)
    return int(match.group(1)) if match else 0


def _read_per_frame(path: Path, stamps: Int64Array) -> ImuLog:
    rows: list[list[float]] = []
    for line, cells in read_csv(path, IMU_COLUMNS, header="names"):
        numbers = parse_numbers(path, line, cells)
        if numbers[0] != len(rows):
            raise DatasetError(
                f"{path}, line {line}: expected sample {len(rows)}, found {cells[0][:40]}", code="csv_malformed"
            )
        rows.append(numbers[1:])
    per_frame = _samples_per_frame(path)
    expected = per_frame * (stamps.size - 1) + 1
    if len(rows) != expected:
        raise DatasetError(
            f"{path}: expected {expected} samples ({per_frame} for each of {stamps.size - 1} frame intervals and one "
            f"for the last frame), found {len(rows)}",
            code="csv_malformed",
        )
    values = np.array(rows)
    return ImuLog(_spread(stamps, per_frame), values[:, 3:], values[:, :3])


def _spread(stamps: Int64Array, per_frame: int) -> Int64Array:
    """[F] -> [per_frame * (F - 1) + 1]: evenly between each two stamps, in integers."""
    steps = np.diff(stamps)[:, None] * np.arange(per_frame) // per_frame
    return np.append((stamps[:-1, None] + steps).reshape(-1), stamps[-1])


def _read_speeds(root: Path, numbers: list[int]) -> Float64Array | None:
    """[F, 1] forward speed in m/s from ``oxts*.txt`` (one record a line), None where there is none."""
    files = [file for file in sorted(root.glob("oxts*.txt")) if "timestamps" not in file.name]
    if not files:
        return None
    speeds = {line.number - 1: parse_oxts(files[0], line.number, line.text) for line in read_lines(files[0])}
    for number in numbers:
        if number not in speeds:
            raise DatasetError(
                f"{files[0]}, line {number + 1}: expected the record of frame {number}, found none",
                code="oxts_malformed",
            )
    return np.array([[speeds[number].forward_speed_m_s] for number in numbers])
