"""Image files that are wrong in one of many ways, from a seeded generator: what ``fuzz_inputs.py`` sends as images."""

from __future__ import annotations

import random
import struct
import zlib
from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np

WIDTH, HEIGHT = 96, 64
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
SIZES = (0, 1, 2, 15, 16, 31, 64, 96, 255, 4096, 65535, 65536, 2**20, 2**31 - 1, 2**31, 2**32 - 1)
OTHERS = (
    b"",
    b"\x89",
    PNG_SIGNATURE,
    b"\xff\xd8",
    b"\xff\xd8\xff",
    b"GIF89a\x01\x00\x01\x00",
    b"BM",
    b"RIFF....WEBPVP8 ",
)


def texture(rng: random.Random) -> np.ndarray:
    """[H, W] uint8, one of a few."""
    return _texture(rng.randrange(64))


@lru_cache
def _texture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.0))


def encoded(image: np.ndarray, kind: str) -> bytes:
    return bytes(cv2.imencode(kind, image)[1])


def good_image(rng: random.Random) -> bytes:
    """One that can be read."""
    return encoded(texture(rng), rng.choice((".png", ".jpg")))


def mutated(rng: random.Random, data: bytes) -> bytes:
    """Cut, doubled, overwritten or flipped in a few places; the beginning is hit as often as the rest."""
    for _ in range(rng.randint(1, 4)):
        reach = rng.choice((16, 64, len(data)))
        start = rng.randrange(min(reach, len(data)) + 1)
        end = min(len(data), start + rng.choice((1, 1, 2, 8, 200)))
        kept = data[start:end]
        flipped = bytes(byte ^ (1 << rng.randrange(8)) for byte in kept)
        middle = rng.choice(
            (b"", kept * 2, rng.randbytes(end - start), flipped, b"\0\0\0\0", b"\xff\xff\xff\xff", b"\r\n")
        )
        data = data[:start] + middle + data[end:]
    return data


def png_chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def png_file(header: tuple[int, int, int, int, int, int, int], *chunks: bytes) -> bytes:
    """From IHDR's seven numbers and what follows, all checksums right."""
    return (
        PNG_SIGNATURE
        + png_chunk(b"IHDR", struct.pack(">IIBBBBB", *header))
        + b"".join(chunks)
        + png_chunk(b"IEND", b"")
    )


def png_header_lies(rng: random.Random) -> bytes:
    """Any size, depth, colour and interlace over pixels that are there or not."""
    numbers = [WIDTH, HEIGHT, 8, 0, 0, 0, 0]
    for _ in range(rng.randint(1, 3)):
        place = rng.randrange(7)
        numbers[place] = rng.choice(SIZES) if place < 2 else rng.choice((0, 1, 2, 3, 4, 6, 7, 8, 16, 32, 255))
    pixels = zlib.compress(rng.randbytes(rng.choice((0, 1, WIDTH, (WIDTH + 1) * HEIGHT))))
    width, height, depth, colour, compression, filtering, interlace = numbers
    return png_file((width, height, depth, colour, compression, filtering, interlace), png_chunk(b"IDAT", pixels))


def png_bomb(rng: random.Random) -> bytes:
    """Little to send, much to unpack: in the pixels, in a text, in a colour profile."""
    zeros = zlib.compress(bytes(rng.choice((2**16, 2**20, 2**23))), 9)
    pixels = png_chunk(b"IDAT", zlib.compress(bytes((WIDTH + 1) * HEIGHT)))
    side = rng.choice((900, 1000, 1001, 16000, 65535))
    header = (WIDTH, HEIGHT, 8, 0, 0, 0, 0)
    return rng.choice(
        (
            png_file((side, side, 8, 0, 0, 0, 0), png_chunk(b"IDAT", zeros)),
            png_file((side, side, 16, 6, 0, 0, 1), png_chunk(b"IDAT", zeros)),
            png_file(header, png_chunk(b"zTXt", b"a\0\0" + zeros), pixels),
            png_file(header, png_chunk(b"iCCP", b"a\0\0" + zeros), pixels),
            png_file(header, *[png_chunk(b"tEXt", b"a\0b")] * rng.choice((10, 3000)), pixels),
            png_file(header, png_chunk(b"IDAT", zeros)),
        )
    )


