"""KITTI's text files: timestamps, OXTS rows, calibration keys. Shared by the raw and the odometry reader."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path

import numpy as np

from viflow_anomaly.config import ImageLimits
from viflow_anomaly.datasets.tables import read_lines
from viflow_anomaly.errors import DatasetError, ViflowError
from viflow_anomaly.images import read_image_size
from viflow_anomaly.imu_log import ImuLog
from viflow_anomaly.sensor_data import Float64Array, Int64Array

# oxts/dataformat.txt: ax ay az and wx wy wz are along the unit's own axes (front, left, top); af al au and wf wl wu are
# levelled to the horizon and no IMU would measure them.
OXTS_COLUMNS = 30
OXTS_PLACE = slice(0, 6)
OXTS_FORWARD_SPEED = 8
OXTS_ACCEL = slice(11, 14)
OXTS_GYRO = slice(17, 20)

SPEED_NAMES = ("forward_speed_m_s",)
"""What a KITTI recording's motor command is: OXTS ``vf``."""

STAMP = re.compile(r"(\d{4})-(\d\d)-(\d\d) (\d\d):(\d\d):(\d\d)\.(\d{1,9})", re.ASCII)


@dataclass(frozen=True)
class OxtsRow:
    """One OXTS record; the unit's axes are x front, y left, z top.

    Args:
        gyro_rad_s, accel_m_s2: [3] each.
        forward_speed_m_s: along the ground.
        place: [6] latitude and longitude in degrees, altitude in metres; roll, pitch and yaw in radians.
    """

    gyro_rad_s: Float64Array
    accel_m_s2: Float64Array
    forward_speed_m_s: float
    place: Float64Array


def malformed(path: Path, line: int, code: str, problem: str) -> DatasetError:
    return DatasetError(f"{path}, line {line}: {problem}", code=code)


