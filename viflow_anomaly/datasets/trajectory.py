"""Where the camera was: poses by time, measured by Vicon, GPS or a simulator, interpolated to any stamp between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.errors import DatasetError
from viflow_anomaly.geometry import so3_exp, so3_log
from viflow_anomaly.sensor_data import Float64Array, Int64Array

MAX_POSE_GAP_NS = 250_000_000
"""Beyond it a straight line between two poses says nothing of the motion; KITTI's poses are 100 ms apart."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of one camera in a fixed world.

    Args:
        timestamps_ns: [N] int64, strictly increasing, in the camera's clock.
        T_world_cam: [N, 4, 4], each maps camera coordinates to the world's.
        origin: the file they came from, for messages.
    """

    timestamps_ns: Int64Array
    T_world_cam: Float64Array
    origin: str

    def __post_init__(self) -> None:
        assert self.T_world_cam.shape == (self.timestamps_ns.size, 4, 4)
        assert self.timestamps_ns.size > 0
        assert (np.diff(self.timestamps_ns) > 0).all()

    def pose(self, timestamp_ns: int) -> Float64Array:
        """T_world_cam [4, 4] at a stamp: position on a straight line, rotation at a constant rate between two poses.

        Raises:
            DatasetError: ``trajectory_not_covering``: a stamp before the first or after the last pose, or in a gap of
                more than 250 ms.
        """
        stamps = self.timestamps_ns
        after = int(np.searchsorted(stamps, timestamp_ns))
        if after < stamps.size and stamps[after] == timestamp_ns:
            return np.array(self.T_world_cam[after])
        inside = 0 < after < stamps.size
        if not inside or int(stamps[after] - stamps[after - 1]) > MAX_POSE_GAP_NS:
            found = f"a gap from {stamps[after - 1]} to {stamps[after]}" if inside else f"{stamps[0]} to {stamps[-1]}"
            raise DatasetError(
                f"{self.origin}: expected poses around {timestamp_ns}, found {found}", code="trajectory_not_covering"
            )
        share = float(timestamp_ns - stamps[after - 1]) / float(stamps[after] - stamps[after - 1])
        return _between(self.T_world_cam[after - 1], self.T_world_cam[after], share)

    def motion(self, source_ns: int, target_ns: int) -> Float64Array:
        """T_target_source [4, 4]: maps source-camera to target-camera coordinates.

        Raises:
            DatasetError: as ``pose``.
        """
        return np.asarray(np.linalg.inv(self.pose(target_ns)) @ self.pose(source_ns))

    def displacement_m(self, source_ns: int, target_ns: int) -> Float64Array:
        """[3] how far the camera moved from source to target, in metres along the source camera's axes.

        Raises:
            DatasetError: as ``pose``.
        """
        source = self.pose(source_ns)
        return np.asarray(source[:3, :3].T @ (self.pose(target_ns)[:3, 3] - source[:3, 3]))


def _between(first: Float64Array, second: Float64Array, share: float) -> Float64Array:
    pose = np.eye(4)
    turn = so3_log(first[:3, :3].T @ second[:3, :3])
    pose[:3, :3] = first[:3, :3] @ so3_exp(share * turn)
    pose[:3, 3] = (1 - share) * first[:3, 3] + share * second[:3, 3]
    return pose


def rotations_of(quaternions_wxyz: Float64Array) -> NDArray[np.float64]:
    """Quaternions [N, 4], not necessarily of length one -> rotation matrices [N, 3, 3]."""
    w, x, y, z = (quaternions_wxyz / np.linalg.norm(quaternions_wxyz, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def rigid(rotations: Float64Array, positions: Float64Array) -> Float64Array:
    """[N, 3, 3] and [N, 3] -> [N, 4, 4]."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, positions
    return poses
