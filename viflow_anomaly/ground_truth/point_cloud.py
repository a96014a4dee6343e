"""A room as points: where they are, and how densely they lie around each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.sensor_data import Float64Array

Float32Array = NDArray[np.float32]

CELL_M = 0.1
"""Side of the cells in which points are counted: large against the spacing (about 1 cm), small against furniture."""

MAX_SPACING_RATIO = 5.0
STRAY_SPACING_M = 0.05
"""Points that lie this much sparser than most, and farther apart than this (under four in a cell), are stray returns
between scanner and wall, not a surface."""


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points on surfaces.

    Args:
        points_m: [N, 3] float32, in the world's frame.
        spacing_m: [N] float32, the distance between neighbours around each point.
    """

    points_m: Float32Array
    spacing_m: Float32Array

    def __post_init__(self) -> None:
        assert self.points_m.ndim == 2
        assert self.points_m.shape == (self.spacing_m.size, 3)

    def __len__(self) -> int:
        return int(self.spacing_m.size)


def make_point_cloud(points_m: Float32Array, T_world_cloud: Float64Array | None = None) -> PointCloud:
    """Points [N, 3] of a scan, moved to the world; stray ones are left out."""
    points = points_m
    if T_world_cloud is not None and not np.array_equal(T_world_cloud, np.eye(4)):
        points = (points_m @ T_world_cloud[:3, :3].T + T_world_cloud[:3, 3]).astype(np.float32)
    spacing = np.minimum(_spacing(points, 0.0), _spacing(points, CELL_M / 2))
    kept = spacing <= max(MAX_SPACING_RATIO * float(np.median(spacing)), STRAY_SPACING_M)
    return PointCloud(points[kept], spacing[kept])


def _spacing(points: Float32Array, shift_m: float) -> Float32Array:
    """[N] from the number of points in each one's cell: a surface that crosses it has about the area of its side.

    A surface that only touches a cell's corner seems sparse there; the smaller value of two grids mends that.
    """
    cells = np.floor((points + np.float32(shift_m)) / CELL_M).astype(np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    keys = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    return (CELL_M / np.sqrt(counts)).astype(np.float32)[inverse]
