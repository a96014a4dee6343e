"""Middlebury's ``.flo`` flow files: what most optical flow programs write.

Little-endian: the float32 202021.25 (the bytes ``PIEH``), width and height as int32, then u, v float32 row by row. A
component beyond 1e9 marks a pixel without an estimate (vision.middlebury.edu/flow, ``flowIO.cpp``).
"""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np

from viflow_anomaly.checkpoint_record import write_atomically
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.geometry import Float32Array

MAGIC = b"PIEH"
HEADER = struct.Struct("<4sii")
UNKNOWN_PX = 1e9
"""Beyond it a component says "unknown"."""
STORED_UNKNOWN_PX = np.float32(1e10)


def read_flo_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header, once the file is found to be as long as they say; no flow is read.

    Raises:
        DatasetError: as ``read_flo``.
    """
    try:
        with path.open("rb") as file:
            head, length = file.read(HEADER.size), file.seek(0, io.SEEK_END)
    except OSError as err:
        raise DatasetError(
            f"{path}: expected a .flo file, cannot read it: {err.strerror}", code="flow_file_missing"
        ) from err
    if len(head) < HEADER.size or head[:4] != MAGIC:
        raise _malformed(path, f"the bytes {MAGIC!r}, a width and a height", f"{head!r}")
    _, width, height = HEADER.unpack(head)
    if width < 1 or height < 1:
        raise _malformed(path, "a positive width and height", f"{width}x{height}")
    expected = HEADER.size + 8 * width * height
    if length != expected:
        raise _malformed(path, f"{expected} bytes for {width}x{height} px", f"{length}")
    return width, height


def read_flo(path: Path) -> Float32Array:
    """Flow [H, W, 2] float32 in px, NaN where the file has no estimate.

    Raises:
        DatasetError: ``flow_file_missing``; ``flow_file_malformed`` for another magic number, a size that is not
            positive, or a length that is not the size's.
    """
    width, height = read_flo_size(path)
    flow = np.fromfile(path, dtype="<f4", offset=HEADER.size, count=2 * width * height)
    flow = flow.reshape(height, width, 2).astype(np.float32)
    unknown = ~(np.abs(flow) <= UNKNOWN_PX).all(axis=-1)
    flow[unknown] = np.nan
    return flow


def write_flo(path: Path, flow_px: Float32Array) -> None:
    """Store flow [H, W, 2]; a pixel that is not finite is stored as unknown.

    Raises:
        OSError: as ``write_atomically``.
    """
    height, width, two = flow_px.shape
    assert two == 2
    unknown = ~np.isfinite(flow_px).all(axis=-1, keepdims=True)
    stored = np.where(unknown, STORED_UNKNOWN_PX, flow_px).astype("<f4")
    write_atomically(path, HEADER.pack(MAGIC, width, height) + stored.tobytes())


def _malformed(path: Path, expected: str, found: str) -> DatasetError:
    return DatasetError(f"{path}: expected {expected}, found {found}", code="flow_file_malformed")
