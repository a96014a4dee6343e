"""Ground truth of real recordings agrees with what their pictures show, measured by dense inverse search."""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path

import numpy as np
import pytest
from room import sample_box, write_ply
from worlds import REAL_DATA, write_lines

from viflow_anomaly.datasets.ground_truth_folder import GroundTruthFolder
from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.ground_truth.euroc_room import render_room
from viflow_anomaly.ground_truth.kitti_lidar import render_lidar
from viflow_anomaly.ground_truth.picture_check import PictureCheck, check_pair

# Vicon room 1, walls only, from about where its scan ends.
VICON_ROOM = ((-4.7, -3.5, 0.0), (4.1, 5.2, 4.1))


def real(relative: str) -> Path:
    path = REAL_DATA / relative
    if not path.exists():
        pytest.skip(f"no real data at {path}; set VIFLOW_REAL_DATA to the folder that holds it")
    return path


def medians(recording: Recording, truth: GroundTruthFolder, indices: list[int]) -> PictureCheck:
    checks = [check for k in indices if (check := check_pair(recording, truth, k)) is not None]
    assert checks
    return PictureCheck(*np.median([astuple(check) for check in checks], axis=0).tolist())


@pytest.mark.parametrize(("drive", "limit_px"), [("0005", 0.8), ("0027", 1.6)])
def test_kitti_lidar_flow_is_what_the_pictures_show(tmp_path: Path, drive: str, limit_px: float) -> None:
    folder = real(f"kitti/2011_09_26/2011_09_26_drive_{drive}_sync")
    summary = render_lidar(folder, out=tmp_path)
    assert summary.written == summary.with_scan > 10
    truth, recording = GroundTruthFolder(tmp_path), open_recording(folder)
    indices = np.searchsorted(recording.frame_timestamps_ns, truth.source_stamps).tolist()
    found = medians(recording, truth, [k for k in indices if k + 1 < len(recording)])
    assert found.distance_px < limit_px
    assert found.distance_px < 0.2 * found.flow_px
    assert found.warped_gray < 0.6 * found.identity_gray


def test_a_bare_room_of_its_size_explains_most_of_eurocs_flow(tmp_path: Path) -> None:
    """The room's scan is not in the sample; walls in its place tell whether poses, lens and direction are right."""
    folder = real("euroc/V1_01_easy")
    write_ply(tmp_path / "walls.ply", sample_box(VICON_ROOM, 400, np.random.default_rng(0)))
    recording = open_recording(folder)
    indices = [0, 1, 20, 21, 40, 41]
    stamps = recording.frame_timestamps_ns[indices]
    poses = folder / "mav0/state_groundtruth_estimate0/openvins_V1_01_easy_corrected_20Hz.csv"
    rows = poses.read_text().splitlines()[1:]
    near = [row for row in rows if np.abs(stamps - int(row.split(",")[0])).min() < 1_000_000]
    write_lines(tmp_path / "poses.csv", near)
    summary = render_room(folder, out=tmp_path, cloud=tmp_path / "walls.ply", trajectory=tmp_path / "poses.csv")
    assert (summary.rendered, summary.without_pose, summary.with_flow) == (6, 54, 3)
    truth = GroundTruthFolder(tmp_path)
    found = medians(recording, truth, indices[::2])
    assert found.distance_px < 0.25 * found.flow_px
    assert found.warped_gray < 0.6 * found.identity_gray
