"""Static flow for EuRoC's Vicon rooms, from the room's point cloud (the paper's appendix).

Depth is rendered from the cloud at every frame's pose. Each pixel's ray, with the lens undone, is scaled by its depth,
moved by ``T_target_source = inv(T_world_cam(t1)) T_world_cam(t0)``, and projected with the lens: from the frame at t0
to where its points are in the frame at t1. (The paper writes H the other way round: the motion of t1's points.)
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.config import ImageLimits
from viflow_anomaly.datasets import euroc
from viflow_anomaly.datasets.recording import FileRecording
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.geometry import occluded_pixels, rigid_motion_flow
from viflow_anomaly.ground_truth.frame_poses import POSE_RULE, poses_of_frames, read_trajectory_file
from viflow_anomaly.ground_truth.ply import read_ply_points
from viflow_anomaly.ground_truth.point_cloud import PointCloud, make_point_cloud
from viflow_anomaly.ground_truth.range_image import render_depth
from viflow_anomaly.ground_truth.truth_folder import FrameTruth, TruthFolder, fingerprint, record_head, require_camera
from viflow_anomaly.sensor_data import Float64Array, PinholeCamera

Float32Array = NDArray[np.float32]


@dataclass(frozen=True)
class RoomSummary:
    """What one run did: of ``frames``, how many have no pose, were rendered now, had been before; how many have flow to
    their next frame; the share of pixels with depth in those rendered now (None: none was)."""

    folder: Path
    frames: int
    without_pose: int
    rendered: int
    kept: int
    with_flow: int
    known_share: float | None


def render_room(
    directory: Path,
    *,
    out: Path | None = None,
    cloud: Path | None = None,
    trajectory: Path | None = None,
    camera: str | None = None,
    overwrite: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
) -> RoomSummary:
    """Write ground truth for a EuRoC recording; a second run goes on where the first ended.

    Args:
        directory: the recording.
        out: ``groundtruth0`` is made in here; None: in the recording's ``mav0``.
        cloud: PLY file; None: ``pointcloud0/data.ply``. The ``sensor.yaml`` beside it is honoured.
        trajectory: as ``read_trajectory_file``; None: the recording's own states.
        camera: as ``open_recording``.
        overwrite: begin anew.
        on_progress: called with (done, total) after each frame.

    Raises:
        DatasetError: ``camera_missing``, ``trajectory_missing``, ``trajectory_not_covering`` (no frame has a pose);
            as ``open_recording``, ``read_trajectory_file``, ``read_ply_points`` and ``TruthFolder``.
        TooLargeError: ``point_cloud_too_large``.
    """
    recording = open_recording(directory, format="euroc", camera=camera, limits=ImageLimits())
    assert isinstance(recording, FileRecording)
    lens = require_camera(recording)
    stamps = recording.frame_timestamps_ns.tolist()
    poses = _poses(recording, trajectory, stamps)
    cloud_file = cloud or recording.root / "pointcloud0" / "data.ply"
    points = read_ply_points(cloud_file)
    T_world_cloud = euroc.read_cloud_pose(cloud_file.with_name("sensor.yaml"))
    record = {
        **record_head(recording, lens),
        "made_from": {
            "cloud": {**fingerprint(cloud_file), "points": len(points), "T_world_cloud": T_world_cloud.tolist()},
            "trajectory": "the recording's" if trajectory is None else fingerprint(trajectory),
        },
    }
    folder = TruthFolder(out or recording.root, record, poses, overwrite=overwrite)
    renderer = _Renderer(lens, make_point_cloud(points, T_world_cloud), poses)
    return _render_frames(folder, renderer, stamps, on_progress)


def _poses(recording: FileRecording, trajectory: Path | None, stamps: list[int]) -> dict[int, Float64Array]:
    source = recording.trajectory
    if trajectory is not None:
        source = read_trajectory_file(trajectory, recording.root / str(recording.camera_name) / "sensor.yaml")
    if source is None:
        raise DatasetError(
            f"{recording.root}: expected state_groundtruth_estimate0/data.csv or a file of poses (--trajectory), "
            "found none",
            code="trajectory_missing",
        )
    poses = poses_of_frames(source, stamps)
    if not poses:
        raise DatasetError(
            f"{source.origin}: expected poses for the frames from {stamps[0]} to {stamps[-1]} ({POSE_RULE}), found "
            f"poses from {source.timestamps_ns[0]} to {source.timestamps_ns[-1]}, in the camera's clock, and none so "
            "close",
            code="trajectory_not_covering",
        )
    return poses


class _Renderer:
    """Depth by frame; the last two are kept, because each serves a frame and the one before it."""

    def __init__(self, camera: PinholeCamera, cloud: PointCloud, poses: dict[int, Float64Array]) -> None:
        self.poses = poses
        self._camera = camera
        self._cloud = cloud
        self._rendered: dict[int, Float32Array] = {}

    def depth(self, stamp: int) -> Float32Array:
        if stamp not in self._rendered:
            rendered = render_depth(self._camera, self._cloud, self.poses[stamp])
            self._rendered = dict([*self._rendered.items(), (stamp, rendered)][-2:])
        return self._rendered[stamp]

    def truth(self, source: int, target: int | None) -> FrameTruth:
        depth = self.depth(source)
        if target is None or target not in self.poses:
            return FrameTruth(depth)
        T_target_source = np.linalg.inv(self.poses[target]) @ self.poses[source]
        flow, in_front = rigid_motion_flow(self._camera, depth, T_target_source)
        occluded = occluded_pixels(self._camera, depth, self.depth(target), T_target_source)
        return FrameTruth(depth, flow, in_front & np.isfinite(depth), occluded)


def _render_frames(
    folder: TruthFolder, renderer: _Renderer, stamps: list[int], on_progress: Callable[[int, int], None] | None
) -> RoomSummary:
    shares: list[float] = []
    kept = with_flow = 0
    for done, (source, target) in enumerate(itertools.pairwise([*stamps, None]), start=1):
        assert source is not None
        if source in renderer.poses:
            if folder.has(source, flow=target in renderer.poses):
                kept += 1
            else:
                truth = renderer.truth(source, target)
                folder.write(source, truth)
                shares.append(float(np.isfinite(truth.depth_m).mean()))
            with_flow += folder.has_flow(source)
        if on_progress is not None:
            on_progress(done, len(stamps))
    return RoomSummary(
        folder=folder.folder,
        frames=len(stamps),
        without_pose=len(stamps) - len(renderer.poses),
        rendered=len(shares),
        kept=kept,
        with_flow=with_flow,
        known_share=float(np.mean(shares)) if shares else None,
    )
