"""The plain layout: for recordings that come from nowhere in particular.

```
DIR/
  frames.csv        timestamp_ns,filename          (names relative to DIR)
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
from viflow_anomaly.datasets.tables import read_frame_list, read_lines, read_stamped_numbers, read_text
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.imu_log import ImuLog
from viflow_anomaly.sensor_data import PinholeCamera

NEEDS = "frames.csv and imu.csv"
FRAME_COLUMNS = ("timestamp_ns", "filename")
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
    stamps, paths = read_frame_list(root / "frames.csv", FRAME_COLUMNS, root, header="names")
    return FileRecording(
        name=root.resolve().name,
        root=root,
        format="plain",
        camera=read_camera(root / "camera.json"),
        imu=read_imu(root / "imu.csv"),
        frame_timestamps_ns=stamps,
        frame_paths=tuple(paths),
        limits=limits,
    )


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
