"""Classical detectors of independent motion, on the same regions as ours: what else a user could run.

Each gives an evidence map in gray levels, or in pixels of unexplained flow times ``GRAY_PER_PX`` so that the same
thresholds apply, and where it could be computed. Only ``gyro_difference`` uses the IMU and the calibration; without
them it has no answer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.geometry import Float32Array, integrate_gyro, pixel_grid, project_rays, unproject_pixels
from viflow_anomaly.residual import photometric_residual, reconstruct
from viflow_anomaly.sensor_data import FramePair, ImuSamples, Uint8Array

BoolArray = NDArray[np.bool_]

GRAY_PER_PX = 8.0
MAX_CORNERS = 400
RANSAC_PX = 2.0
MIN_MATCHES = 8
MIN_COSINE = 1e-3
"""A ray that turns further than this beyond the side is behind the camera."""


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


def gyro_difference(pair: FramePair) -> Evidence | None:
    """Difference after the gyro's rotation, K R K^-1 without distortion: what a stabiliser takes out.

    None without a calibration that says how the IMU is mounted.
    """
    camera = pair.camera
    if camera is None or camera.R_cam_imu is None:
        return None
    start_ns, end_ns = (
        stamp + round(camera.time_offset_s * 1e9) for stamp in (pair.source.timestamp_ns, pair.target.timestamp_ns)
    )
    R_source_target = integrate_gyro(*_between(pair.imu, start_ns, end_ns))
    R_target_source = camera.R_cam_imu @ R_source_target.T @ camera.R_cam_imu.T
    height, width = pair.source.image.shape
    rays = unproject_pixels(camera, pixel_grid(height, width))
    turned = np.concatenate([rays, np.ones((height, width, 1))], axis=-1) @ R_target_source.T  # H, W, 3
    ahead = turned[..., 2:] > MIN_COSINE
    at_px = project_rays(camera, turned[..., :2] / np.where(ahead, turned[..., 2:], 1.0))
    coordinates = np.where(ahead, at_px, np.nan).astype(np.float32)
    reconstruction, inside = reconstruct(pair.target.image, coordinates)
    return Evidence(photometric_residual(pair.source.image, reconstruction, inside), inside)


def _between(imu: ImuSamples, start_ns: int, end_ns: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Stamps [N] and rates [N, 3] of an interval, interpolated at its ends."""
    inner = (imu.timestamps_ns > start_ns) & (imu.timestamps_ns < end_ns)
    stamps = np.concatenate([[start_ns], imu.timestamps_ns[inner], [end_ns]]).astype(np.int64)
    since = imu.timestamps_ns - start_ns  # small numbers: float64 holds them exactly
    rates = [np.interp(stamps - start_ns, since, imu.gyro_rad_s[:, axis]) for axis in range(3)]
    return stamps, np.stack(rates, axis=-1)


RIVALS: dict[str, Callable[[FramePair], Evidence | None]] = {
    "frame difference": frame_difference,
    "gyro difference": gyro_difference,
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
