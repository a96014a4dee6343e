"""Depth images of a point cloud.

A pixel lies on a surface when points surround it: one in each of the four quadrants around it, within the reach of
that point (a few times the cloud's spacing there, seen from here). Its front is the farthest of the four nearest. So a
hole between points is closed and what lies behind does not shine through, while nothing grows beyond its own outline
(cf. screen-space visibility of points, Pintus et al. 2011). Points behind their pixel's front are hidden. The depth is
a plane in inverse depth, fitted to the points that are not hidden around each pixel: exact on flat walls.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.geometry import project_rays
from viflow_anomaly.ground_truth.point_cloud import PointCloud
from viflow_anomaly.sensor_data import Float64Array, PinholeCamera

Float32Array = NDArray[np.float32]
IntArray = NDArray[np.intp]

NEAREST_M = 0.05
REACH_SPACINGS = 3.0
"""A quadrant of a random cloud within this reach is empty once in 8000 times (exp(-9))."""

REACHES_PX = (1, 2, 3, 4, 6, 8, 12, 16, 24)
MARGIN_PX = REACHES_PX[-1]
"""Points so far outside the image still surround its border."""

HOLE_PX = 2
"""Holes and stray pixels of this reach, surrounded in the finished image, are closed."""

FAR = np.float32(1e9)
CHUNK = 2_000_000


class ImagePoints(NamedTuple):
    """Points in an image with a margin: place (u, v) [N, 2] px, depth [N] m, reach [N] (an index of REACHES_PX), and
    the size (height, width) of the image with its margin. ``cell`` [N] is the flat index of the pixel."""

    place: Float64Array
    depth_m: Float64Array
    reach: IntArray
    cell: IntArray
    size: tuple[int, int]

    def chosen(self, which: NDArray[np.bool_]) -> ImagePoints:
        """Those of a mask [N]."""
        return ImagePoints(self.place[which], self.depth_m[which], self.reach[which], self.cell[which], self.size)


def render_depth(camera: PinholeCamera, cloud: PointCloud, T_world_cam: Float64Array) -> Float32Array:
    """Depth along the optical axis, [H, W] metres, inf where no surface is known.

    Args:
        camera: with its distortion; the depth belongs to the distorted pixels.
        cloud: in the world's frame.
        T_world_cam: [4, 4].
    """
    points = project_cloud(camera, cloud, T_world_cam)
    front = front_depth(points)
    focal = min(camera.fx, camera.fy)
    reach_px = np.array(REACHES_PX)[points.reach]
    # In the corner of a room, whose walls come nearer on all sides, the front is nearer by up to a reach.
    seen = points.depth_m <= front.reshape(-1)[points.cell] + points.depth_m * (0.01 + 1.5 * reach_px / focal)
    depth = _close_holes(_fit(points.chosen(seen), front, focal), focal)
    inner = slice(MARGIN_PX, -MARGIN_PX)
    return np.ascontiguousarray(depth[inner, inner])


def project_cloud(camera: PinholeCamera, cloud: PointCloud, T_world_cam: Float64Array) -> ImagePoints:
    """The points of the cloud that lie in the image or its margin."""
    T_cam_world = np.linalg.inv(T_world_cam).astype(np.float32)
    points = cloud.points_m @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
    ahead = np.flatnonzero(points[:, 2] > NEAREST_M)
    rays = points[ahead, :2].astype(np.float64) / points[ahead, 2:]
    ahead, rays = _within_lens(camera, ahead, rays)
    depth = points[ahead, 2].astype(np.float64)
    reach_px = REACH_SPACINGS * max(camera.fx, camera.fy) * cloud.spacing_m[ahead] / depth
    return points_in_image(camera, project_rays(camera, rays), depth, reach_px)


def points_in_image(
    camera: PinholeCamera, pixels: NDArray[np.floating], depth_m: Float64Array, reach_px: NDArray[np.floating]
) -> ImagePoints:
    """Points at pixels [N, 2] of the image, with a reach [N] in pixels; those beyond the margin are left out."""
    size = (camera.height + 2 * MARGIN_PX, camera.width + 2 * MARGIN_PX)
    place = np.asarray(pixels, dtype=np.float64) + MARGIN_PX
    inside = ((place > -0.49) & (place < np.array(size[::-1]) - 0.51)).all(axis=1)
    place, depth_m = place[inside], depth_m[inside]
    column, row = np.rint(place).astype(np.intp).T
    reach = np.searchsorted(REACHES_PX, reach_px[inside]).clip(max=len(REACHES_PX) - 1)
    return ImagePoints(place, depth_m, reach, row * size[1] + column, size)


def _within_lens(camera: PinholeCamera, index: IntArray, rays: Float64Array) -> tuple[IntArray, Float64Array]:
    """Without the rays so far off the axis that the distortion polynomial folds them back into the image."""
    radii = np.linspace(0.0, 4.0, 4001)
    along = project_rays(camera, np.stack([radii, np.zeros_like(radii)], axis=-1))[:, 0]
    folding = np.flatnonzero(np.diff(along) <= 0)
    limit = radii[folding[0]] if folding.size else np.inf
    kept = (rays**2).sum(axis=1) < limit**2
    return index[kept], rays[kept]


def front_depth(points: ImagePoints) -> Float32Array:
    """Depth of the surface whose points surround each pixel, [H, W] of the image with its margin; FAR where none."""
    quadrants = np.full((4, *points.size), FAR, dtype=np.float32)
    for level, reach in enumerate(REACHES_PX):
        chosen = points.reach == level
        if not chosen.any():
            continue
        nearest = np.full(points.size[0] * points.size[1], FAR, dtype=np.float32)
        np.minimum.at(nearest, points.cell[chosen], points.depth_m[chosen].astype(np.float32))
        np.minimum(quadrants, _quadrant_minima(nearest.reshape(points.size), reach), out=quadrants)
    return np.asarray(quadrants.max(axis=0))


def _quadrant_minima(depth: Float32Array, reach: int) -> Float32Array:
    """[4, H, W]: the least depth in the square of ``reach`` to each diagonal side of a pixel, its row and column
    included."""
    kernel = np.ones((reach + 1, reach + 1), np.uint8)
    anchors = ((0, 0), (reach, 0), (0, reach), (reach, reach))
    minima = [
        cv2.erode(depth, kernel, anchor=anchor, borderType=cv2.BORDER_CONSTANT, borderValue=float(FAR))
        for anchor in anchors
    ]
    return np.stack(minima).astype(np.float32, copy=False)


def _fit(points: ImagePoints, front: Float32Array, focal: float) -> Float32Array:
    """Depth [H, W], inf where there is no front or no point near: a plane in inverse depth through the points around.

    A point counts for the pixels within half its reach whose front it belongs to, with a weight that falls to zero
    there.
    """
    count = front.size
    moments = np.zeros((9, count))
    flat_front = front.reshape(-1)
    for level, reach in enumerate(REACHES_PX):
        radius = max(1, (reach + 1) // 2)
        chosen = np.flatnonzero(points.reach == level)
        offsets = np.mgrid[-radius : radius + 1, -radius : radius + 1].reshape(2, -1)
        gate = 0.02 + 4.0 * radius / focal
        for part in np.array_split(chosen, -(-chosen.size * offsets.shape[1] // CHUNK) or 1):
            _add_moments(moments, points, part, offsets, flat_front, radius + 0.5, gate)
    w, wx, wy, wxx, wxy, wyy, wq, wxq, wyq = moments
    known = (w > 1e-9) & (flat_front < FAR)
    w = np.where(known, w, 1.0)
    x, y, q = wx / w, wy / w, wq / w
    # A small ridge (in px^2) keeps the plane flat along directions in which no two points differ.
    xx, yy, xy = wxx / w - x * x + 0.02, wyy / w - y * y + 0.02, wxy / w - x * y
    xq, yq = wxq / w - x * q, wyq / w - y * q
    determinant = xx * yy - xy * xy
    slope_x, slope_y = (yy * xq - xy * yq) / determinant, (xx * yq - xy * xq) / determinant
    inverse = q - slope_x * x - slope_y * y
    # No plane leads far away from the mean of its own points.
    inverse = np.clip(inverse, 0.8 * q, 1.25 * q)
    depth = np.full(count, np.inf)
    depth[known] = 1.0 / inverse[known]
    return depth.reshape(front.shape).astype(np.float32)


def _add_moments(
    moments: Float64Array,
    points: ImagePoints,
    part: IntArray,
    offsets: IntArray,
    front: Float32Array,
    radius: float,
    gate: float,
) -> None:
    """Add what the points of ``part`` say to ``moments``: sums of w, wx, wy, wxx, wxy, wyy, wq, wxq, wyq at each pixel,
    (x, y) from the pixel to the point, q its inverse depth."""
    if not part.size:
        return
    height, width = points.size
    row, column = np.divmod(points.cell[part], width)
    rows, columns = row[:, None] + offsets[0], column[:, None] + offsets[1]
    depth = np.broadcast_to(points.depth_m[part][:, None], rows.shape)
    x, y = points.place[part, :1] - columns, points.place[part, 1:] - rows
    weight = 1.0 - (x * x + y * y) / radius**2
    usable = (weight > 0) & (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    cell = np.where(usable, rows * width + columns, 0)
    usable &= np.abs(depth - front[cell]) <= gate * depth
    cell, x, y, w, q = cell[usable], x[usable], y[usable], weight[usable] ** 2, 1.0 / depth[usable]
    for index, value in enumerate((w, w * x, w * y, w * x * x, w * x * y, w * y * y, w * q, w * x * q, w * y * q)):
        moments[index] += np.bincount(cell, value, minlength=front.size)


def _close_holes(depth: Float32Array, focal: float) -> Float32Array:
    """Fill unknown and stray far pixels that known nearer ones surround, with the mean inverse depth of those."""
    known = np.where(np.isfinite(depth), depth, FAR)
    around = _quadrant_minima(known, HOLE_PX).max(axis=0)
    wrong = (around < FAR) & (known > around * (1.02 + 4.0 * HOLE_PX / focal))
    rows, columns = np.nonzero(wrong)
    total, number = np.zeros(rows.size), np.zeros(rows.size)
    for down, right in np.ndindex(2 * HOLE_PX + 1, 2 * HOLE_PX + 1):
        v = (rows + down - HOLE_PX).clip(0, depth.shape[0] - 1)
        u = (columns + right - HOLE_PX).clip(0, depth.shape[1] - 1)
        near = known[v, u] <= around[rows, columns] * (1.02 + 4.0 * HOLE_PX / focal)
        total += np.where(near, 1.0 / known[v, u], 0.0)
        number += near
    closed = depth.copy()
    closed[rows, columns] = number / total
    return closed
