"""PNG and JPEG bytes -> grayscale uint8.

Size limits are checked on the header, before anything is decoded. OpenCV decodes truncated files without complaint and
fills the rest with gray, so completeness is checked here first: PNG by walking its chunks with their checksums, JPEG
by walking its segments to the end-of-image marker.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.config import ImageLimits
from viflow_anomaly.errors import DatasetError, InvalidInputError, TooLargeError, UnsupportedImageError
from viflow_anomaly.sensor_data import Uint8Array

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_SIGNATURE = b"\xff\xd8\xff"
PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type; PNG specification, table 11.1
PNG_BIT_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}

JPEG_SOF = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # ITU T.81 table B.1: DHT, JPG and DAC are no frames
JPEG_STANDALONE = frozenset({0x01, *range(0xD0, 0xD8)})  # TEM and RST0..7 carry no length
JPEG_EOI, JPEG_SOS = 0xD9, 0xDA
JPEG_MARKER_IN_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]", re.DOTALL)


@dataclass(frozen=True)
class _Header:
    kind: str
    width: int
    height: int


class _BrokenImageError(Exception):
    """Why the bytes are no complete image; turned into the public error in one place."""


def decode_image(data: bytes, *, limits: ImageLimits, field: str) -> Uint8Array:
    """Decode PNG or JPEG bytes to gray levels, [H, W] uint8.

    8-bit gray, colour, palette and alpha (ignored) are accepted; 16-bit PNG is scaled by 1/257 with rounding. The
    EXIF orientation is ignored: the calibration belongs to the pixels as they are stored.

    Args:
        data: the whole file.
        limits: on bytes and on pixels.
        field: the input's name, for the errors.

    Raises:
        InvalidInputError: ``image_empty``, ``image_truncated_or_corrupt``.
        UnsupportedImageError: ``image_unsupported_type``.
        TooLargeError: ``image_too_many_bytes``, ``image_too_many_pixels``.
    """
    try:
        header = _checked_header(data, limits=limits, field=field)
        _check_complete(data, header)
        pixels = _decode(data, header)
    except _BrokenImageError as err:
        raise _corrupt(field, str(err)) from err
    return _to_gray_uint8(pixels)


def read_image(path: Path, *, limits: ImageLimits, field: str) -> Uint8Array:
    """Read one image file, [H, W] uint8; as ``decode_image``, with the path in every message.

    Raises:
        DatasetError: ``image_missing``.
        InvalidInputError: as ``decode_image``.
    """
    data = _read_bytes(path, limits=limits, field=field)
    try:
        return decode_image(data, limits=limits, field=field)
    except InvalidInputError as err:
        raise type(err)(f"{path}: {err.message}", code=err.code, field=err.field) from err


def read_image_size(path: Path, *, limits: ImageLimits, field: str) -> tuple[int, int]:
    """(width, height) in pixels from the file's header; the picture itself is not decoded.

    Raises:
        DatasetError: ``image_missing``.
        InvalidInputError: as ``decode_image``.
    """
    data = _read_bytes(path, limits=limits, field=field)
    try:
        header = _checked_header(data, limits=limits, field=field)
    except _BrokenImageError as err:
        raise _corrupt(f"{path}: {field}", str(err), field=field) from err
    except InvalidInputError as err:
        raise type(err)(f"{path}: {err.message}", code=err.code, field=err.field) from err
    return header.width, header.height


def _read_bytes(path: Path, *, limits: ImageLimits, field: str) -> bytes:
    try:
        size = path.stat().st_size
        if size > limits.max_bytes:
            raise _too_many_bytes(f"{path}: {field}", size, limits, field=field)
        return path.read_bytes()
    except OSError as err:
        raise DatasetError(
            f"{path}: expected an image file, found {err.strerror or err}", code="image_missing", field=field
        ) from err


def _corrupt(where: str, reason: str, *, field: str | None = None) -> InvalidInputError:
    return InvalidInputError(
        f"{where}: expected a complete image, found {reason}", code="image_truncated_or_corrupt", field=field or where
    )


def _too_many_bytes(where: str, size: int, limits: ImageLimits, *, field: str) -> TooLargeError:
    return TooLargeError(
        f"{where}: expected at most {limits.max_bytes} bytes, found {size}", code="image_too_many_bytes", field=field
    )


def _checked_header(data: bytes, *, limits: ImageLimits, field: str) -> _Header:
    if not data:
        raise InvalidInputError(f"{field}: expected an image, found zero bytes", code="image_empty", field=field)
    if len(data) > limits.max_bytes:
        raise _too_many_bytes(field, len(data), limits, field=field)
    header = _header(data)
    if header is None:
        raise UnsupportedImageError(
            f"{field}: expected a PNG or JPEG file, found one that starts with {data[:8]!r}",
            code="image_unsupported_type",
            field=field,
        )
    if header.width * header.height > limits.max_pixels:
        raise TooLargeError(
            f"{field}: expected at most {limits.max_pixels} pixels, found {header.width}x{header.height}",
            code="image_too_many_pixels",
            field=field,
        )
    return header


def _header(data: bytes) -> _Header | None:
    for signature, read in ((PNG_SIGNATURE, _png_header), (JPEG_SIGNATURE, _jpeg_header)):
        if data.startswith(signature):
            return read(data)
        if signature.startswith(data):
            raise _BrokenImageError(f"only {len(data)} bytes")
    return None


def _png_header(data: bytes) -> _Header:
    if len(data) < 33:
        raise _BrokenImageError("a PNG that ends in its header")
    length, name, width, height, depth, colour = struct.unpack(">I4sIIBB", data[8:26])
    if name != b"IHDR" or length != 13:
        raise _BrokenImageError("a PNG without IHDR")
    if not 0 < width < 2**31 or not 0 < height < 2**31 or depth not in PNG_BIT_DEPTHS.get(colour, ()):
        raise _BrokenImageError(f"a PNG of {width}x{height} px, colour type {colour}, {depth} bits")
    return _Header("png", width, height)


def _jpeg_header(data: bytes) -> _Header:
    for marker, start, end in _jpeg_segments(data):
        if marker in JPEG_SOF:
            if end - start < 6:
                raise _BrokenImageError("a JPEG frame header that is too short")
            height, width = struct.unpack(">HH", data[start + 1 : start + 5])
            if not width or not height:
                raise _BrokenImageError(f"a JPEG of {width}x{height} px")
            return _Header("jpeg", width, height)
        if marker == JPEG_SOS:
            break
    raise _BrokenImageError("a JPEG without frame header")


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """(marker, start, end) of each segment's content up to the end-of-image marker; the scan data are skipped."""
    position = 2
    while True:
        if data[position : position + 1] != b"\xff":
            raise _BrokenImageError(f"a JPEG without marker at byte {position}")
        while data[position : position + 1] == b"\xff":
            position += 1
        marker = data[position] if position < len(data) else None
        position += 1
        if marker == JPEG_EOI:
            return
        if marker in JPEG_STANDALONE:
            continue
        length = int.from_bytes(data[position : position + 2], "big")
        if marker is None or length < 2 or position + length > len(data):
            raise _BrokenImageError("a JPEG that ends before its end-of-image marker")
        yield marker, position + 2, position + length
        position += length
        if marker == JPEG_SOS:
            following = JPEG_MARKER_IN_SCAN.search(data, position)
            if following is None:
                raise _BrokenImageError("a JPEG that ends before its end-of-image marker")
            position = following.start()


