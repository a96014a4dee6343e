"""Sparse static flow for KITTI's raw drives, from LiDAR scans and OXTS poses.

```
drive/
  velodyne_points/data/0000000000.bin     float32 x y z reflectance, one scan a frame; some frames may have none
  label_2/, label_motion_derived.csv      optional; see datasets/kitti_labels.py
```
A scan's points are brought into the camera (``T_cam_velo = T_cam_imu inv(T_velo_imu)``) and into its pixels; those that
nearer ones surround are hidden from the camera, which sits lower and farther ahead than the scanner. Points in boxes of
what moves or may move are left out. The rest is static: it moves by the camera's motion to the next frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.config import ImageLimits
from viflow_anomaly.datasets.kitti_files import numbered_files, read_calibration
from viflow_anomaly.datasets.kitti_labels import LABELLED_CAMERA, Box, label_files, label_scale
from viflow_anomaly.datasets.recording import FileRecording
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.geometry import project_rays, rigid_motion_flow
from viflow_anomaly.ground_truth.kitti_boxes import read_doubtful_boxes
from viflow_anomaly.ground_truth.range_image import MARGIN_PX, NEAREST_M, ImagePoints, front_depth, points_in_image
from viflow_anomaly.ground_truth.truth_folder import (
    FrameTruth,
    TruthFolder,
    fingerprint_of_files,
    fingerprint_of_sizes,
    record_head,
    require_camera,
)
from viflow_anomaly.sensor_data import Float64Array, PinholeCamera

Float32Array = NDArray[np.float32]
BoolArray = NDArray[np.bool_]

MAX_SCAN_BYTES = 64 * 1024 * 1024
REACH_RAD = 0.013
"""Half as much again as the angle between two of the HDL-64's beams (0.0087 at its widest)."""

HIDDEN_BEHIND = 0.03
"""Share of its depth by which a point must lie behind those around it to count as hidden."""

BOX_MARGIN = 0.05
"""Boxes are widened by this share of their sides: labels and scan are not taken at the same instant."""


@dataclass(frozen=True)
class LidarSummary:
    """What one run did: of ``frames``, how many have a scan and a pose, were written now, had been before, have flow to
    their next frame, have no labels (there, nothing that moves could be left out). The rest counts points in the frames
    written now: static ones that are visible, hidden ones, and those in boxes of what may move."""

    folder: Path
    frames: int
    with_scan: int
    written: int
    kept: int
    with_flow: int
    without_labels: int
    static_points: int
    hidden_points: int
    points_in_boxes: int


def render_lidar(
    drive: Path,
    *,
    out: Path | None = None,
    camera: str | None = None,
    overwrite: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
) -> LidarSummary:
    """Write sparse ground truth for a raw drive; a second run goes on where the first ended.

    Args:
        drive: the recording.
        out: ``groundtruth0`` is made in here; None: in the drive.
        camera: as ``open_recording``. Labels are those of image_02; other cameras count as unlabelled.
        overwrite: begin anew.
        on_progress: called with (done, total) after each scan.

    Raises:
        DatasetError: ``camera_missing``, ``mounting_missing``, ``scans_missing``, ``scan_malformed``,
            ``trajectory_not_covering`` (no frame has a pose); as ``open_recording``, ``read_doubtful_boxes`` and
            ``TruthFolder``.
    """
    recording = open_recording(drive, format="kitti_raw", camera=camera, limits=ImageLimits())
    assert isinstance(recording, FileRecording)
    lens = require_camera(recording)
    T_cam_velo = _scanner_mounting(recording, lens)
    poses = _poses(recording)
    stamps = recording.frame_timestamps_ns.tolist()
    scans = [scan for scan in _scans(recording) if stamps[scan[0]] in poses]
    labelled = recording.camera_name == LABELLED_CAMERA
    boxes = read_doubtful_boxes(recording.root) if labelled else {}
    scale = label_scale(recording.root, lens.width, lens.height)
    made_from = {
        "scans": fingerprint_of_sizes(scan for _, _, scan in scans),
        "T_cam_velo": T_cam_velo.tolist(),
        "labels": fingerprint_of_files(label_files(recording.root)) if labelled else None,
        "label_scale": scale,
    }
    record = {**record_head(recording, lens), "made_from": made_from}
    folder = TruthFolder(out or recording.root, record, poses, overwrite=overwrite)
    counts = np.zeros(3, dtype=np.int64)
    kept = with_flow = without_labels = 0
    for done, (index, number, scan) in enumerate(scans, start=1):
        target = stamps[index + 1] if index + 1 < len(stamps) and stamps[index + 1] in poses else None
        without_labels += number not in boxes
        if folder.has(stamps[index], flow=target is not None):
            kept += 1
        else:
            points = _points_in_camera(lens, read_scan(scan), T_cam_velo)
            depth, some = sparse_depth(lens, points, boxes.get(number, []), scale)
            counts += some
            folder.write(stamps[index], _frame_truth(lens, depth, poses, stamps[index], target))
        with_flow += folder.has_flow(stamps[index])
        if on_progress is not None:
            on_progress(done, len(scans))
    return LidarSummary(
        folder.folder, len(stamps), len(scans), len(scans) - kept, kept, with_flow, without_labels, *counts.tolist()
    )


