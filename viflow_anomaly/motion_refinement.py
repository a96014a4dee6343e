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

from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.sensor_data import Float64Array

ROUNDS = 4
LATTICE_BLOCKS = 2
MIN_TOLERANCE_PX = 0.5
"""Errors of this size are half trusted at least; more where most of the picture is off by more."""
ROTATION_SIGMA_RAD, TRANSLATION_SIGMA = 0.004, 0.05
"""How far the corrected motion may still be off; the translation in the view's unit of length."""
NOISE_PX = 1.0
CORRELATED_BLOCKS = 9.0
"""Neighbours err alike: so many count as one."""
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

    One linear problem of six parameters, reweighted (Cauchy) ``ROUNDS`` times, on every ``LATTICE_BLOCKS``-th block.

    Args:
        flow_px: [h, w, 2] in source pixels.
        trust: [h, w] in 0..1.
        points: of the blocks.
        line: epipolar lines of the blocks, in source pixels.
        focal_px: of the source image, x and y.
    """
    basis = _basis_px(points, focal_px)  # 2, 6, h, w
    thin = (slice(LATTICE_BLOCKS // 2, None, LATTICE_BLOCKS),) * 2
    jacobian = basis[:, :, *thin].reshape(2, 6, -1)
    u, v = (flow_px[..., axis][thin].reshape(-1) for axis in (0, 1))
    lx, ly, parallax = (one[thin].reshape(-1) for one in line)
    rows_across = jacobian[1] * lx - jacobian[0] * ly
    rows_along = jacobian[0] * lx + jacobian[1] * ly
    across, along = v * lx - u * ly, u * lx + v * ly
    trusted = trust[thin].reshape(-1)
    share = 1 / (1 + (parallax / np.float32(FREE_PARALLAX_PX)) ** 2)
    free = trusted * share
    prior = np.repeat([1 / ROTATION_SIGMA_RAD**2, 1 / TRANSLATION_SIGMA**2], 3)
    solution = np.zeros(6)
    for _ in range(ROUNDS):
        moved = solution.astype(np.float32)
        error_across, error_along = across - moved @ rows_across, along - moved @ rows_along
        size = np.sqrt(error_across**2 + error_along**2 * share)
        tolerance = max(MIN_TOLERANCE_PX, float(np.median(size)))
        robust = 1 / (1 + (size / np.float32(tolerance)) ** 2)
        solution = _solved(rows_across, across, trusted * robust, rows_along, along, free * robust, prior)
    return np.tensordot(solution.astype(np.float32), basis, (0, 1)).transpose(1, 2, 0)


def _solved(
    rows_across: Float32Array,
    across: Float32Array,
    weights_across: Float32Array,
    rows_along: Float32Array,
    along: Float32Array,
    weights_along: Float32Array,
    prior: Float64Array,
) -> Float64Array:
    """[6] rotation (rad) and translation: rows [6, N] and goals [N] in pixels, prior [6] inverse variances."""
    normal = np.diag(prior)
    gradient = np.zeros(6)
    for rows, goal, weights in ((rows_across, across, weights_across), (rows_along, along, weights_along)):
        weighted = rows * (weights * np.float32(1 / (NOISE_PX**2 * CORRELATED_BLOCKS)))
        normal = normal + (weighted @ rows.T).astype(np.float64)
        gradient = gradient + (weighted @ goal).astype(np.float64)
    return np.asarray(np.linalg.solve(normal, gradient))


def _basis_px(points: MovedPoints, focal_px: tuple[float, float]) -> Float32Array:
    """[2, 6, h, w] how flow in pixels follows a further rotation and translation of the camera."""
    x, y, nearness = points
    fx, fy = (np.float32(focal) for focal in focal_px)
    zero = np.zeros_like(x)
    along_x = (-x * y, 1 + x * x, -y, nearness, zero, -x * nearness)
    along_y = (-1 - y * y, x * y, x, zero, nearness, -y * nearness)
    return np.stack([np.stack(along_x) * fx, np.stack(along_y) * fy]).astype(np.float32)
