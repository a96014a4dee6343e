"""SO(3), pinhole projection, sampling and rigid motion fields in numpy. Pixel centres lie at integer coordinates.

Frames: camera x right, y down, z forward. ``T_a_b`` maps coordinates in b to a.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.array_cache import MEBIBYTE, ArrayCache
from viflow_anomaly.sensor_data import Float64Array, PinholeCamera

Float32Array = NDArray[np.float32]


def skew(vector: Float64Array) -> Float64Array:
    """[3] -> [3, 3] with skew(a) @ b = a x b."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def so3_exp(rotation_vector: Float64Array) -> Float64Array:
    """Rodrigues: rotation vector [3] (rad) -> rotation matrix [3, 3]."""
    return np.asarray(cv2.Rodrigues(np.asarray(rotation_vector, dtype=np.float64).reshape(3, 1))[0])


def so3_log(rotation: Float64Array) -> Float64Array:
    """Rotation matrix [3, 3] -> rotation vector [3] (rad), angle in [0, pi]."""
    return np.asarray(cv2.Rodrigues(np.asarray(rotation, dtype=np.float64))[0], dtype=np.float64).reshape(3)


def integrate_gyro(timestamps_ns: NDArray[np.int64], gyro_rad_s: Float64Array) -> Float64Array:
    """Attitude change over the samples, trapezoidal: R_first_last [3, 3] (maps last body frame to the first).

    Args:
        timestamps_ns: [N] increasing.
        gyro_rad_s: [N, 3] body rates.
    """
    steps_s = np.diff(timestamps_ns) * 1e-9
    rotation = np.eye(3)
    for step_s, first, second in zip(steps_s, gyro_rad_s[:-1], gyro_rad_s[1:], strict=True):
        rotation = rotation @ so3_exp(0.5 * (first + second) * step_s)
    return rotation


def solve_few(matrix: Float64Array, vector: Float64Array) -> Float64Array:
    """x [P] of matrix [P, P] x = vector [P], for a handful of unknowns; not a number where there is none, and where a
    pivot is under about 1e-14.

    OpenCV's elimination, because the one that numpy calls takes several times as long to begin.
    """
    solvable, solution = cv2.solve(matrix, vector[:, None], flags=cv2.DECOMP_LU)
    return np.asarray(solution, dtype=np.float64)[:, 0] if solvable else np.full(len(vector), np.nan)


def pixel_grid(height: int, width: int) -> Float32Array:
    """[H, W, 2] of (u, v) pixel-centre coordinates."""
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return np.stack([u, v], axis=-1)


def sample_bilinear(array: NDArray[Any], at_px: Float32Array, *, border: int = cv2.BORDER_REPLICATE) -> NDArray[Any]:
    """Bilinear samples of [H, W(, C)] at [h, w, 2] pixel coordinates; the border is repeated (BORDER_CONSTANT: 0)."""
    return cv2.remap(  # type: ignore[call-overload, no-any-return]  # the stubs lack the two-channel map
        array, at_px, None, cv2.INTER_LINEAR, borderMode=border, borderValue=0
    )


# An image of the largest size that the default limits allow (16 Mi pixels) fits into it.
_GRIDS: ArrayCache[Float32Array] = ArrayCache(160 * MEBIBYTE)


def cached_pixel_grid(height: int, width: int) -> Float32Array:
    """Read-only ``pixel_grid``, made once."""

    def make() -> Float32Array:
        grid = pixel_grid(height, width)
        grid.setflags(write=False)
        return grid

    return _GRIDS.get((height, width), make, lambda grid: grid.nbytes)


def _distort(
    camera: PinholeCamera, x: NDArray[np.floating], y: NDArray[np.floating]
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    k = camera.distortion_coeffs
    r2 = x * x + y * y
    if camera.distortion_model == "equidistant":
        r = np.sqrt(r2)
        theta = np.arctan(r)
        t2 = theta * theta
        theta_d = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
        scale = np.where(r > 1e-8, theta_d / np.maximum(r, 1e-8), 1.0)
        return x * scale, y * scale
    k3 = k[4] if len(k) == 5 else 0.0
    radial = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k3))
    xy2 = 2 * x * y
    return (
        x * radial + k[2] * xy2 + k[3] * (r2 + 2 * x * x),
        y * radial + k[2] * (r2 + 2 * y * y) + k[3] * xy2,
    )


