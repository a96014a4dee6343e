"""Decoding: every accepted kind of picture, every way of being broken, nothing decoded before the limits hold."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds import encode, textured_image, write_png

from viflow_anomaly.config import ImageLimits
from viflow_anomaly.errors import DatasetError, InvalidInputError, TooLargeError, UnsupportedImageError
from viflow_anomaly.images import PNG_SIGNATURE, decode_image, read_image, read_image_size

LIMITS = ImageLimits()
GRAY = textured_image(70, 50)
COLOUR = np.dstack([textured_image(70, 50, seed=k) for k in range(3)])
PNG = encode(".png", GRAY)
JPEG = encode(".jpg", GRAY)


def decode(data: bytes, limits: ImageLimits = LIMITS) -> np.ndarray:
    return decode_image(data, limits=limits, field="source")


def chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def png(width: int, height: int, *, depth: int = 8, colour: int = 0, rows: bytes = b"", extra: bytes = b"") -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    return PNG_SIGNATURE + header + extra + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def segment(marker: int, content: bytes) -> bytes:
    return bytes([0xFF, marker]) + struct.pack(">H", len(content) + 2) + content


def expect(code: str, data: bytes, limits: ImageLimits = LIMITS) -> InvalidInputError:
    with pytest.raises(InvalidInputError) as caught:
        decode(data, limits)
    assert caught.value.code == code
    assert caught.value.field == "source"
    return caught.value


def test_gray_png_is_returned_exactly() -> None:
    image = decode(PNG)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, GRAY)


def test_gray_jpeg_is_close() -> None:
    assert np.abs(decode(JPEG).astype(int) - GRAY).max() < 30


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_colour_becomes_luma(suffix: str) -> None:
    difference = decode(encode(suffix, COLOUR)).astype(int) - cv2.cvtColor(COLOUR, cv2.COLOR_BGR2GRAY)
    assert np.abs(difference).mean() < (0.01 if suffix == ".png" else 12)


def test_alpha_is_ignored() -> None:
    alpha = np.full(GRAY.shape, 3, dtype=np.uint8)
    np.testing.assert_array_equal(decode(encode(".png", np.dstack([GRAY, GRAY, GRAY, alpha]))), GRAY)


def test_gray_with_alpha() -> None:
    rows = b"".join(b"\0" + np.dstack([row, row // 2]).tobytes() for row in GRAY[:, None])
    np.testing.assert_array_equal(decode(png(70, 50, colour=4, rows=rows)), GRAY)


def test_palette() -> None:
    palette = chunk(b"PLTE", bytes(value for level in range(256) for value in (255 - level,) * 3))
    rows = b"".join(b"\0" + row.tobytes() for row in GRAY)
    np.testing.assert_array_equal(decode(png(70, 50, colour=3, rows=rows, extra=palette)), 255 - GRAY)


def test_one_bit() -> None:
    rows = b"".join(b"\0" + np.packbits(row > 99).tobytes() for row in GRAY)
    np.testing.assert_array_equal(decode(png(70, 50, depth=1, rows=rows)), np.where(GRAY > 99, 255, 0))


def test_sixteen_bits_are_scaled_by_257_with_rounding() -> None:
    levels = np.zeros((40, 40), dtype=np.uint16)
    levels[0, :5] = (65535, 257, 128, 129, 257 * 77 + 128)
    assert decode(encode(".png", levels))[0, :5].tolist() == [255, 1, 0, 1, 77]


def test_sixteen_bit_colour() -> None:
    deep = COLOUR.astype(np.uint16) * 257
    assert np.abs(decode(encode(".png", deep)).astype(int) - cv2.cvtColor(COLOUR, cv2.COLOR_BGR2GRAY)).max() <= 1


def test_exif_orientation_is_ignored() -> None:
    tag = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"  # orientation 6: turn by 90 degrees
    turned = JPEG[:2] + segment(0xE1, b"Exif\0\0" + tag) + JPEG[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_GRAYSCALE).shape == (70, 50)
    np.testing.assert_array_equal(decode(turned), decode(JPEG))


def test_progressive_jpeg_with_restarts_and_trailing_bytes() -> None:
    parameters = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 2]
    data = cv2.imencode(".jpg", GRAY, parameters)[1].tobytes()
    np.testing.assert_array_equal(decode(data + b"camera maker's note"), decode(data))


def test_fill_bytes_and_standalone_markers_before_a_segment() -> None:
    np.testing.assert_array_equal(decode(JPEG[:2] + b"\xff\xff" + JPEG[2:]), decode(JPEG))
    np.testing.assert_array_equal(decode(JPEG[:-2] + b"\xff\xff\xd9"), decode(JPEG))
    np.testing.assert_array_equal(decode(JPEG[:2] + b"\xff\x01" + JPEG[2:]), decode(JPEG))


def test_empty() -> None:
    expect("image_empty", b"")


@pytest.mark.parametrize("data", [b"hello, world", b"GIF89a....", b"BM" + bytes(60), b"\xff\xd9\xff\xff", b"\0" * 40])
def test_other_types(data: bytes) -> None:
    assert isinstance(expect("image_unsupported_type", data), UnsupportedImageError)


def test_too_many_bytes() -> None:
    assert isinstance(expect("image_too_many_bytes", PNG, ImageLimits(max_bytes=len(PNG) - 1)), TooLargeError)
    decode(PNG, ImageLimits(max_bytes=len(PNG)))


@pytest.mark.parametrize("data", [PNG, JPEG])
def test_too_many_pixels(data: bytes) -> None:
    assert isinstance(expect("image_too_many_pixels", data, ImageLimits(max_pixels=70 * 50 - 1)), TooLargeError)
    decode(data, ImageLimits(max_pixels=70 * 50))


def test_gigapixel_png_is_refused_on_its_header() -> None:
    bomb = png(40_000, 40_000, depth=1, rows=bytes(5_001) * 1_000)
    assert len(bomb) < 10_000
    assert "40000x40000" in expect("image_too_many_pixels", bomb).message


def test_gigapixel_jpeg_is_refused_on_its_header() -> None:
    position = JPEG.index(b"\xff\xc0") + 5
    bomb = JPEG[:position] + struct.pack(">HH", 65_000, 65_000) + JPEG[position + 4 :]
    expect("image_too_many_pixels", bomb)


@given(st.integers(1, len(PNG) - 1))
def test_png_truncated_anywhere(length: int) -> None:
    expect("image_truncated_or_corrupt", PNG[:length])


@given(st.integers(1, len(JPEG) - 1))
def test_jpeg_truncated_anywhere(length: int) -> None:
    expect("image_truncated_or_corrupt", JPEG[:length])


@given(st.integers(8, len(PNG) - 1), st.integers(1, 255))
def test_png_with_one_damaged_byte(position: int, flip: int) -> None:
    damaged = bytearray(PNG)
    damaged[position] ^= flip
    with pytest.raises(InvalidInputError) as caught:
        decode(bytes(damaged))
    assert caught.value.code in {"image_truncated_or_corrupt", "image_too_many_pixels"}


@given(st.binary(max_size=200), st.sampled_from([b"", PNG_SIGNATURE, b"\xff\xd8\xff", JPEG[:60], PNG[:40]]))
def test_noise_never_raises_anything_else(noise: bytes, start: bytes) -> None:
    with pytest.raises(InvalidInputError):
        decode(start + noise)


def test_truncated_files_make_no_noise(capfd: pytest.CaptureFixture[str]) -> None:
    for data in (PNG, JPEG):
        for length in range(1, len(data), 37):
            expect("image_truncated_or_corrupt", data[:length])
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(PNG_SIGNATURE + chunk(b"gAMA", bytes(13)) + PNG[33:], id="no IHDR"),
        pytest.param(PNG_SIGNATURE + chunk(b"IHDR", bytes(14)) + PNG[33:], id="IHDR too long"),
        pytest.param(png(0, 50), id="no width"),
        pytest.param(png(2**31, 50), id="width beyond the format"),
        pytest.param(png(50, 0), id="no height"),
        pytest.param(png(50, 2**31), id="height beyond the format"),
        pytest.param(png(50, 50, depth=3), id="bit depth"),
        pytest.param(png(50, 50, colour=5), id="colour type"),
        pytest.param(png(50, 50, rows=bytes(51)), id="one row of fifty"),
        pytest.param(PNG_SIGNATURE + PNG[8:33] + chunk(b"IEND", b""), id="no IDAT"),
        pytest.param(JPEG[:2] + b"\xff\xd9", id="JPEG ends at once"),
        pytest.param(JPEG[:2] + segment(0xC0, b"\x08\0\x32"), id="JPEG frame header too short"),
        pytest.param(JPEG[:2] + segment(0xC0, b"\x08\0\0\0\x32\x01\x01\x11\0"), id="JPEG without height"),
        pytest.param(JPEG[:2] + segment(0xC0, b"\x08\0\x32\0\0\x01\x01\x11\0"), id="JPEG without width"),
        pytest.param(JPEG[:2] + segment(0xDA, b"\x01\x01\0\0\x3f\0") + b"\xff\xd9", id="JPEG scan without frame"),
        pytest.param(JPEG[:2] + segment(0xE0, b"JFIF") + b"no marker", id="JPEG segments not contiguous"),
        pytest.param(JPEG[:2] + b"\xff\xe0\0\x01" + JPEG[2:], id="JPEG segment shorter than its length"),
        pytest.param(
            JPEG[:2] + segment(0xC3, b"\x08\0\x32\0\x32\x01\x01\x11\0") + b"\xff\xd9", id="lossless JPEG, not decodable"
        ),
    ],
)
def test_corrupt(data: bytes) -> None:
    expect("image_truncated_or_corrupt", data)


def test_opencv_refusals_become_our_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise cv2.error("CV_IO_MAX_IMAGE_PIXELS")

    monkeypatch.setattr(cv2, "imdecode", refuse)
    expect("image_truncated_or_corrupt", PNG)


def test_read_image_names_the_path(tmp_path: Path) -> None:
    path = tmp_path / "frame.png"
    write_png(path, GRAY)
    np.testing.assert_array_equal(read_image(path, limits=LIMITS, field="image"), GRAY)
    path.write_bytes(PNG[:100])
    with pytest.raises(InvalidInputError) as caught:
        read_image(path, limits=LIMITS, field="image")
    assert caught.value.code == "image_truncated_or_corrupt"
    assert caught.value.field == "image"
    assert str(path) in caught.value.message


@pytest.mark.parametrize("read", [read_image, read_image_size])
def test_read_refusals_name_the_path(read: object, tmp_path: Path) -> None:
    path = tmp_path / "frame.png"
    cases = [
        (b"text", "image_unsupported_type", UnsupportedImageError, LIMITS),
        (b"", "image_empty", InvalidInputError, LIMITS),
        (PNG[:20], "image_truncated_or_corrupt", InvalidInputError, LIMITS),
        (PNG, "image_too_many_bytes", TooLargeError, ImageLimits(max_bytes=10)),
        (PNG, "image_too_many_pixels", TooLargeError, ImageLimits(max_pixels=10)),
    ]
    for data, code, kind, limits in cases:
        path.write_bytes(data)
        with pytest.raises(kind) as caught:
            read(path, limits=limits, field="image")  # type: ignore[operator]
        assert caught.value.code == code
        assert caught.value.field == "image"
        assert str(path) in caught.value.message


@pytest.mark.parametrize("name", ["absent.png", "."])
def test_read_image_that_is_no_file(name: str, tmp_path: Path) -> None:
    with pytest.raises(DatasetError) as caught:
        read_image(tmp_path / name, limits=LIMITS, field="image")
    assert caught.value.code == "image_missing"
    assert str(tmp_path / name) in caught.value.message


@pytest.mark.parametrize("data", [PNG, JPEG])
def test_read_image_size_needs_only_the_header(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "frame"
    path.write_bytes(data[: len(data) // 2])
    assert read_image_size(path, limits=LIMITS, field="image") == (70, 50)
