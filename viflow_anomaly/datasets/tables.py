"""Text files of numbers: read strictly, every complaint with file and line."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from viflow_anomaly.errors import DatasetError
from viflow_anomaly.sensor_data import MAX_TIMESTAMP_NS, MIN_IMU_TIMESTAMP_NS, Float64Array, Int64Array


@dataclass(frozen=True)
class TextLine:
    """One line that holds something: its number (from 1) and its text without surrounding white space."""

    number: int
    text: str


def csv_malformed(path: Path, line: int, problem: str) -> DatasetError:
    return DatasetError(f"{path}, line {line}: {problem}", code="csv_malformed")


def read_text(path: Path) -> str:
    """UTF-8 text with newlines as ``\\n``; a byte-order mark and CRLF are accepted.

    Raises:
        DatasetError: ``file_missing``, ``text_not_utf8``.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as err:
        raise DatasetError(f"{path}: expected a text file, found {err.strerror or err}", code="file_missing") from err
    except UnicodeDecodeError as err:
        raise DatasetError(f"{path}: expected UTF-8 text, found {err.reason}", code="text_not_utf8") from err
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_lines(path: Path) -> list[TextLine]:
    """The lines of a text that are not blank; as ``read_text``."""
    lines = enumerate(read_text(path).split("\n"), start=1)
    return [TextLine(number, line.strip()) for number, line in lines if line.strip()]


def read_csv(path: Path, columns: Sequence[str], *, header: str) -> Iterator[tuple[int, list[str]]]:
    """(line number, cells) of each row; every row must have exactly ``columns``.

    Args:
        path: the file.
        columns: names of the columns, for the messages; their order is the file's.
        header: ``"comment"``: lines that start with ``#`` are skipped. ``"names"``: the first line must be the
            column names (upper case and spaces do not matter).

    Raises:
        DatasetError: ``csv_malformed``, ``file_missing``, ``text_not_utf8``.
    """
    lines = read_lines(path)
    if header == "comment":
        lines = [line for line in lines if not line.text.startswith("#")]
    else:
        _check_names(path, lines[0] if lines else None, columns)
        lines = lines[1:]
    for line in lines:
        cells = [cell.strip() for cell in line.text.split(",")]
        if len(cells) != len(columns):
            raise csv_malformed(
                path, line.number, f"expected {len(columns)} cells ({', '.join(columns)}), found {len(cells)}"
            )
        yield line.number, cells


def _check_names(path: Path, first: TextLine | None, columns: Sequence[str]) -> None:
    found = "an empty file" if first is None else repr(first.text[:120])
    names = [] if first is None else [cell.strip().lower() for cell in first.text.lstrip("#").split(",")]
    if names != list(columns):
        raise csv_malformed(path, 1 if first is None else first.number, f"expected {','.join(columns)}, found {found}")


def parse_integer_ns(path: Path, line: int, cell: str, *, lowest: int = 0) -> int:
    """Nanoseconds written as an integer; a float would have lost digits already, so it is refused."""
    if not re.fullmatch(r"-?[0-9]{1,19}", cell) or not lowest <= int(cell) <= MAX_TIMESTAMP_NS:
        raise csv_malformed(
            path,
            line,
            f"expected a timestamp in whole nanoseconds, {lowest} to {MAX_TIMESTAMP_NS}, found {cell[:40]!r}",
        )
    return int(cell)


def parse_numbers(path: Path, line: int, cells: Sequence[str]) -> list[float]:
    """Finite decimal numbers."""
    values = []
    for cell in cells:
        try:
            value = float(cell)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise csv_malformed(path, line, f"expected a finite number, found {cell[:40]!r}")
        values.append(value)
    return values


def read_stamped_numbers(path: Path, columns: Sequence[str], *, header: str) -> tuple[Int64Array, Float64Array]:
    """A table whose first column is a stamp: stamps [N] int64 (in file order, not checked) and values [N, C].

    Raises:
        DatasetError: ``csv_malformed`` (also without any row), ``file_missing``, ``text_not_utf8``.
    """
    stamps, rows = [], []
    for line, cells in read_csv(path, columns, header=header):
        stamps.append(parse_integer_ns(path, line, cells[0], lowest=MIN_IMU_TIMESTAMP_NS))
        rows.append(parse_numbers(path, line, cells[1:]))
    if not rows:
        raise csv_malformed(path, 1, f"expected rows of {', '.join(columns)}, found none")
    return np.array(stamps, dtype=np.int64), np.array(rows, dtype=np.float64)


class FrameList(NamedTuple):
    """Stamps [F], strictly increasing; F image files; the numbers of further columns [F, C]."""

    timestamps_ns: Int64Array
    paths: list[Path]
    values: Float64Array


def read_frame_list(path: Path, columns: Sequence[str], images: Path, *, header: str) -> FrameList:
    """A table of stamp, file name (below ``images``) and, where ``columns`` has more than two, numbers.

    Raises:
        DatasetError: ``timestamps_not_increasing``, ``image_missing`` (the table names a file that is not there),
            ``csv_malformed``, ``file_missing``, ``text_not_utf8``.
    """
    stamps, lines, paths, values = [], [], [], []
    for line, cells in read_csv(path, columns, header=header):
        stamps.append(parse_integer_ns(path, line, cells[0]))
        lines.append(line)
        paths.append(_image_below(path, line, images, cells[1]))
        values.append(parse_numbers(path, line, cells[2:]))
    check_increasing(path, stamps, lines)
    numbers = np.array(values, dtype=np.float64).reshape(len(stamps), len(columns) - 2)
    return FrameList(np.array(stamps, dtype=np.int64), paths, numbers)


def _image_below(path: Path, line: int, images: Path, name: str) -> Path:
    relative = PurePosixPath(name)
    if not name or relative.is_absolute() or ".." in relative.parts:
        raise csv_malformed(path, line, f"expected the name of an image below {images}, found {name[:120]!r}")
    image = images / relative
    try:
        found = image.is_file()
    except OSError:  # a name that the file system cannot hold
        found = False
    if not found:
        raise DatasetError(f"{path}, line {line}: expected the image {image}, found no such file", code="image_missing")
    return image


def check_increasing(path: Path, stamps: Sequence[int], lines: Sequence[int]) -> None:
    """Raises DatasetError ``timestamps_not_increasing`` at the first stamp that is not later than the last."""
    for earlier, later, line in zip(stamps[:-1], stamps[1:], lines[1:], strict=True):
        if later <= earlier:
            problem = "a duplicate of the one before it" if later == earlier else f"{later} after {earlier}"
            raise DatasetError(
                f"{path}, line {line}: expected stamps that increase, found {problem}",
                code="timestamps_not_increasing",
            )
