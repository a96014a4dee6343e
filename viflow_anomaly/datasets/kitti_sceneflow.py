"""KITTI scene flow 2015 training pairs (Menze & Geiger, CVPR 2015) with the IMU of their raw drives.

```
ROOT/
  training/
    image_2/000000_10.png, 000000_11.png ...     source and target, left colour camera
    flow_occ/000000_10.png ...                   flow of all pixels with ground truth
    flow_noc/000000_10.png ...                   only of those that stay in the image
    obj_map/000000_10.png ...                    0 the static world, 1.. moving cars
    calib_cam_to_cam/000000.txt ...              optional, like calib_velo_to_cam/ and calib_imu_to_velo/
  devkit/mapping/train_mapping.txt               or mapping/train_mapping.txt
  raw_data/                                      or beside ROOT; see kitti_drives.py
```

Line n + 1 of the mapping says which raw frame ``00000n_10.png`` is (``_11`` is the next one), as in
``2011_09_26 2011_09_26_drive_0005_sync 0000000059``, or is empty: the image is of no published drive. The paper uses
the 140 of 200 images that map to a drive with continuous IMU around the pair; which these are is found, not listed.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.config import ImageLimits, MotionWindowConfig, MotorSource
from viflow_anomaly.datasets.ground_truth_png import read_flow_png, read_instances_png
from viflow_anomaly.datasets.kitti_calibration import CalibrationFiles, read_raw_camera
from viflow_anomaly.datasets.kitti_drives import RawDrive, find_raw_data
from viflow_anomaly.datasets.kitti_files import forward_speeds, oxts_imu, oxts_places
from viflow_anomaly.datasets.kitti_poses import oxts_trajectory
from viflow_anomaly.datasets.tables import read_text
from viflow_anomaly.datasets.usable_pairs import Interval, window_fault
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.images import read_image
from viflow_anomaly.sensor_data import (
    Float64Array,
    Frame,
    FramePair,
    ImuSamples,
    Int64Array,
    PinholeCamera,
    Uint8Array,
)

PAPER_WINDOW = MotionWindowConfig(layout="paper_kitti", axes="sensor")
BEFORE_NS, AFTER_NS = 120_000_000, 20_000_000
"""What the 20x6 window touches and a sample more: 100 ms before the source, 110 ms after it or up to the target."""
MAPPING_LINE = re.compile(r"(\d{4}_\d\d_\d\d) (\1_drive_\d{4})_sync (\d{10})", re.ASCII)


class _Usable(NamedTuple):
    number: int
    drive: RawDrive
    interval: Interval
    imu: ImuSamples
    motor_command: NDArray[np.float64]
    oxts: tuple[Int64Array, Float64Array]
    """Stamps [N] and places [N, 6]."""


class KittiSceneFlow:
    """Labelled pairs: those of the training set that have a continuous IMU.

    Args:
        root: holds ``training/`` and the mapping.
        raw_data: the raw drives; None: ``root/raw_data`` or ``raw_data`` beside ``root``.
        flow: ``occ``: all ground truth, ``noc``: without the pixels that leave the image.
        window: the motion window that a pair must be good for.
        limits: on every image.

    Attributes:
        excluded: how many images were left out for each reason: ``no_raw_drive``, ``kitti_raw_missing``,
            ``timestamps_missing`` (the drive has no stamp for the frame), and the codes of ``usable_pairs``.

    Raises:
        DatasetError: ``kitti_raw_missing`` (no raw data at all), ``mapping_malformed``, ``no_frames`` (no image),
            ``no_usable_pairs``, ``timestamps_malformed``, ``timestamps_missing`` (a record of the IMU without stamp),
            ``oxts_malformed``, ``file_name_malformed``, ``file_missing``, ``text_not_utf8``.
    """

    def __init__(
        self,
        root: Path,
        *,
        raw_data: Path | None = None,
        flow: Literal["occ", "noc"] = "occ",
        window: MotionWindowConfig = PAPER_WINDOW,
        limits: ImageLimits | None = None,
    ) -> None:
        self.root = root
        self._training = root / "training"
        self._flow = flow
        self._limits = limits or ImageLimits()
        self._pairs: list[_Usable] = []
        excluded: Counter[str] = Counter()
        raw_data = raw_data or find_raw_data(root.resolve())
        mapping = _read_mapping(root, self._numbers())
        drives = {frame[0]: RawDrive(raw_data, frame[0]) for frame in mapping.values() if frame is not None}
        for number, frame in mapping.items():
            found = "no_raw_drive" if frame is None else _find(number, drives[frame[0]], frame[1], window)
            if isinstance(found, _Usable):
                self._pairs.append(found)
            else:
                excluded[found] += 1
        self.excluded: dict[str, int] = dict(excluded)
        if not self._pairs:
            raise DatasetError(
                f"{root}: expected at least one pair with IMU, found none (left out: {self.excluded})",
                code="no_usable_pairs",
            )

    def _numbers(self) -> list[int]:
        images = self._training / "image_2"
        numbers = [int(file.name[:6]) for file in sorted(images.glob("[0-9][0-9][0-9][0-9][0-9][0-9]_10.png"))]
        if not numbers:
            raise DatasetError(f"{images}: expected 000000_10.png and more, found none", code="no_frames")
        return numbers

    def __len__(self) -> int:
        return len(self._pairs)

    def number(self, index: int) -> int:
        """The pair's number in the training set, 0 to 199."""
        return self._pairs[index].number

    def sequence(self, index: int) -> str:
        """The raw drive, ``2011_09_26_drive_0005``."""
        return self._pairs[index].drive.name

    def stamps(self, index: int) -> tuple[int, int]:
        """(source, target) stamps in nanoseconds."""
        return self._pairs[index].interval

    def pair(self, index: int, motor_source: MotorSource | None = "command") -> FramePair:
        """Both images, the 100 Hz IMU around them, the camera, the forward speed or the camera's displacement.

        Raises:
            IndexError: outside.
            DatasetError: ``image_missing``, ``calibration_malformed``; for a displacement ``trajectory_missing`` (the
                mounting is unknown) and ``trajectory_not_covering``.
            InvalidInputError: as ``images.read_image`` and ``FramePair``.
        """
        found = self._pairs[index]
        folder = self._training / "image_2"
        source, target = (
            Frame(stamp, read_image(folder / f"{found.number:06d}_{name}.png", limits=self._limits, field="image"))
            for stamp, name in zip(found.interval, ("10", "11"), strict=True)
        )
        height, width = source.image.shape
        camera = self._camera(found, (width, height))
        command = self._displacement(found, camera) if motor_source == "displacement" else found.motor_command
        return FramePair(source, target, found.imu, camera, command)

    def _displacement(self, found: _Usable, camera: PinholeCamera | None) -> NDArray[np.float64]:
        origin = f"{found.drive.name} around image {found.number:06d}"
        trajectory = oxts_trajectory(*found.oxts, None if camera is None else camera.T_cam_imu, origin)
        if trajectory is None:
            raise DatasetError(
                f"{origin}: expected the IMU's mounting on the camera, to say how far it moved, found none",
                code="trajectory_missing",
                field="motor_command",
            )
        return trajectory.displacement_m(*found.interval)

    def truth(self, index: int) -> tuple[Float32Array, NDArray[np.bool_]]:
        """Flow [H, W, 2] in px from source to target (0 where unknown), and where it is known [H, W].

        Raises:
            IndexError: outside.
            DatasetError: ``ground_truth_missing``, ``ground_truth_malformed``.
        """
        return read_flow_png(self._training / f"flow_{self._flow}" / f"{self.number(index):06d}_10.png")

    def moving(self, index: int) -> Uint8Array:
        """[H, W]: 0 the static world, 1.. cars that move by themselves.

        Raises:
            IndexError: outside.
            DatasetError: ``ground_truth_missing``, ``ground_truth_malformed``.
        """
        return read_instances_png(self._training / "obj_map" / f"{self.number(index):06d}_10.png")

    def _camera(self, found: _Usable, size: tuple[int, int]) -> PinholeCamera | None:
        """The pair's own calibration, each file that it lacks from the day of the drive."""
        day = found.drive.calibration
        own = {
            name: self._training / f"calib_{name}" / f"{found.number:06d}.txt"
            for name in ("cam_to_cam", "velo_to_cam", "imu_to_velo")
        }
        files = {name: path if path.is_file() else getattr(day, name) for name, path in own.items()}
        return read_raw_camera(CalibrationFiles(**files), "02", size)


