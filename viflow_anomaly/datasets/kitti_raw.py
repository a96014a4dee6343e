"""KITTI raw data (Geiger et al., IJRR 2013): ``*_sync`` and ``*_extract`` drives.

```
2011_09_26/
  calib_cam_to_cam.txt  calib_velo_to_cam.txt  calib_imu_to_velo.txt      optional
  2011_09_26_drive_0005_sync/
    image_02/data/0000000000.png ...
    image_02/timestamps.txt        optional in _sync: the OXTS stamps then stand for the frames
    oxts/data/0000000000.txt ...
    oxts/timestamps.txt
```

A file's number is its line in ``timestamps.txt``. In ``_sync`` drives OXTS record i belongs to frame i (10 Hz, about
one IMU sample a frame pair). In ``_extract`` drives OXTS runs at 100 Hz on stamps of its own, with known duplicates and
disorder: they are kept as they are and reported for the pairs that they touch.

The images of ``_sync`` are rectified (``P_rect_0x``); those of ``_extract`` are not (``K_0x``, ``D_0x``). Which one
applies is told by the image size, because folders get renamed.

The trajectory comes from the OXTS places, with the mounting; without calibration there is none.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from viflow_anomaly.config import ImageLimits
from viflow_anomaly.datasets.kitti_calibration import CalibrationFiles, read_raw_camera
from viflow_anomaly.datasets.kitti_files import (
    SPEED_NAMES,
    OxtsFolder,
    first_image_size,
    forward_speeds,
    image_files,
    oxts_imu,
    oxts_places,
    read_stamps,
    stamp_of,
)
from viflow_anomaly.datasets.kitti_poses import oxts_trajectory
from viflow_anomaly.datasets.recording import FileRecording, choose_camera
from viflow_anomaly.datasets.tables import check_increasing
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.sensor_data import Int64Array

NEEDS = "image_00..03/data/, oxts/data/ and oxts/timestamps.txt"
CAMERAS = ("image_02", "image_00", "image_01", "image_03")
# _sync drives have 10 OXTS records a second, _extract drives 100: nothing lies between.
MIN_SYNC_INTERVAL_NS = 50_000_000


def find_root(path: Path) -> Path | None:
    """``path`` itself when it is a drive, else None."""
    has_oxts = (path / "oxts" / "timestamps.txt").is_file() and (path / "oxts" / "data").is_dir()
    return path if has_oxts and _cameras(path) else None


def open_kitti_raw(root: Path, *, camera: str | None, limits: ImageLimits) -> FileRecording:
    """Open the drive that ``find_root`` found.

    Args:
        root: the drive's folder.
        camera: ``image_00`` to ``image_03``; None takes image_02, else the first there is.
        limits: on every image.

    Raises:
        DatasetError: ``camera_unknown``, ``no_frames``, ``timestamps_malformed``, ``timestamps_missing``,
            ``timestamps_not_increasing``, ``oxts_malformed``, ``file_name_malformed``, ``calibration_malformed``.
    """
    chosen = choose_camera(root, _cameras(root), camera)
    images = image_files(root / chosen / "data")
    imu_stamps, rows = OxtsFolder(root / "oxts").read()
    stamps = _frame_stamps(root, chosen, list(images), imu_stamps)
    files = CalibrationFiles.of_date(root.resolve().parent)
    calibration = read_raw_camera(files, chosen[-2:], first_image_size(images.values(), limits=limits))
    T_cam_imu = None if calibration is None else calibration.T_cam_imu
    return FileRecording(
        name=root.resolve().name,
        root=root,
        format="kitti_raw",
        camera=calibration,
        camera_name=chosen,
        imu=oxts_imu(imu_stamps, rows),
        frame_timestamps_ns=stamps,
        frame_paths=tuple(images.values()),
        motor_commands=forward_speeds(stamps, imu_stamps, rows),
        motor_names=SPEED_NAMES,
        limits=limits,
        read_trajectory=partial(oxts_trajectory, imu_stamps, oxts_places(rows), T_cam_imu, str(root / "oxts")),
    )


def _cameras(root: Path) -> list[str]:
    return [name for name in CAMERAS if (root / name / "data").is_dir()]


def _frame_stamps(root: Path, camera: str, numbers: list[int], imu_stamps: Int64Array) -> Int64Array:
    path = root / camera / "timestamps.txt"
    if not path.is_file():
        path = root / "oxts" / "timestamps.txt"
        if imu_stamps.size > 1 and np.median(np.diff(imu_stamps)) < MIN_SYNC_INTERVAL_NS:
            raise DatasetError(
                f"{root / camera / 'timestamps.txt'}: expected the stamps of the frames (OXTS runs faster than the "
                "camera here, so its stamps cannot stand for them), found no such file",
                code="timestamps_missing",
            )
    stamps = read_stamps(path)
    chosen = [stamp_of(path, stamps, number) for number in numbers]
    check_increasing(path, chosen, [number + 1 for number in numbers])
    return np.array(chosen, dtype=np.int64)
