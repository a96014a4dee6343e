"""Depth, refined by the parallax that the two images show, once the camera's motion is corrected.

The network reads one inverse depth a cell from a single image; how wrong it is there shows in the part of the measured
flow that lies along the cell's own epipolar line, where a static point may move. What the measurement says beside that
line is nobody's depth: it stays an anomaly. Depth is smooth and the measurement noisy, so neighbours vote together.

The price: of a mover that moves along the epipolar line (a car ahead on one's own road) a part is taken for nearness, a
quarter to a half of a few pixels. On held-out sequences the gain is larger: fewer alarms from parallax.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.measured_flow import MeasuredFlow

NEIGHBOURHOOD_CELLS = 1.5
"""Deviation of the Gaussian over which cells vote."""
PRIOR_SHARE = 0.1
"""How much of a pixel's measurement the network's own depth is worth, at a log of 1."""
MAX_LOG_RATIO = 1.0
"""A depth may be corrected by a factor of e at most: beyond it the measurement is more likely something that moves."""


class Parallax(NamedTuple):
    """How the flow of each cell follows its depth: all arrays are on the cells, x first, in focal lengths.

    Attributes:
        error: [2, h, w] measured minus predicted flow.
        slope: [2, h, w] derivative of the predicted flow by the logarithm of the inverse depth.
    """

    error: Float32Array
    slope: Float32Array


def log_depth_step(
    parallax: Parallax, measured: MeasuredFlow, log_ratio: Float32Array, tolerance: float
) -> Float32Array:
    """One Gauss-Newton step of the logarithm of the inverse depth, [h, w]; damped towards no change.

    Args:
        parallax: at the present depth.
        measured: its confidence weighs the cells, beside a Cauchy weight of the error (half at ``tolerance``).
        log_ratio: [h, w] the change so far.
        tolerance: in focal lengths.

    Returns:
        The new change so far.
    """
    error, slope = parallax
    weights = measured.confidence / (1 + _dot(error, error) * np.float32(1 / tolerance**2))
    along = _voted(weights * _dot(slope, error))
    certainty = _voted(weights * _dot(slope, slope))
    prior = np.float32(PRIOR_SHARE * tolerance * tolerance)
    step = (along - prior * log_ratio) / (certainty + prior)
    return np.asarray(np.clip(log_ratio + step, -MAX_LOG_RATIO, MAX_LOG_RATIO), dtype=np.float32)


def _dot(one: Float32Array, other: Float32Array) -> Float32Array:
    """[h, w] of [2, h, w]; numpy's sum over so short an axis takes longer."""
    return np.asarray(one[0] * other[0] + one[1] * other[1], dtype=np.float32)


def _voted(values: Float32Array) -> Float32Array:
    return np.asarray(cv2.GaussianBlur(values, (0, 0), NEIGHBOURHOOD_CELLS), dtype=np.float32)
