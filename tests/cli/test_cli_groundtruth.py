"""``viflow-anomaly groundtruth``: what it prints and refuses."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from lidar_drive import drive_world, wall_and_post, write_drive
from pair_world import Ask
from room import camera_pose, sample_room, write_room_recording
from worlds import EUROC, write_plain

from viflow_anomaly.datasets.ground_truth_folder import GroundTruthFolder

CAMERA = EUROC.scaled_to(94, 60)


@pytest.fixture
def room(tmp_path: Path) -> Path:
    poses = [camera_pose((0.1 * k, -1.0, 1.3), 0.0) for k in range(2)]
    return write_room_recording(tmp_path / "V9", CAMERA, poses, sample_room(60))


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    return write_drive(tmp_path, drive_world(), dict.fromkeys((0, 2), wall_and_post()))


def test_euroc_json(ask: Ask, room: Path, tmp_path: Path) -> None:
    answer = ask(["groundtruth", "euroc", str(room), "--out", str(tmp_path / "truth"), "--json"])
    assert (answer.code, answer.err) == (0, "")
    report = json.loads(answer.out)
    assert report.pop("known_share") > 0.9
    assert report == {
        "folder": str(tmp_path / "truth" / "groundtruth0"),
        "frames": 2,
        "without_pose": 0,
        "rendered": 2,
        "kept": 0,
        "with_flow": 1,
    }
    assert not (room / "mav0" / "groundtruth0").exists()
    assert len(GroundTruthFolder(tmp_path / "truth").source_stamps) == 2


def test_euroc_in_words_and_again(ask: Ask, room: Path) -> None:
    first = ask(["groundtruth", "euroc", str(room)])
    assert first.code == 0
    assert "2 frames: 2 rendered, 0 were there, 0 without a pose; 1 with flow" in first.out
    assert "of the pixels" in first.out
    again = ask(["groundtruth", "euroc", str(room)])
    assert "0 rendered, 2 were there" in again.out
    assert "pixels" not in again.out
    assert "2 rendered, 0 were there" in ask(["groundtruth", "euroc", str(room), "--overwrite"]).out


def test_euroc_takes_cloud_and_poses_from_elsewhere(ask: Ask, room: Path, tmp_path: Path) -> None:
    (room / "mav0/pointcloud0/data.ply").rename(tmp_path / "room.ply")
    (room / "mav0/state_groundtruth_estimate0/data.csv").rename(tmp_path / "poses.csv")
    places = ["--cloud", str(tmp_path / "room.ply"), "--trajectory", str(tmp_path / "poses.csv"), "--camera", "cam0"]
    assert ask(["groundtruth", "euroc", str(room), *places]).code == 0


def test_kitti_json(ask: Ask, drive: Path) -> None:
    answer = ask(["groundtruth", "kitti", str(drive), "--json"])
    assert (answer.code, answer.err) == (0, "")
    report = json.loads(answer.out)
    assert report["folder"] == str(drive / "groundtruth0")
    assert (report["frames"], report["with_scan"], report["written"], report["with_flow"]) == (4, 2, 2, 2)
    assert report["static_points"] > 1000


def test_kitti_says_what_is_not_labelled(ask: Ask, drive: Path) -> None:
    first = ask(["groundtruth", "kitti", str(drive)])
    assert first.code == 0
    assert "4 frames, 2 with a scan: 2 written, 0 were there; 2 with flow" in first.out
    assert "2 frames have no labels" in first.out
    again = ask(["groundtruth", "kitti", str(drive)])
    assert "0 written, 2 were there" in again.out
    assert "points:" not in again.out


@pytest.mark.parametrize("command", ["euroc", "kitti"])
def test_other_layouts_are_refused(ask: Ask, tmp_path: Path, command: str) -> None:
    plain = write_plain(tmp_path / "plain")
    assert ask(["groundtruth", command, str(plain)]).is_refusal("[layout_unknown]")
    assert ask(["groundtruth", command, str(tmp_path / "nowhere")]).is_refusal("[directory_missing]")


def test_a_users_mistakes_are_one_line(ask: Ask, room: Path, tmp_path: Path) -> None:
    command = ["groundtruth", "euroc", str(room)]
    assert ask([*command, "--cloud", str(tmp_path / "none.ply")]).is_refusal("[point_cloud_missing]")
    assert ask([*command, "--trajectory", str(tmp_path / "none.csv")]).is_refusal("none.csv")
    (tmp_path / "file").write_text("")
    assert ask([*command, "--out", str(tmp_path / "file")]).is_refusal("file")
    assert ask(["groundtruth", "moon"]).is_refusal("moon")


def test_help_loads_no_torch() -> None:
    code = (
        "import sys; from viflow_anomaly.cli.main import run; run(['groundtruth', 'euroc', '--help']); "
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0