def parse_stamp_ns(text: str) -> int | None:
    """``2011-09-26 13:04:32.349659964`` -> nanoseconds since 1970, exact (no float); None when it is no such stamp.

    KITTI does not name its time zone; UTC is taken, only differences matter.
    """
    match = STAMP.fullmatch(text)
    if match is None:
        return None
    try:
        moment = datetime(*(int(part) for part in match.groups()[:6]), tzinfo=UTC)  # type: ignore[misc,arg-type]
    except ValueError:
        return None
    seconds = int((moment - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds())
    return seconds * 1_000_000_000 + int(match.group(7).ljust(9, "0"))


def read_stamps(path: Path) -> dict[int, int]:
    """``timestamps.txt``: {record number from 0: nanoseconds}; a blank line is a record without stamp.

    Raises:
        DatasetError: ``timestamps_malformed``, ``file_missing``, ``text_not_utf8``.
    """
    stamps = {}
    for line in read_lines(path):
        stamp = parse_stamp_ns(line.text)
        if stamp is None:
            raise malformed(
                path,
                line.number,
                "timestamps_malformed",
                f"expected a stamp like 2011-09-26 13:04:32.349659964, found {line.text[:60]!r}",
            )
        stamps[line.number - 1] = stamp
    return stamps


def read_seconds(path: Path) -> dict[int, int]:
    """The odometry benchmark's ``times.txt``: {record number from 0: nanoseconds since the first frame}.

    Raises:
        DatasetError: ``timestamps_malformed``, ``file_missing``, ``text_not_utf8``.
    """
    stamps = {}
    for line in read_lines(path):
        if (
            not re.fullmatch(r"\d+(\.\d+)?([eE][+-]?\d{1,2})?", line.text, re.ASCII)
            or Decimal(line.text) > 9_000_000_000
        ):
            raise malformed(path, line.number, "timestamps_malformed", f"expected seconds, found {line.text[:60]!r}")
        stamps[line.number - 1] = round(Decimal(line.text) * 1_000_000_000)
    return stamps


def parse_oxts(path: Path, line: int, text: str) -> OxtsRow:
    """One line of OXTS numbers.

    Raises:
        DatasetError: ``oxts_malformed``.
    """
    cells = text.split()
    if len(cells) != OXTS_COLUMNS:
        raise malformed(path, line, "oxts_malformed", f"expected {OXTS_COLUMNS} numbers, found {len(cells)}")
    values = np.array(finite_numbers(path, line, "oxts_malformed", cells))
    speed = float(values[OXTS_FORWARD_SPEED])
    return OxtsRow(values[OXTS_GYRO], values[OXTS_ACCEL], speed, values[OXTS_PLACE])


def finite_numbers(path: Path, line: int, code: str, cells: list[str]) -> list[float]:
    """Numbers of a line.

    Raises:
        DatasetError: ``code``: a cell that is no finite number.
    """
    values = []
    for cell in cells:
        try:
            value = float(cell)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise malformed(path, line, code, f"expected finite numbers, found {cell[:40]!r}")
        values.append(value)
    return values


def read_oxts_file(path: Path) -> OxtsRow:
    """``oxts/data/0000000000.txt``: exactly one record.

    Raises:
        DatasetError: ``oxts_malformed``, ``file_missing``, ``text_not_utf8``.
    """
    lines = read_lines(path)
    if len(lines) != 1:
        raise malformed(path, 1, "oxts_malformed", f"expected one line, found {len(lines)}")
    return parse_oxts(path, lines[0].number, lines[0].text)


class OxtsFolder:
    """``oxts/``: stamps and files are listed once, records read when they are asked for.

    Args:
        folder: holds ``timestamps.txt`` and ``data/``.

    Raises:
        DatasetError: ``timestamps_malformed``, ``file_name_malformed``, ``file_missing``, ``text_not_utf8``.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stamps = read_stamps(folder / "timestamps.txt")
        self._files = numbered_files(folder / "data", (".txt",))

    def read(self, span: tuple[int, int] | None = None) -> tuple[Int64Array, list[OxtsRow]]:
        """Stamps [N], in the order of the records, and the records.

        Args:
            span: (first, last) nanoseconds: only the records from the first to the last that lie inside, so that
                disorder among them stays; None: all.

        Raises:
            DatasetError: ``oxts_malformed`` (also without any record), ``imu_not_covering`` (none inside ``span``),
                ``timestamps_missing``, ``file_missing``, ``text_not_utf8``.
        """
        stamps, files = self._stamps, self._files
        if span is not None:
            inside = [number for number in files if number in stamps and span[0] <= stamps[number] <= span[1]]
            files = {number: file for number, file in files.items() if inside and inside[0] <= number <= inside[-1]}
            if not files:
                raise DatasetError(
                    f"{self._folder}: expected records between {span[0]} and {span[1]} ns, found none",
                    code="imu_not_covering",
                )
        if not files:
            raise DatasetError(
                f"{self._folder / 'data'}: expected at least one record, found none", code="oxts_malformed"
            )
        path = self._folder / "timestamps.txt"
        numbers = np.array([stamp_of(path, stamps, number) for number in files], dtype=np.int64)
        return numbers, [read_oxts_file(file) for file in files.values()]


def oxts_places(rows: Sequence[OxtsRow]) -> Float64Array:
    """[N, 6] as ``OxtsRow.place``; the records themselves need not be kept."""
    return np.array([row.place for row in rows])


def oxts_imu(imu_stamps: Int64Array, rows: Sequence[OxtsRow]) -> ImuLog:
    """The records as a raw IMU log, with whatever disorder their stamps have."""
    return ImuLog(imu_stamps, np.array([row.gyro_rad_s for row in rows]), np.array([row.accel_m_s2 for row in rows]))


def forward_speeds(stamps: Int64Array, imu_stamps: Int64Array, rows: Sequence[OxtsRow]) -> Float64Array:
    """[F, 1] forward speed in m/s of the record closest in time to each frame."""
    order = np.argsort(imu_stamps, kind="stable")
    times = imu_stamps[order]
    right = np.searchsorted(times, stamps).clip(1, max(times.size - 1, 1))
    left = right - 1
    right = right.clip(0, times.size - 1)
    nearest = np.where(stamps - times[left] <= times[right] - stamps, left, right)
    return np.array([[rows[k].forward_speed_m_s] for k in order[nearest]])


def read_calibration(
    path: Path, sizes: Mapping[str, int], *, names: Sequence[str] | None = None
) -> dict[str, Float64Array]:
    """``key: numbers`` lines; only the keys of ``sizes`` are kept, each with as many numbers as it says.

    Args:
        path: the file.
        sizes: how many numbers each key has.
        names: when the lines have no keys, what they are in order.

    Raises:
        DatasetError: ``calibration_malformed``, ``file_missing``, ``text_not_utf8``.
    """
    values = {}
    for index, line in enumerate(read_lines(path)):
        key, _, rest = line.text.partition(":")
        if names is not None:
            key, rest = (names[index] if index < len(names) else ""), line.text
        if key not in sizes:
            continue
        numbers = finite_numbers(path, line.number, "calibration_malformed", rest.split())
        if len(numbers) != sizes[key]:
            problem = f"{key}: expected {sizes[key]} numbers, found {len(numbers)}"
            raise malformed(path, line.number, "calibration_malformed", problem)
        values[key] = np.array(numbers)
    return values


def first_image_size(images: Iterable[Path], *, limits: ImageLimits) -> tuple[int, int]:
    """(width, height) of the first image whose header is sound: one broken file must not spoil a drive.

    Raises:
        ViflowError: that of the last image when none is sound.
    """
    problem: ViflowError | None = None
    for image in images:
        try:
            return read_image_size(image, limits=limits, field="image")
        except ViflowError as err:
            problem = err
    assert problem is not None
    raise problem


def numbered_files(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """{number: file} of the files named by numbers, in the order of the numbers.

    Raises:
        DatasetError: ``file_name_malformed``.
    """
    files = {}
    for file in folder.iterdir():
        if file.suffix.lower() not in suffixes:
            continue
        if not re.fullmatch(r"[0-9]+", file.stem) or int(file.stem) in files:
            raise DatasetError(
                f"{file}: expected a number of its own as the file's name, found {file.stem!r}",
                code="file_name_malformed",
            )
        files[int(file.stem)] = file
    return dict(sorted(files.items()))


def image_files(folder: Path) -> dict[int, Path]:
    """{number: image}, as ``numbered_files``.

    Raises:
        DatasetError: ``no_frames``, ``file_name_malformed``.
    """
    images = numbered_files(folder, (".png", ".jpg"))
    if not images:
        raise DatasetError(f"{folder}: expected at least one image, found none", code="no_frames")
    return images


def stamp_of(path: Path, stamps: dict[int, int], number: int) -> int:
    """The stamp of one record.

    Raises:
        DatasetError: ``timestamps_missing``.
    """
    if number not in stamps:
        raise DatasetError(
            f"{path}, line {number + 1}: expected the stamp of record {number}, found none", code="timestamps_missing"
        )
    return stamps[number]