def _check_complete(data: bytes, header: _Header) -> None:
    if header.kind == "png":
        _check_png_chunks(data)
        return
    for _ in _jpeg_segments(data):
        continue


def _check_png_chunks(data: bytes) -> None:
    position = len(PNG_SIGNATURE)
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        end = position + 12 + length
        if end > len(data):
            break
        checksum = int.from_bytes(data[end - 4 : end], "big")
        if zlib.crc32(memoryview(data)[position + 4 : end - 4]) != checksum:
            raise _BrokenImageError(f"a PNG with a damaged chunk at byte {position}")
        if data[position + 4 : position + 8] == b"IEND":
            return
        position = end
    raise _BrokenImageError("a PNG that ends before its last chunk")


def _decode(data: bytes, header: _Header) -> NDArray[Any]:
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION if header.kind == "jpeg" else cv2.IMREAD_UNCHANGED
    try:
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error as err:
        raise _BrokenImageError(f"a {header.kind.upper()} that OpenCV refuses") from err
    if pixels is None or pixels.shape[:2] != (header.height, header.width):
        raise _BrokenImageError(f"a {header.kind.upper()} whose content cannot be decoded")
    return np.asarray(pixels)


def _to_gray_uint8(pixels: NDArray[Any]) -> Uint8Array:
    if pixels.ndim == 3:
        code = cv2.COLOR_BGRA2GRAY if pixels.shape[2] == 4 else cv2.COLOR_BGR2GRAY
        pixels = cv2.cvtColor(pixels, code)
    if pixels.dtype == np.uint16:
        return np.asarray((pixels.astype(np.uint32) + 128) // 257, dtype=np.uint8)
    return np.asarray(pixels, dtype=np.uint8)