def _read_mapping(root: Path, numbers: list[int]) -> Mapping[int, tuple[str, int] | None]:
    """{number of the image: (drive, frame)}, None where the line is empty."""
    places = (root / "devkit" / "mapping" / "train_mapping.txt", root / "mapping" / "train_mapping.txt")
    path = next((place for place in places if place.is_file()), places[0])
    lines = read_text(path).split("\n")
    frames: dict[int, tuple[str, int] | None] = {}
    for number in numbers:
        if number >= len(lines):
            raise DatasetError(
                f"{path}: expected a line for image {number:06d}, found {len(lines) - 1} lines",
                code="mapping_malformed",
            )
        text = " ".join(lines[number].split())
        match = MAPPING_LINE.fullmatch(text)
        if text and match is None:
            raise DatasetError(
                f"{path}, line {number + 1}: expected 2011_09_26 2011_09_26_drive_0005_sync 0000000059 or nothing, "
                f"found {text[:80]!r}",
                code="mapping_malformed",
            )
        frames[number] = None if match is None else (match.group(2), int(match.group(3)))
    return frames


def _find(number: int, drive: RawDrive, frame: int, window: MotionWindowConfig) -> _Usable | str:
    """The IMU around a raw frame and the next one, or the reason why there is none."""
    try:
        _, stamps = drive.frame_stamps("02")
        if frame not in stamps or frame + 1 not in stamps:
            return "timestamps_missing"
        interval = Interval(stamps[frame], stamps[frame + 1])
        imu_stamps, rows = drive.oxts(interval.source_ns - BEFORE_NS, interval.target_ns + AFTER_NS)
        log = oxts_imu(imu_stamps, rows)
        imu = log.between(interval.source_ns - BEFORE_NS, interval.target_ns + AFTER_NS)
        fault = window_fault(interval, imu, window)
    except (DatasetError, InvalidInputError) as err:
        if isinstance(err, DatasetError) and err.code not in {"kitti_raw_missing", "imu_not_covering"}:
            raise
        return err.code
    if fault is not None:
        return fault
    speed = forward_speeds(np.array([interval.source_ns]), imu_stamps, rows)[0]
    return _Usable(number, drive, interval, imu, speed, (imu_stamps, oxts_places(rows)))
