"""Point clouds in PLY files (Turk 1994), as EuRoC's ``mav0/pointcloud0/data.ply``: ascii or binary, x y z and more.

```
ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property float intensity
end_header
0.1 0.2 0.3 17
...
```
"""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.errors import DatasetError, TooLargeError

Float32Array = NDArray[np.float32]

MAX_HEADER_BYTES = 65536
MAX_LINE_BYTES = 65536
MAX_POINTS = 100_000_000
BLOCK_BYTES = 16 * 1024 * 1024
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
SCALARS = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
AXES = ("x", "y", "z")


@dataclass
class _Element:
    """``element name count`` and its properties: name -> numpy type, None for a list."""

    name: str
    count: int
    properties: dict[str, str | None]


def read_ply_points(path: Path, *, max_points: int = MAX_POINTS) -> Float32Array:
    """The points of the element ``vertex``, [N, 3] float32; those that are not finite (no return) are left out.

    Raises:
        DatasetError: ``point_cloud_missing``, ``point_cloud_malformed``.
        TooLargeError: ``point_cloud_too_large``.
    """
    try:
        with path.open("rb") as file:
            points = _read(path, file, max_points)
    except OSError as err:
        raise DatasetError(
            f"{path}: expected a PLY point cloud, found {err.strerror or err}", code="point_cloud_missing"
        ) from err
    points = points[np.isfinite(points).all(axis=1)]
    if not points.size:
        raise _malformed(path, "expected at least one finite point, found none")
    return points


def _read(path: Path, file: BinaryIO, max_points: int) -> Float32Array:
    order, elements = _read_header(path, file)
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise _malformed(path, f"expected an element vertex, found {', '.join(names) or 'no element'}")
    needed = elements[: names.index("vertex") + 1]
    vertex = needed[-1]
    if vertex.count > max_points:
        raise TooLargeError(
            f"{path}: expected at most {max_points} points, found {vertex.count}", code="point_cloud_too_large"
        )
    missing = [axis for axis in AXES if vertex.properties.get(axis) is None]
    lists = [element.name for element in needed if None in element.properties.values()]
    if missing or lists:
        found = f"no number {', '.join(missing)}" if missing else f"a list in {', '.join(lists)}"
        raise _malformed(path, f"expected points of numbers with x, y and z, found {found}")
    return _read_ascii(path, file, needed) if order == "ascii" else _read_binary(path, file, needed, BYTE_ORDERS[order])


def _read_header(path: Path, file: BinaryIO) -> tuple[str, list[_Element]]:
    lines = _header_lines(path, file)
    order = ""
    elements: list[_Element] = []
    for number, line in enumerate(lines, start=2):
        words = line.split()
        match words:
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", kind, "1.0"] if kind in BYTE_ORDERS and not order:
                order = kind
            case ["element", name, count] if count.isdecimal() and len(count) < 19:
                elements.append(_Element(name, int(count), {}))
            case ["property", "list", size, kind, name] if elements and size in SCALARS and kind in SCALARS:
                elements[-1].properties[name] = None
            case ["property", kind, name] if elements and kind in SCALARS and name not in elements[-1].properties:
                elements[-1].properties[name] = SCALARS[kind]
            case _:
                raise _malformed(path, f"line {number}: expected a line of a PLY 1.0 header, found {line[:80]!r}")
    if not order:
        raise _malformed(path, "expected a line with the format, found none in the header")
    return order, elements


def _header_lines(path: Path, file: BinaryIO) -> list[str]:
    """The lines between ``ply`` and ``end_header``; the file stands at the first byte of data then."""
    lines: list[str] = []
    read = 0
    while read < MAX_HEADER_BYTES:
        raw = file.readline(MAX_HEADER_BYTES)
        read += len(raw)
        line = raw.decode("ascii", errors="replace").strip()
        if not lines and line != "ply":
            raise _malformed(path, f"expected a PLY file, found one that starts with {raw[:8]!r}")
        if line == "end_header":
            return lines[1:]
        if not raw:
            break
        lines.append(line)
    raise _malformed(path, f"expected end_header within {MAX_HEADER_BYTES} bytes, found none")


def _read_binary(path: Path, file: BinaryIO, elements: list[_Element], order: str) -> Float32Array:
    *before, vertex = elements
    dtypes = [np.dtype([(name, order + str(kind)) for name, kind in e.properties.items()]) for e in elements]
    skip = sum(element.count * dtype.itemsize for element, dtype in zip(before, dtypes[:-1], strict=True))
    dtype = dtypes[-1]
    start = file.tell() + skip
    size = file.seek(0, io.SEEK_END)
    if size < start + vertex.count * dtype.itemsize:
        whole = max(0, size - start) // dtype.itemsize
        raise _malformed(path, f"expected {vertex.count} points, found a file that ends after {whole}")
    file.seek(start)
    points = np.empty((vertex.count, 3), np.float32)
    block = max(1, BLOCK_BYTES // dtype.itemsize)  # rows may have thousands of properties, of which three are wanted
    for first in range(0, vertex.count, block):
        rows = np.fromfile(file, dtype, count=min(block, vertex.count - first))
        for column, axis in enumerate(AXES):
            points[first : first + len(rows), column] = rows[axis]
    return points


def _read_ascii(path: Path, file: BinaryIO, elements: list[_Element]) -> Float32Array:
    *before, vertex = elements
    names = list(vertex.properties)
    for _ in range(sum(element.count for element in before)):
        if not _line(path, file):
            break
    data = _bytes_left(file)
    if data < vertex.count * 2 * len(names) - 1:  # a digit and what separates it, for every number; NumPy allocates all
        raise _malformed(path, f"expected {vertex.count} lines of {' '.join(names)}, found only {data} bytes of data")
    columns = [names.index(axis) for axis in AXES]
    if not vertex.count:
        return np.empty((0, 3), np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numpy warns where the data end early; the count below says so better
        try:
            lines = (line.decode("ascii") for line in iter(partial(_line, path, file), b""))
            points = np.loadtxt(lines, dtype=np.float32, usecols=columns, max_rows=vertex.count, comments=None, ndmin=2)
        except ValueError as err:
            raise _malformed(path, f"expected {vertex.count} lines of {' '.join(names)}, found {err}") from err
    if len(points) != vertex.count:
        raise _malformed(path, f"expected {vertex.count} points, found a file that ends after {len(points)}")
    return points


def _line(path: Path, file: BinaryIO) -> bytes:
    line = file.readline(MAX_LINE_BYTES)
    if len(line) == MAX_LINE_BYTES:
        raise _malformed(path, f"expected lines of less than {MAX_LINE_BYTES} bytes, found a longer one")
    return line


def _bytes_left(file: BinaryIO) -> int:
    here = file.tell()
    end = file.seek(0, io.SEEK_END)
    file.seek(here)
    return end - here


def _malformed(path: Path, problem: str) -> DatasetError:
    return DatasetError(f"{path}: {problem}", code="point_cloud_malformed")
