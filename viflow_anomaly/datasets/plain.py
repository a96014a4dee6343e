"""The plain layout: for recordings that come from nowhere in particular.

```
DIR/
  frames.csv        timestamp_ns,filename          (names relative to DIR)
                    optional further columns motor_<name>: the platform's command or speed at each frame, by name
  imu.csv           timestamp_ns,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z    rad/s, m/s^2
  camera.json       optional: fx fy cx cy width height distortion_model distortion_coeffs T_cam_imu time_offset_s
  *.png, *.jpg
```

A gyro-only sensor leaves the three ``accel_`` columns out.
"""

from __future__ import annotations

import json
from pathlib import Path

from viflow_anomaly.config import ImageLimits
from viflow_anomaly.datasets.camera_json import camera_from_mapping
from viflow_anomaly.datasets.recording import FileRecording
from viflow_anomaly.datasets.tables import csv_malformed, read_frame_list, read_lines, read_stamped_numbers, read_text
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.imu_log import ImuLog
from viflow_anomaly.sensor_data import PinholeCamera

NEEDS = "frames.csv and imu.csv"
FRAME_COLUMNS = ("timestamp_ns", "filename")
MOTOR_PREFIX = "motor_"
GYRO_COLUMNS = ("timestamp_ns", "gyro_x", "gyro_y", "gyro_z")
IMU_COLUMNS = (*GYRO_COLUMNS, "accel_x", "accel_y", "accel_z")


def find_root(path: Path) -> Path | None:
    """``path`` itself when it holds ``frames.csv`` and ``imu.csv``, else None."""
    return path if (path / "frames.csv").is_file() and (path / "imu.csv").is_file() else None


def open_plain(root: Path, *, camera: str | None, limits: ImageLimits) -> FileRecording:
    """Open the folder that ``find_root`` found.

    Args:
        root: holds the two tables.
        camera: must be None, the layout has one camera.
        limits: on every image.

    Raises:
        DatasetError: ``camera_unknown``, ``csv_malformed``, ``timestamps_not_increasing``, ``image_missing``,
            ``json_malformed``, ``calibration_malformed``.
    """
    if camera is not None:
        raise DatasetError(
            f"{root}: expected no choice of camera, the plain layout has only one, found {camera!r}",
            code="camera_unknown",
        )
    motor_names = read_motor_names(root / "frames.csv")
    columns = (*FRAME_COLUMNS, *(MOTOR_PREFIX + name for name in motor_names))
    frames = read_frame_list(root / "frames.csv", columns, root, header="names")
    return FileRecording(
        name=root.resolve().name,
        root=root,
        format="plain",
        camera=read_camera(root / "camera.json"),
        imu=read_imu(root / "imu.csv"),
        frame_timestamps_ns=frames.timestamps_ns,
        frame_paths=tuple(frames.paths),
        motor_commands=frames.values if motor_names else None,
        motor_names=motor_names,
        limits=limits,
    )


def read_motor_names(path: Path) -> tuple[str, ...]:
    """What the columns of ``frames.csv`` after ``filename`` are called, without ``motor_``; empty where they are none.

    Raises:
        DatasetError: ``csv_malformed``: a column that does not begin with ``motor_``, has no name after it, or has that
            of another; ``file_missing``, ``text_not_utf8``.
    """
    lines = read_lines(path)
    cells = [cell.strip().lower() for cell in lines[0].text.lstrip("#").split(",")] if lines else []
    if tuple(cells[:2]) != FRAME_COLUMNS:
        return ()  # read_frame_list says what is wrong
    names = tuple(cell.removeprefix(MOTOR_PREFIX) for cell in cells[2:])
    if not all(cell.startswith(MOTOR_PREFIX) for cell in cells[2:]) or "" in names or len(set(names)) < len(names):
        raise csv_malformed(
            path,
            lines[0].number,
            f"expected {','.join(FRAME_COLUMNS)} and further columns motor_<name>, each with a name of its own, found "
            f"{lines[0].text[:120]!r}",
        )
    return names


def read_imu(path: Path) -> ImuLog:
    """``imu.csv`` with or without the accelerometer's columns.

    Raises:
        DatasetError: ``csv_malformed``, ``file_missing``, ``text_not_utf8``.
    """
    lines = read_lines(path)
    gyro_only = bool(lines) and lines[0].text.count(",") == len(GYRO_COLUMNS) - 1
    stamps, values = read_stamped_numbers(path, GYRO_COLUMNS if gyro_only else IMU_COLUMNS, header="names")
    return ImuLog(stamps, values[:, :3], None if gyro_only else values[:, 3:])


def read_camera(path: Path) -> PinholeCamera | None:
    """``camera.json`` when there is one.

    Raises:
        DatasetError: ``json_malformed``, ``calibration_malformed``.
    """
    if not path.is_file():
        return None
    try:
        mapping = json.loads(read_text(path))
    except (ValueError, RecursionError) as err:
        raise DatasetError(f"{path}: expected JSON, found: {str(err)[:120]}", code="json_malformed") from err
    try:
        return camera_from_mapping(mapping)
    except InvalidInputError as err:
        raise DatasetError(f"{path}: {err.message}", code="calibration_malformed", field=err.field) from err
