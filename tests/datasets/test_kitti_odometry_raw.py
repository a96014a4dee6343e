"""Odometry sequences as published: which drive, which stamps, which IMU, and what is said when something is missing."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from kitti_worlds import DRIVE, frame_stamps, imu_stamps, write_odometry, write_raw_drive
from worlds import write_lines, write_plain

from viflow_anomaly.config import MotionWindowConfig
from viflow_anomaly.datasets import kitti_drives
from viflow_anomaly.datasets.kitti_drives import ODOMETRY_DRIVES, DriveFrames
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.registry import open_recording, recognise
from viflow_anomaly.datasets.usable_pairs import usable_pairs
from viflow_anomaly.errors import DatasetError

PAPER = MotionWindowConfig(layout="paper_kitti", axes="sensor")


@pytest.fixture(autouse=True)
def _short_sequence(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sequence 04 is frames 2 to 7 of its drive here."""
    monkeypatch.setitem(kitti_drives.ODOMETRY_DRIVES, "04", DriveFrames(DRIVE, 2, 7))


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    write_raw_drive(tmp_path / "raw_data")
    return write_odometry(tmp_path / "dataset")


def expect(folder: Path, code: str, where: str) -> str:
    with pytest.raises(DatasetError) as caught:
        open_recording(folder)
    assert caught.value.code == code
    assert where in caught.value.message
    return caught.value.message


def test_table_is_the_development_kits() -> None:
    # Frames of the published sequences, that is lines of their poses.
    counts = [4541, 1101, 4661, 801, None, 2761, 1101, 1101, 4071, 1591, 1201]
    assert list(ODOMETRY_DRIVES) == [f"{k:02d}" for k in range(11)]
    for frames, count in zip(ODOMETRY_DRIVES.values(), counts, strict=True):
        assert count in (None, frames.last - frames.first + 1)
    assert ODOMETRY_DRIVES["08"] == ("2011_09_30_drive_0028", 1100, 5170)
    assert ODOMETRY_DRIVES["00"].drive == "2011_10_03_drive_0027"


def test_is_recognised_by_its_name_and_content(sequence: Path, tmp_path: Path) -> None:
    assert recognise(sequence) == "kitti_odometry_raw"
    recording = open_recording(sequence)
    assert (recording.format, recording.name, len(recording)) == ("kitti_odometry_raw", "04", 6)
    with pytest.raises(DatasetError, match="layout"):
        recognise(sequence.rename(tmp_path / "renamed"))


def test_an_imu_file_is_read_where_there_is_one(sequence: Path, tmp_path: Path) -> None:
    shutil.copy(write_plain(tmp_path / "plain") / "imu.csv", sequence)
    assert recognise(sequence) == "kitti_odometry"
    assert open_recording(sequence, format="kitti_odometry_raw").format == "kitti_odometry_raw"


def test_frames_are_those_of_the_sync_drive(sequence: Path) -> None:
    recording = open_recording(sequence)
    found = recording.frame_timestamps_ns - frame_stamps(8)[2:]
    assert found[0] == 0
    assert np.abs(found).max() <= 500  # times.txt has seven digits


def test_imu_is_the_extract_drives(sequence: Path) -> None:
    recording = open_recording(sequence)
    # The whole drive is within a second of the sequence.
    np.testing.assert_array_equal(recording.imu.timestamps_ns, imu_stamps(9))
    assert recording.motor_names == ("forward_speed_m_s",)
    for k in (0, 5):
        nearest = int(np.argmin(np.abs(imu_stamps(9) - recording.frame_timestamps_ns[k])))
        np.testing.assert_allclose(recording.motor_command(k), [nearest / 10])


def test_records_far_from_the_sequence_are_not_read(sequence: Path, tmp_path: Path) -> None:
    shutil.rmtree(tmp_path / "raw_data")
    day = write_raw_drive(tmp_path / "raw_data", frames=30)
    (day / f"{DRIVE}_extract/oxts/data/0000000340.txt").write_text("broken")
    imu = open_recording(sequence).imu
    last = frame_stamps(8)[-1]
    assert last + 980_000_000 < imu.timestamps_ns[-1] <= last + 1_000_000_000


@pytest.mark.parametrize("image_stamps", [True, False])
def test_every_window_of_the_paper_is_there(image_stamps: bool, tmp_path: Path) -> None:
    write_raw_drive(tmp_path / "dataset" / "raw_data", image_stamps=image_stamps)
    pairs = RecordingPairs(open_recording(write_odometry(tmp_path / "dataset")))
    usable = usable_pairs(pairs, PAPER)
    assert usable.indices == [0, 1, 2, 3, 4]
    assert usable.excluded == {}


def test_mounting_is_that_of_Tr_and_the_day(sequence: Path, tmp_path: Path) -> None:
    exact = open_recording(sequence).camera
    assert exact is not None
    assert exact.T_cam_imu is not None
    np.testing.assert_allclose(exact.T_cam_imu[:3, 3], (-1.9, -2.8, 1.3))
    (tmp_path / "raw_data" / "2011_09_30" / "calib_imu_to_velo.txt").unlink()
    nominal = open_recording(sequence).camera
    assert nominal is not None
    assert nominal.T_cam_imu is not None
    assert nominal.T_cam_imu[0, 3] == -0.32


