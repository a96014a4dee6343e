"""Grayscale textures: fractal noise, masonry, stripes, facades, and the pictures scikit-image ships in its wheel.

Every function returns [size, size] uint8 and draws only from the generator it is given.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import skimage

from viflow_anomaly.sensor_data import Float64Array, Uint8Array

# Those inside the wheel; a file that another scikit-image release lacks is left out.
PHOTOGRAPHS = (
    "astronaut.png",
    "brick.png",
    "camera.png",
    "chelsea.png",
    "coffee.png",
    "coins.png",
    "grass.png",
    "gravel.png",
    "hubble_deep_field.jpg",
    "ihc.png",
    "moon.png",
    "motorcycle_left.png",
    "rocket.jpg",
    "text.png",
)


@lru_cache(maxsize=1)
def photographs() -> tuple[Uint8Array, ...]:
    """The pictures that are there, gray, at most 640 px wide."""
    folder = Path(skimage.__file__).parent / "data"
    loaded = []
    for name in PHOTOGRAPHS:
        picture = cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)
        if picture is None:
            continue
        shrink = min(1.0, 640 / picture.shape[1])
        size = (round(picture.shape[1] * shrink), round(picture.shape[0] * shrink))
        loaded.append(np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8))
    return tuple(loaded)


def _noise(rng: np.random.Generator, size: int, *, coarsest: int = 4, persistence: float = 0.75) -> Float64Array:
    """Tileable fractal noise, zero mean and unit deviation; octaves from ``coarsest`` cells to size / 2."""
    total = np.zeros((size, size), np.float32)
    cells, weight = coarsest, 1.0
    while cells <= size // 2:
        grid = np.pad(rng.random((cells, cells), dtype=np.float32), 2, mode="wrap")
        zoom = size // cells
        wide = cv2.resize(grid, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
        total += weight * wide[2 * zoom : 2 * zoom + size, 2 * zoom : 2 * zoom + size]
        cells, weight = cells * 2, weight * persistence
    return np.asarray((total - total.mean()) / max(float(total.std()), 1e-6), dtype=np.float64)


def _finish(rng: np.random.Generator, image: Float64Array, *, contrast: tuple[float, float] = (28, 58)) -> Uint8Array:
    deviation = max(float(image.std()), 1e-6)
    level = rng.uniform(90, 170)
    return np.asarray(
        np.clip((image - image.mean()) / deviation * rng.uniform(*contrast) + level, 8, 250), dtype=np.uint8
    )


def fractal(rng: np.random.Generator, size: int) -> Uint8Array:
    return _finish(rng, _noise(rng, size, coarsest=int(rng.choice((4, 8, 16))), persistence=rng.uniform(0.65, 0.97)))


def smooth(rng: np.random.Generator, size: int) -> Uint8Array:
    """A painted wall: little texture."""
    return _finish(rng, _noise(rng, size, coarsest=4, persistence=0.6), contrast=(3, 9))


def masonry(rng: np.random.Generator, size: int) -> Uint8Array:
    """Bricks, blocks or tiles with mortar, each stone with its own shade."""
    rows = int(rng.choice((4, 8, 16)))
    columns = max(2, rows // int(rng.choice((1, 2))))
    v, u = np.mgrid[0:size, 0:size] / size
    row = np.floor(v * rows).astype(int)
    offset = (row % 2) * 0.5 * float(rng.random() < 0.7)
    column_position = u * columns + offset
    column = np.floor(column_position).astype(int) % columns
    shade = rng.normal(0, 1, (rows, columns))[row, column]
    joint = rng.uniform(0.04, 0.12)
    mortar = ((v * rows) % 1 < joint) | (column_position % 1 < joint * columns / rows)
    stones = np.where(mortar, rng.choice((-2.5, 2.5)), shade)
    return _finish(rng, stones + 0.7 * _noise(rng, size, coarsest=16, persistence=0.9))


def stripes(rng: np.random.Generator, size: int) -> Uint8Array:
    """Stripes or checks of random widths under noise."""
    count = int(rng.integers(6, 24))
    bands = rng.normal(0, 1, count)[(np.arange(size) * count) // size]
    across = rng.normal(0, 1, count)[(np.arange(size) * count) // size] * float(rng.random() < 0.6)
    picture = bands[None, :] + across[:, None] + 0.5 * _noise(rng, size, coarsest=8, persistence=0.9)
    return _finish(rng, picture if rng.random() < 0.5 else picture.T)


def pebbles(rng: np.random.Generator, size: int) -> Uint8Array:
    """Tileable cells around random points."""
    count, coarse = int(rng.integers(20, 70)), size // 2
    points = rng.random((count, 2)) * coarse
    v, u = np.mgrid[0:coarse, 0:coarse].astype(np.float32)
    nearest = np.full((coarse, coarse), np.inf, np.float32)
    owner = np.zeros((coarse, coarse), int)
    for index, (x, y) in enumerate(points):
        du, dv = np.abs(u - x), np.abs(v - y)
        distance = np.minimum(du, coarse - du) ** 2 + np.minimum(dv, coarse - dv) ** 2
        owner = np.where(distance < nearest, index, owner)
        nearest = np.minimum(nearest, distance)
    cells = rng.normal(0, 1, count)[owner] - 1.2 * np.sqrt(nearest) / np.sqrt(nearest).mean()
    enlarged = cv2.resize(cells, (size, size), interpolation=cv2.INTER_LINEAR)
    return _finish(rng, enlarged + 0.4 * _noise(rng, size, coarsest=16, persistence=0.9))


def facade(rng: np.random.Generator, size: int) -> Uint8Array:
    """A house front: windows in rows and columns on a wall."""
    rows, columns = int(rng.integers(2, 7)), int(rng.integers(2, 8))
    v, u = np.mgrid[0:size, 0:size] / size
    in_row, in_column = (v * rows) % 1, (u * columns) % 1
    top, side = rng.uniform(0.15, 0.35), rng.uniform(0.15, 0.35)
    window = (in_row > top) & (in_row < 0.85) & (in_column > side) & (in_column < 1 - side)
    frame = window & ((in_row < top + 0.06) | (np.abs(in_column - 0.5) < 0.03) | (in_column < side + 0.04))
    panes = rng.normal(-1.5, 0.6, (rows, columns))
    wall = 0.45 * _noise(rng, size, coarsest=8, persistence=0.95)
    glass = panes[(v * rows).astype(int), (u * columns).astype(int)] + 0.3 * _noise(rng, size)
    picture = np.where(frame, 1.6, np.where(window, glass, wall + rng.uniform(-0.3, 1.0)))
    return _finish(rng, picture)


def photograph(rng: np.random.Generator, size: int) -> Uint8Array:
    """A random crop, flip and turn of one of the photographs under a little noise."""
    available = photographs()
    if not available:
        return fractal(rng, size)
    picture = available[int(rng.integers(len(available)))]
    side = int(min(picture.shape) * rng.uniform(0.45, 1.0))
    top = int(rng.integers(0, picture.shape[0] - side + 1))
    left = int(rng.integers(0, picture.shape[1] - side + 1))
    crop = np.rot90(picture[top : top + side, left : left + side], int(rng.integers(4)))
    crop = crop[:, ::-1] if rng.random() < 0.5 else crop
    resized = cv2.resize(np.ascontiguousarray(crop), (size, size), interpolation=cv2.INTER_AREA).astype(np.float64)
    deviation = max(float(resized.std()), 1e-6)
    return _finish(rng, resized / deviation + 0.15 * _noise(rng, size, coarsest=16, persistence=0.95))


def asphalt(rng: np.random.Generator, size: int) -> Uint8Array:
    """Fine grain, stains and cracks; lane markings are geometry of their own."""
    grain = rng.standard_normal((size, size))
    picture = 0.8 * grain + rng.uniform(0.5, 1.2) * _noise(rng, size, coarsest=4, persistence=0.8)
    for _ in range(int(rng.integers(2, 8))):
        steps = rng.normal(0, size / 24, (14, 2)) + rng.normal(0, size / 20, 2)
        path = (rng.random(2) * size + np.cumsum(steps, axis=0)).astype(np.int32)
        cv2.polylines(picture, [path.reshape(-1, 1, 2)], False, float(rng.uniform(-4, -2)), int(rng.integers(1, 4)))
    return _finish(rng, picture, contrast=(14, 32))


def leaves(rng: np.random.Generator, size: int) -> Uint8Array:
    """Patches of strongly different shade with a little grain: each leaf takes a small piece."""
    shades = cv2.resize(rng.normal(0, 1, (8, 8)), (size, size), interpolation=cv2.INTER_NEAREST)
    return _finish(rng, np.asarray(shades + 0.35 * _noise(rng, size, coarsest=16, persistence=0.9)), contrast=(30, 70))


_KINDS = (
    (fractal, 0.26),
    (photograph, 0.30),
    (masonry, 0.14),
    (pebbles, 0.10),
    (stripes, 0.10),
    (smooth, 0.10),
)


def any_texture(rng: np.random.Generator, size: int) -> Uint8Array:
    """One of the kinds for objects and indoor surfaces; a tenth have little texture."""
    kinds, weights = zip(*_KINDS, strict=True)
    return np.asarray(kinds[int(rng.choice(len(kinds), p=weights))](rng, size), dtype=np.uint8)


def ground_texture(rng: np.random.Generator, size: int) -> Uint8Array:
    """Something that tiles well and lies on the ground."""
    return np.asarray((fractal, pebbles, masonry)[int(rng.choice(3, p=(0.5, 0.3, 0.2)))](rng, size), dtype=np.uint8)


def sky_texture(rng: np.random.Generator, size: int) -> Uint8Array:
    """Clouds: coarse noise on a bright or a gray sky."""
    clouds = _noise(rng, size, coarsest=4, persistence=0.5)
    return np.asarray(np.clip(rng.uniform(150, 225) + rng.uniform(4, 22) * clouds, 60, 250), dtype=np.uint8)
