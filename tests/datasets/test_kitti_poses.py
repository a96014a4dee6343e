"""KITTI's poses: OXTS places in closed form, the benchmark's files, other cameras, and the two against each other."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path

import numpy as np
import pytest
from worlds import REAL_DATA, car_world, write_kitti_odometry, write_kitti_raw, write_lines

from viflow_anomaly.datasets.kitti_files import oxts_places, parse_oxts
from viflow_anomaly.datasets.kitti_poses import find_poses, oxts_poses, oxts_trajectory, read_poses
from viflow_anomaly.datasets.kitti_sequence import dataset_of
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.geometry import so3_log

KARLSRUHE = (49.0, 8.4, 116.0)
METRES_PER_DEGREE = 6_378_137.0 * np.pi / 180


def real(relative: str) -> Path:
    path = REAL_DATA / "kitti" / relative
    if not path.exists():
        pytest.skip(f"no real data at {path}; set VIFLOW_REAL_DATA to the folder that holds it")
    return path


def places(*changes: tuple[float, ...]) -> np.ndarray:
    """Rows of latitude, longitude, altitude, roll, pitch, yaw: Karlsruhe plus each change."""
    return np.array([np.add((*KARLSRUHE, 0, 0, 0), change) for change in changes])


def test_the_world_is_east_north_up_in_metres() -> None:
    small = 1e-5
    poses = oxts_poses(places((0,) * 6, (0, small, 0, 0, 0, 0), (small, 0, 0, 0, 0, 0), (0, 0, 3, 0, 0, 0)))
    east = small * METRES_PER_DEGREE * np.cos(np.radians(49.0))
    np.testing.assert_allclose(poses[:, :3, 3], [(0, 0, 0), (east, 0, 0), (0, small * METRES_PER_DEGREE, 0), (0, 0, 3)],
                               atol=1e-6)  # fmt: skip


@pytest.mark.parametrize(
    ("angle", "axis", "where"),
    [
        ("yaw", (1, 0, 0), (0, 1, 0)),  # counter clockwise from east: the front points north
        ("pitch", (1, 0, 0), (0, 0, -1)),  # front down
        ("roll", (0, 1, 0), (0, 0, 1)),  # left side up
    ],
)
def test_angles_turn_as_the_data_format_says(angle: str, axis: tuple[int, ...], where: tuple[int, ...]) -> None:
    quarter = np.zeros(6)
    quarter[{"roll": 3, "pitch": 4, "yaw": 5}[angle]] = np.pi / 2
    R_world_imu = oxts_poses(places(tuple(quarter)))[0, :3, :3]
    np.testing.assert_allclose(R_world_imu @ axis, where, atol=1e-12)


def test_roll_is_innermost_and_yaw_outermost() -> None:
    R_world_imu = oxts_poses(places((0, 0, 0, np.pi / 2, 0, np.pi / 2)))[0, :3, :3]
    np.testing.assert_allclose(R_world_imu @ (0, 1, 0), (0, 0, 1), atol=1e-12)
    np.testing.assert_allclose(R_world_imu @ (1, 0, 0), (0, 1, 0), atol=1e-12)


def row(place: tuple[float, ...]) -> str:
    return " ".join(repr(float(value)) for value in [*place, *([0.0] * 24)])


def test_a_raw_drive_moves_forward_along_the_cameras_z(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path, car_world(frames=3))
    for k in range(3):  # to the east, 1 m a frame
        east = KARLSRUHE[1] + k / (METRES_PER_DEGREE * np.cos(np.radians(49.0)))
        write_lines(drive / "oxts" / "data" / f"{k:010d}.txt", [row((49.0, east, 116.0, 0.0, 0.0, 0.0))])
    recording = open_recording(drive)
    stamps = recording.frame_timestamps_ns.tolist()
    assert recording.trajectory is not None
    np.testing.assert_allclose(recording.trajectory.displacement_m(stamps[0], stamps[2]), (0, 0, 2), atol=1e-6)
    np.testing.assert_allclose(recording.trajectory.motion(stamps[0], stamps[1])[:3, 3], (0, 0, -1), atol=1e-6)


def test_no_trajectory_without_mounting(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    (drive.parent / "calib_imu_to_velo.txt").unlink()
    recording = open_recording(drive)
    assert recording.camera is not None
    assert recording.trajectory is None
    (drive.parent / "calib_cam_to_cam.txt").unlink()
    assert open_recording(drive).trajectory is None


def test_duplicate_and_disordered_records_are_no_poses() -> None:
    rows = [parse_oxts(Path("x"), 1, row((49.0, 8.4 + k, 0.0, 0.0, 0.0, 0.0))) for k in range(5)]
    stamps = np.array([10, 20, 20, 15, 30], dtype=np.int64)
    trajectory = oxts_trajectory(stamps, oxts_places(rows), np.eye(4), "oxts")
    assert trajectory is not None
    assert trajectory.timestamps_ns.tolist() == [10, 20, 30]
    degrees = trajectory.T_world_cam[:, 0, 3] / (METRES_PER_DEGREE * np.cos(np.radians(49.0)))
    np.testing.assert_allclose(degrees, (0, 1, 4))


# -- the odometry benchmark's files


def poses_text(count: int, step_m: float = 1.0) -> list[str]:
    return [f"1 0 0 0.5 0 1 0 0 0 0 1 {step_m * k!r}" for k in range(count)]


def sequence(tmp_path: Path, **options: str) -> Path:
    return write_kitti_odometry(tmp_path / "dataset" / "sequences" / "07", **options)


def test_poses_are_those_of_the_frames(tmp_path: Path) -> None:
    folder = sequence(tmp_path)
    assert open_recording(folder).trajectory is None
    write_lines(tmp_path / "dataset" / "poses" / "07.txt", poses_text(6))
    recording = open_recording(folder)
    assert recording.trajectory is not None
    for k, stamp in enumerate(recording.frame_timestamps_ns.tolist()):
        np.testing.assert_allclose(recording.trajectory.pose(stamp)[:3, 3], (0.5, 0, k))


def test_missing_images_do_not_move_the_poses(tmp_path: Path) -> None:
    folder = sequence(tmp_path)
    write_lines(tmp_path / "dataset" / "poses" / "07.txt", poses_text(6))
    (folder / "image_0" / "000002.png").unlink()
    recording = open_recording(folder)
    assert recording.trajectory is not None
    assert recording.trajectory.pose(int(recording.frame_timestamps_ns[2]))[2, 3] == 3.0


def test_other_cameras_are_shifted_along_x(tmp_path: Path) -> None:
    folder = sequence(tmp_path)
    shutil.copytree(folder / "image_0", folder / "image_1")
    lines = ["P0: 80 0 47.5 0 0 80 31.5 0 0 0 1 0", "P1: 80 0 47.5 -40 0 80 31.5 0 0 0 1 0"]
    write_lines(folder / "calib.txt", lines)
    write_lines(tmp_path / "dataset" / "poses" / "07.txt", ["0 0 1 0 0 1 0 0 -1 0 0 0"] * 6)  # a quarter turn about y
    left, right = (open_recording(folder, camera=name) for name in ("image_0", "image_1"))
    assert left.trajectory is not None
    assert right.trajectory is not None
    stamp = int(left.frame_timestamps_ns[0])
    np.testing.assert_allclose(left.trajectory.pose(stamp)[:3, 3], 0)
    # -P[0, 3] / P[0, 0] = 0.5 m to the right, which is the world's -z now.
    np.testing.assert_allclose(right.trajectory.pose(stamp)[:3, 3], (0, 0, -0.5))
    (folder / "calib.txt").unlink()
    assert open_recording(folder, camera="image_1").trajectory is None
    assert open_recording(folder, camera="image_0").trajectory is not None


def test_which_file_belongs_to_a_sequence(tmp_path: Path) -> None:
    folder = tmp_path / "sequences" / "01"
    folder.mkdir(parents=True)
    assert find_poses(folder) is None
    poses = tmp_path / "poses"
    write_lines(poses / "011.txt", poses_text(1))
    assert find_poses(folder) is None
    write_lines(poses / "01_first51.txt", poses_text(1))
    assert find_poses(folder) == poses / "01_first51.txt"
    write_lines(poses / "01_rest.txt", poses_text(1))
    with pytest.raises(DatasetError, match=r"01_first51\.txt, 01_rest\.txt") as caught:
        find_poses(folder)
    assert caught.value.code == "poses_ambiguous"
    write_lines(poses / "01.txt", poses_text(1))
    assert find_poses(folder) == poses / "01.txt"


def test_a_sequence_at_the_root_of_a_file_system() -> None:
    assert dataset_of(Path("/data/sequences/00")) == Path("/data").resolve()
    assert dataset_of(Path("/00")) == dataset_of(Path("/sequences/00")) == Path("/").resolve()
    assert find_poses(Path("/00")) is None


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1", "line 2: expected 12 numbers, found 11"),
        ("1 0 0 0 0 1 0 0 0 0 1 x", "line 2: expected finite numbers, found 'x'"),
        ("1 0 0 0 0 1 0 0 0 0 1 inf", "line 2: expected finite numbers"),
        ("2 0 0 0 0 1 0 0 0 0 1 0", "line 2: expected a rotation"),
        ("-1 0 0 0 0 1 0 0 0 0 1 0", "line 2: expected a rotation"),
    ],
)
def test_poses_malformed(line: str, problem: str, tmp_path: Path) -> None:
    write_lines(tmp_path / "07.txt", [poses_text(1)[0], line])
    with pytest.raises(DatasetError, match=problem) as caught:
        read_poses(tmp_path / "07.txt", 2)
    assert caught.value.code == "poses_malformed"


def test_another_number_of_poses(tmp_path: Path) -> None:
    folder = sequence(tmp_path)
    write_lines(tmp_path / "dataset" / "poses" / "07.txt", poses_text(5))
    recording = open_recording(folder)
    with pytest.raises(DatasetError, match="a pose for each of 6 frames, found 5") as caught:
        _ = recording.trajectory
    assert caught.value.code == "poses_malformed"


# -- real recordings


@pytest.mark.parametrize("drive", ["0005", "0027", "0011"])
def test_raw_drives_move_as_fast_as_their_speed_says(drive: str) -> None:
    recording = open_recording(real(f"2011_09_26/2011_09_26_drive_{drive}_sync"))
    assert recording.motor_names == ("forward_speed_m_s",)
    speeds = np.array([recording.motor_command(k) for k in range(len(recording))])[:, 0]
    moved, seconds = displacements(recording)
    difference = moved[:, 2] / seconds - (speeds[1:] + speeds[:-1]) / 2
    assert np.abs(difference).mean() < 0.2  # GPS places jump by a few centimetres, 0.1 s apart
    assert (
        abs(moved[:, 2].sum() / ((speeds[1:] + speeds[:-1]) / 2 @ seconds) - 1) < 0.05
    )  # in drive 0005 GPS drifts by 2 m
    assert np.abs(moved[:, :2]).mean() < 0.05 * np.abs(moved[:, 2]).mean()


@pytest.mark.parametrize(("sequence", "first"), [("01", 0), ("06", 15)])  # 06 has no measured OXTS before
def test_odometry_poses_agree_with_oxts(sequence: str, first: int) -> None:
    folder = real(f"odometry/sequences/{sequence}")
    recording = open_recording(folder)
    assert recording.trajectory is not None
    assert recording.camera is not None
    file = next(iter(folder.glob("oxts_first*.txt")))
    rows = [parse_oxts(file, k, line) for k, line in enumerate(file.read_text().splitlines(), start=1)]
    stamps = recording.frame_timestamps_ns
    by_oxts = oxts_trajectory(stamps, oxts_places(rows), recording.camera.T_cam_imu, str(file))
    assert by_oxts is not None
    for source_ns, target_ns in zip(stamps[first:-5].tolist(), stamps[first + 5 :].tolist(), strict=True):
        true, found = (one.displacement_m(source_ns, target_ns) for one in (recording.trajectory, by_oxts))
        assert np.linalg.norm(true) > 4.0
        np.testing.assert_allclose(found, true, atol=0.03 * np.linalg.norm(true))
        turns = (so3_log(one.motion(source_ns, target_ns)[:3, :3]) for one in (recording.trajectory, by_oxts))
        np.testing.assert_allclose(*turns, atol=5e-3)


@pytest.mark.parametrize(("sequence", "first"), [("01", 0), ("06", 15)])
def test_odometry_moves_as_fast_as_its_speed_says(sequence: str, first: int) -> None:
    recording = open_recording(real(f"odometry/sequences/{sequence}"))
    moved, seconds = displacements(recording)
    speeds = np.array([recording.motor_command(k) for k in range(len(recording))])[:-1, 0]
    distance, expected = moved[first:, 2].sum(), speeds[first:] @ seconds[first:]
    assert distance == pytest.approx(expected, rel=0.02)


def displacements(recording: object) -> tuple[np.ndarray, np.ndarray]:
    """[F - 1, 3] metres from each frame to the next, and [F - 1] seconds."""
    stamps, trajectory = recording.frame_timestamps_ns, recording.trajectory  # type: ignore[attr-defined]
    moved = [trajectory.displacement_m(a, b) for a, b in itertools.pairwise(stamps.tolist())]
    return np.array(moved), np.diff(stamps) * 1e-9