def test_poses(sequence: Path, tmp_path: Path) -> None:
    assert open_recording(sequence).trajectory is None
    poses = tmp_path / "dataset" / "poses" / "04.txt"
    write_lines(poses, [f"1 0 0 0 0 1 0 0 0 0 1 {k}" for k in range(6)])
    shutil.copytree(sequence / "image_0", sequence / "image_1")
    recording = open_recording(sequence, camera="image_1")
    assert recording.trajectory is not None
    np.testing.assert_allclose(recording.trajectory.pose(int(recording.frame_timestamps_ns[3]))[:3, 3], (0.5, 0, 3))
    write_lines(poses, ["1 0 0 0 0 1 0 0 0 0 1 0"] * 5)
    short = open_recording(sequence)
    with pytest.raises(DatasetError, match="a pose for each of 6 frames, found 5") as caught:
        _ = short.trajectory
    assert caught.value.code == "poses_malformed"
    (sequence / "calib.txt").unlink()
    assert open_recording(sequence, camera="image_1").trajectory is None


# -- what can be missing or contradict itself


def test_no_raw_data_at_all(tmp_path: Path) -> None:
    folder = write_odometry(tmp_path / "dataset")
    message = expect(folder, "kitti_raw_missing", str(tmp_path / "dataset" / "raw_data"))
    assert str(tmp_path / "raw_data") in message


@pytest.mark.parametrize(
    "missing", ["_sync", "_extract", "_extract/oxts/timestamps.txt", "_extract/oxts/data", "_sync/image_00+oxts"]
)
def test_a_drive_that_is_not_there(missing: str, sequence: Path, tmp_path: Path) -> None:
    day = tmp_path / "raw_data" / "2011_09_30"
    kind = missing.partition("/")[0]
    parts = ["_sync/image_00", "_sync/oxts"] if "+" in missing else [missing]
    for part in parts:
        path = day / f"{DRIVE}{part}"
        path.unlink() if path.is_file() else shutil.rmtree(path)
    message = expect(sequence, "kitti_raw_missing", f"{DRIVE}{kind}: expected ")
    assert ("no such folder" in message) == ("/" not in missing)


@pytest.mark.parametrize("name", ["11", "21"])
def test_sequences_without_published_drive(name: str, sequence: Path) -> None:
    expect(sequence.rename(sequence.with_name(name)), "kitti_raw_missing", f"sequence {name}: ")


def test_another_number_of_times(sequence: Path) -> None:
    path = sequence / "times.txt"
    lines = path.read_text().splitlines()
    write_lines(path, lines[:5])
    expect(sequence, "kitti_raw_mismatch", f"expected 6 times, for the frames 2 to 7 of {DRIVE}, found 5")
    write_lines(path, [*lines[:5], "", lines[5]])
    expect(sequence, "kitti_raw_mismatch", "expected 6 times")


def test_other_times_than_the_drives(sequence: Path) -> None:
    path = sequence / "times.txt"
    lines = path.read_text().splitlines()
    write_lines(path, [*lines[:4], "0.51", "0.62"])
    expect(sequence, "kitti_raw_mismatch", "times.txt, line 5: expected the time of frame 6")


def test_frames_beyond_the_drive(sequence: Path, tmp_path: Path) -> None:
    path = tmp_path / "raw_data" / "2011_09_30" / f"{DRIVE}_sync" / "image_00" / "timestamps.txt"
    write_lines(path, path.read_text().splitlines()[:7])
    expect(sequence, "timestamps_missing", "image_00/timestamps.txt, line 8: expected the stamp of record 7")


def test_frames_of_one_time(sequence: Path, tmp_path: Path) -> None:
    for path, number in (
        (sequence / "times.txt", 3),
        (tmp_path / "raw_data" / "2011_09_30" / f"{DRIVE}_sync" / "image_00" / "timestamps.txt", 5),
    ):
        lines = path.read_text().splitlines()
        lines[number - 1] = lines[number - 2]
        write_lines(path, lines)
    expect(sequence, "timestamps_not_increasing", "times.txt, line 3: ")
    (sequence / "image_0" / "000002.png").unlink()
    expect(sequence, "timestamps_not_increasing", "times.txt, line 3: ")


def test_an_imu_of_another_time(sequence: Path, tmp_path: Path) -> None:
    shutil.rmtree(tmp_path / "raw_data")
    write_raw_drive(tmp_path / "raw_data", stamps=imu_stamps(9) + 10**12)
    expect(sequence, "imu_not_covering", f"{DRIVE}_extract/oxts: expected records between")


def test_cameras_and_images(sequence: Path) -> None:
    with pytest.raises(DatasetError, match="expected one of image_0, found camera 'image_02'") as caught:
        open_recording(sequence, camera="image_02")
    assert caught.value.code == "camera_unknown"
    shutil.rmtree(sequence / "image_0")
    (sequence / "image_0").mkdir()
    expect(sequence, "no_frames", "image_0")