def project_rays(camera: PinholeCamera, rays: NDArray[np.floating]) -> NDArray[np.floating]:
    """Normalised image coordinates (x/z, y/z) [..., 2] -> pixels [..., 2] with the camera's distortion."""
    x, y = rays[..., 0], rays[..., 1]
    if camera.is_distorted:
        x, y = _distort(camera, x, y)
    return np.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], axis=-1)


def unproject_pixels(camera: PinholeCamera, pixels: NDArray[np.floating]) -> Float64Array:
    """Pixels [..., 2] -> undistorted normalised image coordinates (x/z, y/z) [..., 2].

    radtan has no closed inverse: fixed-point iteration as in OpenCV's undistortPoints, run to convergence.
    """
    points = np.asarray(pixels, dtype=np.float64)
    distorted = (points - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    if not camera.is_distorted:
        return np.asarray(distorted)
    if camera.distortion_model == "equidistant":
        flat = np.ascontiguousarray(distorted).reshape(-1, 1, 2)
        undistorted = cv2.fisheye.undistortPoints(flat, np.eye(3), np.array(camera.distortion_coeffs))
        return np.asarray(undistorted, dtype=np.float64).reshape(points.shape)
    rays = distorted.copy()
    for _ in range(30):
        x, y = rays[..., 0], rays[..., 1]
        rays += distorted - np.stack(_distort(camera, x, y), axis=-1)
    return np.asarray(rays)


def rigid_motion_flow(
    camera: PinholeCamera, depth_m: NDArray[np.floating], T_target_source: Float64Array
) -> tuple[Float32Array, NDArray[np.bool_]]:
    """Flow that a static world shows when the camera moves.

    Args:
        camera: intrinsics of both images (undistorted or distorted; the flow is in its pixels).
        depth_m: [H, W] depth along the optical axis in the source camera; may be inf (rotation only).
        T_target_source: [4, 4], maps source-camera coordinates to target-camera coordinates.

    Returns:
        flow_px [H, W, 2] float32 (target = source + flow) and valid [H, W]: in front of the target camera.
    """
    height, width = depth_m.shape
    pixels = pixel_grid(height, width)
    rays_xy = unproject_pixels(camera, pixels)
    rays = np.concatenate([rays_xy, np.ones((height, width, 1))], axis=-1)
    inverse_depth = np.where(np.isfinite(depth_m), 1.0 / np.maximum(depth_m, 1e-6), 0.0)
    points = rays @ T_target_source[:3, :3].T + inverse_depth[..., None] * T_target_source[:3, 3]
    valid = points[..., 2] > 1e-6
    z = np.where(valid, points[..., 2], 1.0)
    target = project_rays(camera, points[..., :2] / z[..., None])
    flow = np.where(valid[..., None], target - pixels, 0.0)
    return flow.astype(np.float32), valid


def occluded_pixels(
    camera: PinholeCamera,
    source_depth_m: NDArray[np.floating],
    target_depth_m: NDArray[np.floating],
    T_target_source: Float64Array,
    *,
    tolerance: float = 0.02,
) -> NDArray[np.bool_]:
    """Which pixels of the source show a point that something nearer hides in the target.

    A point counts as hidden when it lies farther than all four pixels around its place in the target say, by more than
    ``tolerance`` of its depth. Unknown depth (inf) hides nothing; what leaves the image is not hidden.

    Args:
        camera: of both images.
        source_depth_m, target_depth_m: [H, W], inf where unknown.
        T_target_source: [4, 4].

    Returns:
        [H, W].
    """
    height, width = source_depth_m.shape
    flow, in_front = rigid_motion_flow(camera, source_depth_m, T_target_source)
    target = np.where(in_front[..., None], pixel_grid(height, width) + flow, -1.0)
    inside = in_front & (target >= 0).all(-1) & (target[..., 0] <= width - 1) & (target[..., 1] <= height - 1)
    known = inside & np.isfinite(source_depth_m)
    rows, columns = np.nonzero(known)
    rays = np.append(unproject_pixels(camera, np.stack([columns, rows], axis=-1)), np.ones((rows.size, 1)), axis=1)
    points = rays * source_depth_m[known][:, None]
    depth = points @ T_target_source[2, :3] + T_target_source[2, 3]
    left, top = np.floor(target[known]).astype(np.intp).T
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    corners = [target_depth_m[v, u] for v in (top, bottom) for u in (left, right)]
    hidden = np.zeros((height, width), dtype=np.bool_)
    hidden[known] = depth > np.max(corners, axis=0) * (1 + tolerance)
    return hidden
