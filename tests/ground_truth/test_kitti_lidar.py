"""Sparse flow of a drive towards a wall, known in closed form; hidden points, boxes, files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from lidar_drive import CAMERA, POST_M, SPEED_M, WALL_M, drive_world, scan_of, wall_and_post, write_drive
from worlds import stamp_text, write_lines

from viflow_anomaly.datasets.ground_truth_folder import GroundTruthFolder
from viflow_anomaly.datasets.kitti_labels import MOTION_COLUMNS
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.ground_truth.kitti_lidar import read_scan, render_lidar

STAMPS = drive_world().frame_timestamps_ns.tolist()
LABEL = "{kind} 0.00 0 -1.5 {left} {top} {right} {bottom} 1.5 1.6 4.0 0.0 1.7 20.0 -1.5"
DONT_CARE = "DontCare -1 -1 -10 {left} {top} {right} {bottom} -1 -1 -1 -1000 -1000 -1000 -10"
BOX = {"left": "20.00", "top": "10.00", "right": "60.00", "bottom": "40.00"}


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """Scans for frames 0, 2 and 3; there is no frame after 3."""
    return write_drive(tmp_path, drive_world(), dict.fromkeys((0, 2, 3), wall_and_post()))


def label(drive: Path, frame: int, *lines: str) -> None:
    write_lines(drive / "label_2" / f"{frame:010d}.txt", list(lines))


def motion(drive: Path, *moving: str, frame: int = 0) -> None:
    box = ",".join(BOX.values())
    rows = [f"{frame},{k},Car,{box},0.00,0,0,1.7,20.0,,{state}" for k, state in enumerate(moving)]
    write_lines(drive / "label_motion_derived.csv", [",".join(MOTION_COLUMNS), *rows])


def test_flow_is_that_of_driving_towards_the_wall(drive: Path) -> None:
    """u' - c = (u - c) z / (z - speed), up to Mercator's scale and 4 mm of depth."""
    summary = render_lidar(drive)
    assert (summary.frames, summary.with_scan, summary.written, summary.kept, summary.with_flow) == (4, 3, 3, 0, 2)
    truth = GroundTruthFolder(drive)
    assert truth.source_stamps == (STAMPS[0], STAMPS[2], STAMPS[3])
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    offset = np.stack([u - CAMERA.cx, v - CAMERA.cy], axis=-1)
    for source, target, steps in ((0, 1, 1), (2, 3, 1), (0, 3, 3), (3, 2, -1)):
        flow, valid = truth.static_flow(STAMPS[source], STAMPS[target])
        depth = truth.depth(STAMPS[source])
        np.testing.assert_array_equal(valid, np.isfinite(depth))
        assert 0.2 < valid.mean() < 1
        z = depth[valid]
        exact = offset[valid] * (z / (z - steps * SPEED_M) - 1)[:, None]
        np.testing.assert_allclose(flow[valid], exact, atol=0.02)
        assert not flow[~valid].any()


def test_points_behind_the_post_are_hidden(drive: Path) -> None:
    summary = render_lidar(drive)
    depth = GroundTruthFolder(drive).depth(STAMPS[0])
    u, v = np.meshgrid(np.arange(CAMERA.width) - CAMERA.cx, np.arange(CAMERA.height) - CAMERA.cy)
    post = (np.abs(u) < 0.15 * 120 - 1) & (np.abs(v) < 0.15 * 120 - 1)
    assert set(np.round(depth[post & np.isfinite(depth)], 1)) == {POST_M}
    around = ~((np.abs(u) < 0.15 * 120 + 1) & (np.abs(v) < 0.15 * 120 + 1))
    assert set(np.round(depth[around & np.isfinite(depth)], 1)) == {WALL_M}
    assert summary.hidden_points > 0.7 * 3 * len(scan_of(WALL_M, (0.15, 0.15)))


def in_box(valid: np.ndarray[tuple[int, int], np.dtype[np.bool_]]) -> float:
    return float(valid[10:41, 20:61].mean())


@pytest.mark.parametrize("moving", ["1", "?", ""])
def test_what_moves_or_may_move_is_left_out(drive: Path, moving: str) -> None:
    motion(drive, moving)
    label(drive, 0, LABEL.format(kind="Car", **BOX))
    summary = render_lidar(drive)
    assert in_box(GroundTruthFolder(drive).static_flow(STAMPS[0], STAMPS[1])[1]) == 0
    assert in_box(GroundTruthFolder(drive).static_flow(STAMPS[2], STAMPS[3])[1]) > 0.2
    assert summary.points_in_boxes > 0
    assert summary.without_labels == 2


def test_what_rests_is_kept(drive: Path) -> None:
    motion(drive, "0")
    label(drive, 0, LABEL.format(kind="Car", **BOX))
    assert render_lidar(drive).points_in_boxes == 0
    assert in_box(GroundTruthFolder(drive).static_flow(STAMPS[0], STAMPS[1])[1]) > 0.2


@pytest.mark.parametrize("line", [LABEL.format(kind="Cyclist", **BOX), DONT_CARE.format(**BOX)])
def test_labels_of_which_nothing_is_said_are_left_out(drive: Path, line: str) -> None:
    label(drive, 0, line)
    render_lidar(drive)
    assert in_box(GroundTruthFolder(drive).static_flow(STAMPS[0], STAMPS[1])[1]) == 0


def test_a_frame_whose_labels_are_empty_is_labelled(drive: Path) -> None:
    label(drive, 0)
    assert render_lidar(drive).without_labels == 2


def test_boxes_shrink_with_the_images(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, drive_world(), {0: wall_and_post()})
    calibration = drive.parent / "calib_cam_to_cam.txt"
    calibration.write_text(calibration.read_text().replace("S_rect_02: 200 60", "S_rect_02: 400 120"))
    label(drive, 0, LABEL.format(kind="Car", left=40, top=20, right=120, bottom=80))
    render_lidar(drive)
    known = np.isfinite(GroundTruthFolder(drive).depth(STAMPS[0]))
    assert not known[10:30, 20:61].any()
    assert known[10:30, 70:95].mean() > 0.2


def test_labels_of_image_02_say_nothing_of_other_cameras(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, drive_world(), {0: wall_and_post()})
    (drive / "image_02").rename(drive / "image_03")
    label(drive, 0, LABEL.format(kind="Car", **BOX))
    summary = render_lidar(drive)
    assert (summary.without_labels, summary.points_in_boxes) == (1, 0)


def test_a_second_run_goes_on(drive: Path) -> None:
    first = render_lidar(drive)
    (first.folder / "depth" / f"{STAMPS[2]}.png").unlink()
    again = render_lidar(drive)
    assert (again.written, again.kept, again.with_flow) == (1, 2, 2)


def other_scan(drive: Path) -> None:
    path = drive / "velodyne_points/data/0000000002.bin"
    path.write_bytes(path.read_bytes()[:-16])


def other_pose(drive: Path) -> None:
    path = drive / "oxts/data/0000000003.txt"
    path.write_text(path.read_text().replace("112.0", "112.5"))


def other_scanner(drive: Path) -> None:
    path = drive.parent / "calib_imu_to_velo.txt"
    path.write_text(path.read_text().replace("-0.8", "-0.9", 1))


def other_labels(drive: Path) -> None:
    label(drive, 0, LABEL.format(kind="Car", **BOX))


def other_motion(drive: Path) -> None:
    motion(drive, "1")


@pytest.mark.parametrize("change", [other_scan, other_pose, other_scanner, other_labels, other_motion])
def test_what_it_was_made_from_must_not_change(drive: Path, change: Callable[[Path], None]) -> None:
    folder = render_lidar(drive).folder
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    change(drive)
    with pytest.raises(DatasetError, match="--overwrite") as raised:
        render_lidar(drive)
    assert raised.value.code == "ground_truth_differs"
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    assert render_lidar(drive, overwrite=True).written == 3


@pytest.mark.parametrize("content", [b"", b"\0" * 15, b"\0" * 17])
def test_malformed_scans_are_named(drive: Path, content: bytes) -> None:
    scan = drive / "velodyne_points/data/0000000002.bin"
    scan.write_bytes(content)
    with pytest.raises(DatasetError, match=r"0000000002\.bin") as raised:
        render_lidar(drive)
    assert raised.value.code == "scan_malformed"


def test_points_without_return_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "scan.bin").write_bytes(np.array([[1, 2, 3, 0], [np.nan, 2, 3, 0]], "<f4").tobytes())
    np.testing.assert_array_equal(read_scan(tmp_path / "scan.bin"), [[1, 2, 3]])


def test_a_drive_without_scans_is_refused(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, drive_world(), {})
    with pytest.raises(DatasetError, match="velodyne_points") as raised:
        render_lidar(drive)
    assert raised.value.code == "scans_missing"


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("calib_cam_to_cam.txt", "camera_missing"),
        ("calib_velo_to_cam.txt", "mounting_missing"),
        ("calib_imu_to_velo.txt", "mounting_missing"),
    ],
)
def test_without_calibration_there_is_no_truth(drive: Path, name: str, code: str) -> None:
    (drive.parent / name).unlink()
    with pytest.raises(DatasetError) as raised:
        render_lidar(drive)
    assert raised.value.code == code


@pytest.mark.parametrize("line", ["Car 1 2 3", LABEL.format(kind="Car", **BOX) + " 1"])
def test_malformed_labels_are_named(drive: Path, line: str) -> None:
    label(drive, 0, line)
    with pytest.raises(DatasetError, match=r"0000000000\.txt, line 1") as raised:
        render_lidar(drive)
    assert raised.value.code == "labels_malformed"


@pytest.mark.parametrize(("frame", "moving"), [("x", "0"), ("1" * 11, "0"), ("0", "maybe")])
def test_malformed_motions_are_named(drive: Path, frame: str, moving: str) -> None:
    row = f"{frame},0,Car,1,2,3,4,0,0,0,0,0,,{moving}"
    write_lines(drive / "label_motion_derived.csv", [",".join(MOTION_COLUMNS), row])
    with pytest.raises(DatasetError, match="line 2") as raised:
        render_lidar(drive)
    assert raised.value.code == "labels_malformed"


def test_frames_beyond_the_poses_are_left_out(drive: Path) -> None:
    later = [*STAMPS[:3], STAMPS[3] + 10**10]
    write_lines(drive / "image_02/timestamps.txt", [stamp_text(stamp) for stamp in later])
    summary = render_lidar(drive)
    assert (summary.frames, summary.with_scan, summary.written, summary.with_flow) == (4, 2, 2, 1)


def test_without_any_pose_there_is_no_truth(drive: Path) -> None:
    write_lines(drive / "image_02/timestamps.txt", [stamp_text(stamp + 10**10) for stamp in STAMPS])
    with pytest.raises(DatasetError) as raised:
        render_lidar(drive)
    assert raised.value.code == "trajectory_not_covering"
