"""KITTI odometry sequences 00 to 10 as published, with the IMU of the raw drives that they were cut from.

```
dataset/
  sequences/00/                            this folder; its name says which drive it is
    image_0/000000.png ...                 or image_1, image_2, image_3
    times.txt                              seconds since the first frame
    calib.txt                              optional: P0: ... P3: and Tr:
  poses/00.txt                             optional: 12 numbers a line and frame, T_world_cam0
  raw_data/                                or beside dataset/; may be a link; see kitti_drives.py
    2011_10_03/2011_10_03_drive_0027_sync/image_00/timestamps.txt
    2011_10_03/2011_10_03_drive_0027_extract/oxts/
```

A frame's stamp is the raw drive's stamp of the sequence's first frame plus the seconds in ``times.txt``. The IMU is the
100 Hz OXTS of ``_extract``, with its duplicates, disorder and gaps: they fail for the pairs that they touch only.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from viflow_anomaly.config import ImageLimits
from viflow_anomaly.datasets.kitti_calibration import read_odometry_camera
from viflow_anomaly.datasets.kitti_drives import ODOMETRY_DRIVES, DriveFrames, RawDrive, find_raw_data
from viflow_anomaly.datasets.kitti_files import (
    SPEED_NAMES,
    first_image_size,
    forward_speeds,
    image_files,
    oxts_imu,
    read_seconds,
    stamp_of,
)
from viflow_anomaly.datasets.kitti_poses import read_odometry_trajectory
from viflow_anomaly.datasets.kitti_sequence import cameras_of, dataset_of, frame_stamps
from viflow_anomaly.datasets.recording import FileRecording, choose_camera
from viflow_anomaly.errors import DatasetError

NEEDS = "a folder named 00 to 21 with image_0..3/ and times.txt, and raw_data/ beside sequences/ or above it"
MARGIN_NS = 1_000_000_000
"""How much IMU is read before the first frame and after the last."""
MAX_DISAGREEMENT_NS = 50_000_000
"""Half a frame interval: beyond it another frame of the drive fits ``times.txt`` better."""


def find_root(path: Path) -> Path | None:
    """``path`` itself when it is a sequence of the benchmark, else None (with an IMU file: ``kitti_odometry``)."""
    numbered = re.fullmatch(r"[01][0-9]|2[01]", path.resolve().name) is not None
    return path if numbered and (path / "times.txt").is_file() and cameras_of(path) else None


def open_kitti_odometry_raw(root: Path, *, camera: str | None, limits: ImageLimits) -> FileRecording:
    """Open the sequence that ``find_root`` found.

    Args:
        root: the sequence's folder.
        camera: ``image_0`` to ``image_3``; None takes image_0, else image_2, else what there is.
        limits: on every image.

    Raises:
        DatasetError: ``kitti_raw_missing`` (also for 11 to 21, whose drives are not published), ``kitti_raw_mismatch``
            (another number of frames than the table of drives has, or other times than the drive's),
            ``camera_unknown``, ``no_frames``, ``timestamps_malformed``, ``timestamps_missing``,
            ``timestamps_not_increasing``, ``oxts_malformed``, ``imu_not_covering``, ``file_name_malformed``,
            ``calibration_malformed``;
            of the trajectory, when it is asked for: ``poses_malformed``, ``poses_ambiguous``.
    """
    chosen = choose_camera(root, cameras_of(root), camera)
    images = image_files(root / chosen)
    frames = _frames_of(root.resolve().name)
    drive = RawDrive(find_raw_data(dataset_of(root)), frames.drive)
    times = _stamps(root / "times.txt", drive, frames, f"0{chosen[-1]}")
    stamps, every_stamp = frame_stamps(root / "times.txt", times, list(images))
    imu_stamps, rows = drive.oxts(int(stamps[0]) - MARGIN_NS, int(stamps[-1]) + MARGIN_NS)
    size = first_image_size(images.values(), limits=limits)
    return FileRecording(
        name=root.resolve().name,
        root=root,
        format="kitti_odometry_raw",
        camera=read_odometry_camera(root, chosen[-1], size, imu_to_velo=drive.calibration.imu_to_velo),
        imu=oxts_imu(imu_stamps, rows),
        frame_timestamps_ns=stamps,
        camera_name=chosen,
        frame_paths=tuple(images.values()),
        motor_commands=forward_speeds(stamps, imu_stamps, rows),
        motor_names=SPEED_NAMES,
        limits=limits,
        read_trajectory=partial(read_odometry_trajectory, root, chosen[-1], every_stamp),
    )


def _frames_of(sequence: str) -> DriveFrames:
    if sequence not in ODOMETRY_DRIVES:
        raise DatasetError(
            f"sequence {sequence}: expected one whose raw drive is published ({', '.join(ODOMETRY_DRIVES)}), found one "
            "without, and so without IMU",
            code="kitti_raw_missing",
        )
    return ODOMETRY_DRIVES[sequence]


def _stamps(times_file: Path, drive: RawDrive, frames: DriveFrames, camera: str) -> dict[int, int]:
    """{frame of the sequence: nanoseconds in the raw drive's clock}."""
    times = read_seconds(times_file)
    count = frames.last - frames.first + 1
    if len(times) != count or max(times) != count - 1:
        raise DatasetError(
            f"{times_file}: expected {count} times, for the frames {frames.first} to {frames.last} of {frames.drive}, "
            f"found {len(times)}",
            code="kitti_raw_mismatch",
        )
    path, raw = drive.frame_stamps(camera)
    start = stamp_of(path, raw, frames.first)
    stamps = {number: start + time for number, time in times.items()}
    for number, stamp in stamps.items():
        recorded = stamp_of(path, raw, frames.first + number)
        if abs(recorded - stamp) > MAX_DISAGREEMENT_NS:
            after_s = (recorded - start) * 1e-9
            raise DatasetError(
                f"{times_file}, line {number + 1}: expected the time of frame {frames.first + number} of "
                f"{frames.drive}, {after_s:.3f} s after the first, found {times[number] * 1e-9:.3f} s",
                code="kitti_raw_mismatch",
            )
    return stamps
