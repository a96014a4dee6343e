"""Ground truth of real recordings agrees with what their pictures show, measured by dense inverse search."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from room import sample_box, write_ply
from worlds import REAL_DATA

from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.datasets.simulated_ground_truth import SimulatedGroundTruth
from viflow_anomaly.geometry import pixel_grid, sample_bilinear
from viflow_anomaly.ground_truth.euroc_room import render_room
from viflow_anomaly.ground_truth.kitti_lidar import render_lidar

# Vicon room 1, walls only, from about where its scan ends.
VICON_ROOM = ((-4.7, -3.5, 0.0), (4.1, 5.2, 4.1))
TEXTURED = 60.0


def real(relative: str) -> Path:
    path = REAL_DATA / relative
    if not path.exists():
        pytest.skip(f"no real data at {path}; set VIFLOW_REAL_DATA to the folder that holds it")
    return path


def compared(recording: Recording, truth: SimulatedGroundTruth, index: int) -> NDArray[np.float64]:
    """[4]: median distance to the measured flow where the picture has texture; mean gray difference to the next frame,
    warped by the truth and not; median length of the flow there."""
    source, target = recording.frame(index), recording.frame(index + 1)
    flow, valid = truth.static_flow(source.timestamp_ns, target.timestamp_ns)
    there = pixel_grid(*valid.shape) + flow
    height, width = valid.shape
    inside = valid & (there >= 0).all(axis=-1) & (there[..., 0] <= width - 1) & (there[..., 1] <= height - 1)
    gray, after = source.image.astype(np.float32), target.image.astype(np.float32)
    texture = np.abs(cv2.Sobel(gray, cv2.CV_32F, 1, 0)) + np.abs(cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    judged = inside & (texture > TEXTURED)
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    measured = search.calc(source.image, target.image, None)  # type: ignore[call-overload]
    warped = np.abs(sample_bilinear(after, there.astype(np.float32)) - gray)[inside].mean()
    distance = np.linalg.norm(flow - measured, axis=-1)[judged]
    length = np.linalg.norm(flow, axis=-1)[judged]
    return np.array([np.median(distance), warped, np.abs(after - gray)[inside].mean(), np.median(length)])


@pytest.mark.parametrize(("drive", "limit_px"), [("0005", 0.8), ("0027", 1.6)])
def test_kitti_lidar_flow_is_what_the_pictures_show(tmp_path: Path, drive: str, limit_px: float) -> None:
    folder = real(f"kitti/2011_09_26/2011_09_26_drive_{drive}_sync")
    summary = render_lidar(folder, out=tmp_path)
    assert summary.written == summary.with_scan > 10
    truth, recording = SimulatedGroundTruth(tmp_path), open_recording(folder)
    indices = np.searchsorted(recording.frame_timestamps_ns, truth.source_stamps).tolist()
    pairs = np.array([compared(recording, truth, k) for k in indices if k + 1 < len(recording)])
    distance, warped, identity, length = np.median(pairs, axis=0)
    assert distance < limit_px
    assert distance < 0.2 * length
    assert warped < 0.6 * identity


def test_a_bare_room_of_its_size_explains_most_of_eurocs_flow(tmp_path: Path) -> None:
    """The room's scan is not in the sample; walls in its place tell whether poses, lens and direction are right."""
    folder = real("euroc/V1_01_easy")
    write_ply(tmp_path / "walls.ply", sample_box(VICON_ROOM, 400, np.random.default_rng(0)))
    poses = folder / "mav0/state_groundtruth_estimate0/openvins_V1_01_easy_corrected_20Hz.csv"
    recording = open_recording(folder)
    summary = render_room(folder, out=tmp_path, cloud=tmp_path / "walls.ply", trajectory=poses)
    assert (summary.frames, summary.without_pose) == (60, 0)
    truth = SimulatedGroundTruth(tmp_path)
    pairs = np.array([compared(recording, truth, k) for k in range(0, 59, 6)])
    distance, warped, identity, length = np.median(pairs, axis=0)
    assert distance < 0.25 * length
    assert warped < 0.6 * identity