def png_chunks_in_disorder(rng: random.Random) -> bytes:
    """Animated, paletted without a palette, chunks twice, before and after their time."""
    image = encoded(texture(rng), ".png")
    extras = [
        png_chunk(b"PLTE", rng.randbytes(rng.choice((0, 3, 4, 768, 771)))),
        png_chunk(b"tRNS", rng.randbytes(rng.choice((0, 1, 2, 300)))),
        png_chunk(b"acTL", struct.pack(">II", rng.choice((0, 1, 2, 2**31)), 0)),
        png_chunk(b"fcTL", rng.randbytes(26)),
        png_chunk(b"fdAT", rng.randbytes(50)),
        png_chunk(b"gAMA", rng.randbytes(4)),
        png_chunk(b"eXIf", rng.randbytes(40)),
        png_chunk(b"IHDR", rng.randbytes(13)),
        png_chunk(b"IDAT", rng.randbytes(30)),
        png_chunk(bytes(rng.choices(range(65, 123), k=4)), rng.randbytes(10)),
    ]
    for _ in range(rng.randint(1, 3)):
        place = rng.choice((33, len(image) - 12, len(image)))
        image = image[:place] + rng.choice(extras) + image[place:]
    return image


def jpeg_frame_lies(rng: random.Random) -> bytes:
    """Another size, precision, kind or number of components in the frame header."""
    image = bytearray(encoded(texture(rng), ".jpg"))
    place = image.index(b"\xff\xc0")
    change = rng.randrange(5)
    if change == 0:
        image[place + 5 : place + 9] = struct.pack(">HH", rng.choice(SIZES) & 0xFFFF, rng.choice(SIZES) & 0xFFFF)
    elif change == 1:
        image[place + 1] = rng.choice((0xC1, 0xC2, 0xC3, 0xC5, 0xC9, 0xCA, 0xCF, 0xDA))
    elif change == 2:
        image[place + 4] = rng.choice((0, 1, 12, 16, 255))
    elif change == 3:
        image[place + 9] = rng.choice((0, 2, 3, 4, 255))
    else:
        image[place + 2 : place + 4] = struct.pack(">H", rng.choice((0, 1, 2, 8, 65535)))
    return bytes(image)


def jpeg_segments_in_disorder(rng: random.Random) -> bytes:
    """Exif that turns or lies, comments without end, restart markers, two frames, progressive scans."""
    progressive = bytes(cv2.imencode(".jpg", texture(rng), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1])
    image = rng.choice((encoded(texture(rng), ".jpg"), progressive))
    length = rng.choice((0, 1, 2, 50, 65533))
    extras = (
        b"\xff\xe1" + struct.pack(">H", min(length + 2, 65535)) + b"Exif\0\0MM\0*" + rng.randbytes(length),
        b"\xff\xfe" + struct.pack(">H", length + 2) + rng.randbytes(length),
        b"\xff\xdd\0\4" + rng.randbytes(2),
        b"\xff\xd0" * rng.choice((1, 1000)),
        b"\xff\xff\xff\xff",
        image[2 : rng.randrange(2, len(image))],
    )
    for _ in range(rng.randint(1, 3)):
        place = rng.choice((2, rng.randrange(len(image)), len(image) - 2))
        image = image[:place] + rng.choice(extras) + image[place:]
    return image


def odd_kind(rng: random.Random) -> bytes:
    """Other formats, other depths, other shapes, and what is no image."""
    gray = texture(rng)
    return rng.choice(
        (
            rng.choice(OTHERS),
            rng.choice(OTHERS) + rng.randbytes(200),
            encoded(gray, ".bmp"),
            encoded(gray, ".tiff"),
            encoded(gray, ".webp"),
            encoded(gray.astype(np.uint16) * 257, ".png"),
            encoded(np.dstack([gray] * 4), ".png"),
            encoded(gray[: rng.choice((1, 2, 16))], ".png"),
            encoded(gray[:, : rng.choice((1, 3))], ".jpg"),
            b"%PDF-1.7\n" + rng.randbytes(100),
            b"<svg xmlns='http://www.w3.org/2000/svg'/>",
        )
    )


def damaged(rng: random.Random) -> bytes:
    return mutated(rng, good_image(rng))


def truncated(rng: random.Random) -> bytes:
    image = good_image(rng)
    return image[: rng.randrange(len(image))]


IMAGES: dict[str, Callable[[random.Random], bytes]] = {
    "damaged": damaged,
    "truncated": truncated,
    "png header lies": png_header_lies,
    "png bomb": png_bomb,
    "png chunks in disorder": png_chunks_in_disorder,
    "jpeg frame lies": jpeg_frame_lies,
    "jpeg segments in disorder": jpeg_segments_in_disorder,
    "odd kind": odd_kind,
}
"""Name of what is wrong -> a file that is wrong like that."""
