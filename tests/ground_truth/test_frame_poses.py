"""Poses for frames: which are near enough in time, and the files they are read from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from worlds import make_world, write_euroc, write_lines

from viflow_anomaly.datasets.euroc import read_camera_on_body
from viflow_anomaly.datasets.trajectory import Trajectory, rotations_of
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.geometry import so3_exp
from viflow_anomaly.ground_truth.frame_poses import poses_of_frames, quaternion_of, read_trajectory_file

MS = 1_000_000
HALF = float(np.sqrt(0.5))


def along_x(stamps_ms: list[int]) -> Trajectory:
    """A metre a second."""
    poses = np.tile(np.eye(4), (len(stamps_ms), 1, 1))
    poses[:, 0, 3] = np.array(stamps_ms) / 1000
    return Trajectory(np.array(stamps_ms, dtype=np.int64) * MS, poses, "test")


def test_a_pose_within_a_millisecond_is_no_excuse_not_to_interpolate() -> None:
    found = poses_of_frames(along_x([100, 105, 115]), [105 * MS, 105 * MS + 256_000, 114 * MS + 500_000])
    np.testing.assert_allclose([pose[0, 3] for pose in found.values()], [0.105, 0.105256, 0.1145], rtol=0, atol=1e-12)


def test_where_a_neighbour_is_missing_the_nearest_pose_within_a_millisecond_is_taken() -> None:
    found = poses_of_frames(along_x([100, 150, 200]), [99 * MS, 100 * MS + 256, 151 * MS, 200 * MS + MS])
    assert [pose[0, 3] for pose in found.values()] == [0.1, 0.1, 0.15, 0.2]


def test_between_poses_ten_milliseconds_apart_it_is_interpolated() -> None:
    found = poses_of_frames(along_x([100, 105, 115]), [103 * MS, 112 * MS])
    np.testing.assert_allclose([pose[0, 3] for pose in found.values()], [0.103, 0.112])


@pytest.mark.parametrize("stamp", [98 * MS, 120 * MS, 152 * MS])
def test_frames_without_a_pose_so_close_have_none(stamp: int) -> None:
    assert poses_of_frames(along_x([100, 150]), [stamp]) == {}


@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (0.3, -0.2, 1.0), (0.0, 3.1, 0.1), (1e-9, 0, 0)])
def test_quaternions_give_their_rotation_back(vector: tuple[float, float, float]) -> None:
    rotation = so3_exp(np.array(vector))
    np.testing.assert_allclose(rotations_of(quaternion_of(rotation)[None])[0], rotation, atol=1e-12)


@pytest.fixture
def cam_yaml(tmp_path: Path) -> Path:
    return write_euroc(tmp_path, make_world(frames=2)) / "mav0" / "cam0" / "sensor.yaml"


def body_pose() -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """At (1, 2, 3), turned a quarter to the left about z."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], (1, 2, 3)
    return pose


@pytest.mark.parametrize(
    "lines",
    [
        ["#time(ns),px,py,pz,qw,qx,qy,qz", f"1500000000000000256,1,2,3,{HALF},0,0,{HALF}"],
        [f"1500000000000000256,1,2,3,{HALF},0,0,{HALF},9,9,9,9,9,9,9,9,9"],
        ["# timestamp(s) tx ty tz qx qy qz qw", f"1500000000.000000256 1 2 3 0 0 {HALF} {HALF}"],
        [f"1.500000000000000256e9 1 2 3 0 0 {-HALF} {-HALF}"],
    ],
    ids=["pose csv", "state csv", "TUM", "TUM with exponent"],
)
def test_every_format_gives_the_same_camera(tmp_path: Path, cam_yaml: Path, lines: list[str]) -> None:
    write_lines(tmp_path / "poses.txt", lines)
    trajectory = read_trajectory_file(tmp_path / "poses.txt", cam_yaml)
    assert trajectory.timestamps_ns.tolist() == [1_500_000_000_000_000_256]
    mounting = read_camera_on_body(cam_yaml)
    assert mounting is not None
    np.testing.assert_allclose(trajectory.T_world_cam[0], body_pose() @ mounting.T_body_cam, atol=1e-12)


@pytest.mark.parametrize("line", ["1500000000000000256,1,2,3,1,0,0,0", "1500000000.000000256 1 2 3 0 0 0 1"])
def test_stamps_of_the_body_become_the_cameras(tmp_path: Path, cam_yaml: Path, line: str) -> None:
    """t_imu = t_cam + shift."""
    write_lines(cam_yaml, [cam_yaml.read_text(), "timeshift_cam_imu: -0.0125"])
    write_lines(tmp_path / "poses.txt", [line])
    trajectory = read_trajectory_file(tmp_path / "poses.txt", cam_yaml)
    assert trajectory.timestamps_ns.tolist() == [1_500_000_000_012_500_256]


@pytest.mark.parametrize(
    "second", ["2 0 0 0 0 0 0", "two 0 0 0 0 0 0 1", "2 0 0 0 0 0 0 x", "1 0 0 0 0 0 0 1", "2 0 0 0 0 0 0 0",
               "9999999999 0 0 0 0 0 0 1", "-2 0 0 0 0 0 0 1"]
)  # fmt: skip
def test_malformed_tum_lines_are_named(tmp_path: Path, cam_yaml: Path, second: str) -> None:
    write_lines(tmp_path / "poses.txt", ["# t", "1 0 0 0 0 0 0 1", second])
    with pytest.raises(DatasetError, match="line 3") as raised:
        read_trajectory_file(tmp_path / "poses.txt", cam_yaml)
    assert raised.value.code == "csv_malformed"


@pytest.mark.parametrize("line", ["1,0,0,0,1,0,0,0", "1 0 0 0 0 0 0 1"])
def test_without_the_cameras_mounting_there_is_no_trajectory(tmp_path: Path, line: str) -> None:
    write_lines(tmp_path / "poses.txt", [line])
    with pytest.raises(DatasetError, match="T_BS") as raised:
        read_trajectory_file(tmp_path / "poses.txt", tmp_path / "sensor.yaml")
    assert raised.value.code == "trajectory_missing"
