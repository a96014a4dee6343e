"""Classical detectors of independent motion, on the same regions as ours: what else a user could run.

Each gives an evidence map in gray levels, or in pixels of unexplained flow times ``GRAY_PER_PX`` so that the same
thresholds apply, and where it could be computed. None uses the IMU or a calibration.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.geometry import Float32Array, pixel_grid
from viflow_anomaly.sensor_data import FramePair, Uint8Array

BoolArray = NDArray[np.bool_]

GRAY_PER_PX = 8.0
MAX_CORNERS = 400
RANSAC_PX = 2.0
MIN_MATCHES = 8


class Evidence(NamedTuple):
    """evidence [H, W] float32 >= 0, inside [H, W]: where the target image reaches."""

    evidence: Float32Array
    inside: BoolArray


def frame_difference(pair: FramePair) -> Evidence:
    """|target - source|: all that a still camera needs."""
    difference = cv2.absdiff(pair.source.image, pair.target.image).astype(np.float32)
    return Evidence(difference, np.ones(difference.shape, dtype=np.bool_))


def homography_difference(pair: FramePair) -> Evidence:
    """Difference after the best homography (corners, pyramidal Lucas-Kanade, RANSAC): "compensated motion"."""
    source, target = pair.source.image, pair.target.image
    matrix = _homography(source, target)
    height, width = source.shape
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(target, matrix, (width, height), flags=flags)
    covered = cv2.warpPerspective(np.full_like(target, 255), matrix, (width, height), flags=flags)
    inside = covered == 255
    difference = cv2.absdiff(warped, source).astype(np.float32)
    return Evidence(np.where(inside, difference, np.float32(0)), inside)


def flow_minus_homography(pair: FramePair) -> Evidence:
    """Length of DIS flow (medium) minus that of the best homography."""
    flow = _dis(pair)
    height, width = flow.shape[:2]
    grid = pixel_grid(height, width)
    moved = cv2.perspectiveTransform(grid.reshape(1, -1, 2), _homography(pair.source.image, pair.target.image))
    left = flow - (moved.reshape(height, width, 2) - grid)
    return Evidence(np.linalg.norm(left, axis=-1).astype(np.float32) * np.float32(GRAY_PER_PX), _inside(grid + flow))


def flow_off_epipolar_lines(pair: FramePair) -> Evidence:
    """Sampson distance of DIS flow (medium) to the fundamental matrix of its own RANSAC fit."""
    flow = _dis(pair)
    height, width = flow.shape[:2]
    grid = pixel_grid(height, width)
    first, second = grid[4::8, 4::8].reshape(-1, 2), (grid + flow)[4::8, 4::8].reshape(-1, 2)
    matrix, _ = cv2.findFundamentalMat(first, second, cv2.FM_RANSAC, 1.0, 0.99, maxIters=500)
    inside = _inside(grid + flow)
    if matrix is None or matrix.shape != (3, 3):
        return Evidence(np.zeros((height, width), dtype=np.float32), inside)
    ones = np.ones((height, width, 1), dtype=np.float32)
    x, y = np.concatenate([grid, ones], axis=-1), np.concatenate([grid + flow, ones], axis=-1)
    line_y, line_x = x @ matrix.T, y @ matrix
    error = np.abs((y * line_y).sum(axis=-1))
    scale = np.sqrt((line_y[..., :2] ** 2).sum(axis=-1) + (line_x[..., :2] ** 2).sum(axis=-1))
    distance_px = error / np.maximum(scale, 1e-9)
    return Evidence((distance_px * GRAY_PER_PX).astype(np.float32), inside)


RIVALS: dict[str, Callable[[FramePair], Evidence]] = {
    "frame difference": frame_difference,
    "homography difference": homography_difference,
    "DIS minus homography": flow_minus_homography,
    "DIS off epipolar lines": flow_off_epipolar_lines,
}


def _homography(source: Uint8Array, target: Uint8Array) -> NDArray[np.float64]:
    """Source to target; the identity where too little can be matched."""
    cv2.setRNGSeed(0)
    corners = cv2.goodFeaturesToTrack(source, MAX_CORNERS, 0.01, 7)
    if corners is None or len(corners) < MIN_MATCHES:
        return np.eye(3)
    tracked, status, _ = cv2.calcOpticalFlowPyrLK(source, target, corners, None)  # type: ignore[call-overload]
    found = status.ravel() == 1
    if np.count_nonzero(found) < MIN_MATCHES:
        return np.eye(3)
    matrix, _ = cv2.findHomography(corners[found], tracked[found], cv2.RANSAC, RANSAC_PX)
    return np.eye(3) if matrix is None else np.asarray(matrix, dtype=np.float64)


def _dis(pair: FramePair) -> Float32Array:
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)  # type: ignore[attr-defined]
    return np.asarray(search.calc(pair.source.image, pair.target.image, None), dtype=np.float32)


def _inside(at_px: Float32Array) -> BoolArray:
    height, width = at_px.shape[:2]
    return np.asarray(((at_px >= 0) & (at_px <= (width - 1, height - 1))).all(axis=-1))