def _frame_truth(
    camera: PinholeCamera, depth: Float32Array, poses: dict[int, Float64Array], source: int, target: int | None
) -> FrameTruth:
    if target is None:
        return FrameTruth(depth)
    flow, in_front = rigid_motion_flow(camera, depth, np.linalg.inv(poses[target]) @ poses[source])
    return FrameTruth(depth, flow, in_front & np.isfinite(depth))


def _scans(recording: FileRecording) -> list[tuple[int, int, Path]]:
    """(index of the frame, its number, the scan) of every frame that has a scan."""
    folder = recording.root / "velodyne_points" / "data"
    files = numbered_files(folder, (".bin",)) if folder.is_dir() else {}
    numbers = [int(path.stem) for path in recording.frame_paths]
    scans = [(index, number, files[number]) for index, number in enumerate(numbers) if number in files]
    if not scans:
        raise DatasetError(
            f"{folder}: expected scans named as the frames (0000000000.bin), found none", code="scans_missing"
        )
    return scans


def _poses(recording: FileRecording) -> dict[int, Float64Array]:
    """{stamp: T_world_cam} of the frames that the OXTS records cover."""
    trajectory = recording.trajectory
    assert trajectory is not None  # there is one wherever the mounting is known
    poses = {}
    problem: DatasetError | None = None
    for stamp in recording.frame_timestamps_ns.tolist():
        try:
            poses[stamp] = trajectory.pose(stamp)
        except DatasetError as err:
            problem = err
    if not poses and problem is not None:
        raise problem
    return poses


def _scanner_mounting(recording: FileRecording, camera: PinholeCamera) -> Float64Array:
    """T_cam_velo [4, 4] of the chosen camera."""
    path = recording.root.resolve().parent / "calib_imu_to_velo.txt"
    if camera.T_cam_imu is None:
        raise DatasetError(
            f"{path}: expected calib_imu_to_velo.txt and calib_velo_to_cam.txt there, found not both",
            code="mounting_missing",
        )
    values = read_calibration(path, {"R": 9, "T": 3})
    T_velo_imu = np.eye(4)
    T_velo_imu[:3, :3], T_velo_imu[:3, 3] = values["R"].reshape(3, 3), values["T"]
    return np.asarray(camera.T_cam_imu @ np.linalg.inv(T_velo_imu))


def read_scan(path: Path) -> Float32Array:
    """Points of one scan, [N, 3] float32 in the scanner's frame (x ahead, y left, z up); reflectance is left out.

    Raises:
        DatasetError: ``scan_malformed``.
    """
    size = path.stat().st_size
    if not size or size % 16 or size > MAX_SCAN_BYTES:
        raise DatasetError(
            f"{path}: expected rows of four float32 (16 bytes), at most {MAX_SCAN_BYTES} bytes, found {size} bytes",
            code="scan_malformed",
        )
    points = np.fromfile(path, "<f4").reshape(-1, 4)[:, :3]
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def _points_in_camera(camera: PinholeCamera, scan: Float32Array, T_cam_velo: Float64Array) -> ImagePoints:
    points = scan.astype(np.float64) @ T_cam_velo[:3, :3].T + T_cam_velo[:3, 3]
    points = points[points[:, 2] > NEAREST_M]
    pixels = project_rays(camera, points[:, :2] / points[:, 2:])
    reach = np.full(len(points), REACH_RAD * max(camera.fx, camera.fy))
    return points_in_image(camera, pixels, points[:, 2], reach)


def sparse_depth(
    camera: PinholeCamera, points: ImagePoints, boxes: list[Box], scale: tuple[float, float]
) -> tuple[Float32Array, tuple[int, int, int]]:
    """Depth of the static points that the camera sees, [H, W], inf elsewhere; the nearest of a pixel counts.

    Args:
        camera: of the image.
        points: all points of the scan, so that also those that are left out hide others.
        boxes: of what may move, at the labels' size.
        scale: (x, y) pixels of the image for a pixel of the labels.

    Returns:
        The depth, and how many points are static and visible, hidden, in boxes (of those in the image).
    """
    front = front_depth(points).reshape(-1)[points.cell]
    place = points.place - MARGIN_PX
    inside = ((np.rint(place) >= 0) & (np.rint(place) < (camera.width, camera.height))).all(axis=1)
    hidden = points.depth_m > front * (1 + HIDDEN_BEHIND)
    moving = _in_boxes(place, boxes, scale)
    static = inside & ~hidden & ~moving
    depth = np.full((camera.height, camera.width), np.inf, dtype=np.float32)
    column, row = np.rint(place[static]).astype(np.intp).T
    np.minimum.at(depth, (row, column), points.depth_m[static].astype(np.float32))
    return depth, (int(static.sum()), int((inside & hidden).sum()), int((inside & ~hidden & moving).sum()))


def _in_boxes(place: Float64Array, boxes: list[Box], scale: tuple[float, float]) -> BoolArray:
    found = np.zeros(len(place), dtype=np.bool_)
    for box in boxes:
        low, high = np.array([box.left, box.top]), np.array([box.right, box.bottom])
        margin = BOX_MARGIN * (high - low)
        found |= ((place >= (low - margin) * scale - 1) & (place <= (high + margin) * scale + 1)).all(axis=1)
    return found
