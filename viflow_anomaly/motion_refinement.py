"""The camera's motion once more, at the source image's own resolution.

The correction measures on the network's view, which may be six times coarser than the image: a third of a pixel there
is two pixels here, and the whole ground seems to move. What still moves between source and reconstruction shows that
error. Six parameters are fitted to it robustly, and what they explain is taken off. As in the correction, so few cannot
explain away what moves by itself.

Along the epipolar line a wrong depth looks like a wrong motion: the more parallax a point has, the less that component
counts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viflow_anomaly.geometry import Float32Array, solve_few
from viflow_anomaly.sensor_data import Float64Array

ROUNDS = 4
LATTICE_POINTS = 800
"""Six parameters need no more blocks than about so many, evenly spread..."""
MIN_LATTICE_BLOCKS = 2
"""...and neighbours err alike: every second block says what all of them do."""
MIN_TOLERANCE_PX = 0.5
"""Errors of this size are half trusted at least; more where most of the picture is off by more."""
ROTATION_SIGMA_RAD, TRANSLATION_SIGMA = 0.004, 0.05
"""How far the corrected motion may still be off; the translation in the view's unit of length."""
_PRIOR = np.diag(np.repeat([1 / ROTATION_SIGMA_RAD**2, 1 / TRANSLATION_SIGMA**2], 3))
NOISE_PX = 1.0
CORRELATED_BLOCKS = 36.0
"""So many neighbours count as one."""
FREE_PARALLAX_PX = 1.0
"""From here on a wrong depth explains as much along the line as a wrong motion does."""


class MovedPoints(NamedTuple):
    """Where the points of each block are after the motion: all [h, w], x and y in focal lengths, and inverse depth."""

    x: Float32Array
    y: Float32Array
    nearness: Float32Array


class Line(NamedTuple):
    """Unit vectors [h, w] along which a static point may move, and by how many pixels it does where its inverse depth
    grows e times."""

    x: Float32Array
    y: Float32Array
    parallax_px: Float32Array


def common_motion_px(
    flow_px: Float32Array, trust: Float32Array, points: MovedPoints, line: Line, focal_px: tuple[float, float]
) -> Float32Array:
    """The part of a remaining flow that a small motion of the camera explains, [h, w, 2] float32 in source pixels.

    One linear problem of six parameters, reweighted (Cauchy) ``ROUNDS`` times, on a lattice of blocks.

    Args:
        flow_px: [h, w, 2] in source pixels.
        trust: [h, w] in 0..1.
        points: of the blocks.
        line: epipolar lines of the blocks, in source pixels.
        focal_px: of the source image, x and y.
    """
    pitch = max(MIN_LATTICE_BLOCKS, round((trust.size / LATTICE_POINTS) ** 0.5))
    thin = (slice(pitch // 2, None, pitch),) * 2
    x, y, nearness = (one[thin].reshape(-1) for one in points)
    along_x, along_y = _basis_px(MovedPoints(x, y, nearness), focal_px)  # 6, N each
    u, v = (flow_px[..., axis][thin].reshape(-1) for axis in (0, 1))
    lx, ly, parallax = (one[thin].reshape(-1) for one in line)
    # First all that lies across the lines, then all along them.
    rows = np.concatenate([along_y * lx - along_x * ly, along_x * lx + along_y * ly], axis=1)  # 6, 2 N
    goal = np.concatenate([v * lx - u * ly, u * lx + v * ly])
    share = 1 / (1 + (parallax / np.float32(FREE_PARALLAX_PX)) ** 2)
    trusted = trust[thin].reshape(-1) * np.float32(pitch**2 / (NOISE_PX**2 * CORRELATED_BLOCKS))
    trusted = np.stack([trusted, trusted * share])
    solution, middle = np.zeros(6), share.size // 2
    for _ in range(ROUNDS):
        across, along = (goal - solution.astype(np.float32) @ rows).reshape(2, -1)
        size = np.sqrt(across * across + along * along * share)
        tolerance = max(MIN_TOLERANCE_PX, float(np.partition(size, middle)[middle]))
        robust = 1 / (1 + (size / np.float32(tolerance)) ** 2)
        weighted = rows * (trusted * robust).reshape(-1)
        solution = solve_few(_PRIOR + weighted @ rows.T, (weighted @ goal).astype(np.float64))
    return _moved_px(points, solution, focal_px)


def _basis_px(points: MovedPoints, focal_px: tuple[float, float]) -> tuple[Float32Array, Float32Array]:
    """[6, N] each: how flow in pixels along x and along y follows a further rotation and translation of the camera."""
    x, y, nearness = points
    fx, fy = (np.float32(focal) for focal in focal_px)
    along_x, along_y = np.zeros((2, 6, len(x)), dtype=np.float32)
    along_x[0], along_x[1], along_x[2], along_x[3], along_x[5] = -x * y, 1 + x * x, -y, nearness, -x * nearness
    along_y[0], along_y[1], along_y[2], along_y[4], along_y[5] = -1 - y * y, x * y, x, nearness, -y * nearness
    along_x *= fx
    along_y *= fy
    return along_x, along_y


def _moved_px(points: MovedPoints, solution: Float64Array, focal_px: tuple[float, float]) -> Float32Array:
    """[h, w, 2] the flow of points under a small rotation and translation [6]: their basis times these."""
    x, y, nearness = points
    rx, ry, rz, tx, ty, tz = solution.astype(np.float32)
    common = x * ry - y * rx - nearness * tz
    flow = np.empty((*x.shape, 2), dtype=np.float32)
    np.multiply(x * common - y * rz + nearness * tx + ry, np.float32(focal_px[0]), out=flow[..., 0])
    np.multiply(y * common + x * rz + nearness * ty - rx, np.float32(focal_px[1]), out=flow[..., 1])
    return flow
