"""KITTI raw drives behind other benchmarks: which drive a sequence was cut from, and the IMU recorded beside it.

```
raw_data/                                  beside the benchmark's folder or in it; may be a link
  2011_10_03/
    calib_imu_to_velo.txt                  and calib_cam_to_cam.txt, calib_velo_to_cam.txt; optional
    2011_10_03_drive_0027_sync/
      image_00/timestamps.txt              optional: else oxts/timestamps.txt, 10 Hz (they agree within 1 ms)
      oxts/timestamps.txt
    2011_10_03_drive_0027_extract/
      oxts/{timestamps.txt,data/*.txt}     100 Hz
```

Frame numbers of the benchmarks are those of the ``_sync`` drives. ``_extract`` drives begin some frames earlier
(https://github.com/jedeschaud/ct_icp/issues/2), so frames are never looked up there; its OXTS has stamps of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from viflow_anomaly.datasets.kitti_calibration import CalibrationFiles
from viflow_anomaly.datasets.kitti_files import OxtsFolder, OxtsRow, read_stamps
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.sensor_data import Int64Array


class DriveFrames(NamedTuple):
    """A stretch of a raw drive: the frames ``first`` to ``last`` (inclusive) of its ``_sync`` recording."""

    drive: str
    first: int
    last: int


# The odometry development kit's table ("Mapping to Raw Data"). The drive of 03 is not online.
ODOMETRY_DRIVES = {
    "00": DriveFrames("2011_10_03_drive_0027", 0, 4540),
    "01": DriveFrames("2011_10_03_drive_0042", 0, 1100),
    "02": DriveFrames("2011_10_03_drive_0034", 0, 4660),
    "03": DriveFrames("2011_09_26_drive_0067", 0, 800),
    "04": DriveFrames("2011_09_30_drive_0016", 0, 270),
    "05": DriveFrames("2011_09_30_drive_0018", 0, 2760),
    "06": DriveFrames("2011_09_30_drive_0020", 0, 1100),
    "07": DriveFrames("2011_09_30_drive_0027", 0, 1100),
    "08": DriveFrames("2011_09_30_drive_0028", 1100, 5170),
    "09": DriveFrames("2011_09_30_drive_0033", 0, 1590),
    "10": DriveFrames("2011_09_30_drive_0034", 0, 1200),
}


def find_raw_data(benchmark: Path) -> Path:
    """``raw_data`` in the benchmark's folder, else beside it.

    Raises:
        DatasetError: ``kitti_raw_missing``.
    """
    places = (benchmark / "raw_data", benchmark.parent / "raw_data")
    for place in places:
        if place.is_dir():
            return place
    raise DatasetError(
        f"{benchmark}: expected the raw drives, which have the IMU, in {places[0]} or {places[1]} (a link will do), "
        "found neither",
        code="kitti_raw_missing",
    )


@dataclass(frozen=True)
class RawDrive:
    """One drive, as ``_sync`` (which says when its frames were taken) and ``_extract`` (which has the IMU at 100 Hz).

    Args:
        raw_data: holds the folders of the days.
        name: ``2011_10_03_drive_0027``.

    Lists of stamps and files are read once, when they are first asked for.
    """

    raw_data: Path
    name: str
    _frame_stamps: dict[str, tuple[Path, dict[int, int]]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @property
    def day(self) -> Path:
        return self.raw_data / self.name[: len("2011_10_03")]

    @property
    def calibration(self) -> CalibrationFiles:
        return CalibrationFiles.of_date(self.day)

    def frame_stamps(self, camera: str) -> tuple[Path, dict[int, int]]:
        """The file that says when the frames of ``image_<camera>`` were taken, and {frame number: nanoseconds}.

        Raises:
            DatasetError: ``kitti_raw_missing``, ``timestamps_malformed``, ``text_not_utf8``.
        """
        if camera not in self._frame_stamps:
            self._frame_stamps[camera] = self._read_frame_stamps(camera)
        return self._frame_stamps[camera]

    def _read_frame_stamps(self, camera: str) -> tuple[Path, dict[int, int]]:
        drive = self.day / f"{self.name}_sync"
        for folder in (f"image_{camera}", "oxts"):
            path = drive / folder / "timestamps.txt"
            if path.is_file():
                return path, read_stamps(path)
        raise self._missing(drive, f"image_{camera}/timestamps.txt or oxts/timestamps.txt")

    def oxts(self, first_ns: int, last_ns: int) -> tuple[Int64Array, list[OxtsRow]]:
        """The 100 Hz records between two stamps, as they were recorded.

        Raises:
            DatasetError: ``kitti_raw_missing``, and those of ``OxtsFolder`` and its ``read``.
        """
        return self._oxts.read((first_ns, last_ns))

    @cached_property
    def _oxts(self) -> OxtsFolder:
        drive = self.day / f"{self.name}_extract"
        if not (drive / "oxts" / "timestamps.txt").is_file() or not (drive / "oxts" / "data").is_dir():
            raise self._missing(drive, "oxts/timestamps.txt and oxts/data/")
        return OxtsFolder(drive / "oxts")

    @staticmethod
    def _missing(drive: Path, files: str) -> DatasetError:
        found = "no such folder" if not drive.is_dir() else "a folder without"
        return DatasetError(f"{drive}: expected {files}, found {found}", code="kitti_raw_missing")
