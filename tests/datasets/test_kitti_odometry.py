"""KITTI odometry: where the stamps come from, how IMU samples are spread, which calibration is read."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from worlds import car_world, oxts_text, write_kitti_odometry, write_lines

from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.errors import DatasetError, InvalidInputError


def expect(sequence: Path, code: str, where: str = "", **options: str) -> str:
    with pytest.raises(DatasetError) as caught:
        open_recording(sequence, format="kitti_odometry", **options)  # type: ignore[arg-type]
    assert caught.value.code == code
    assert where in caught.value.message
    return caught.value.message


def edit(path: Path, number: int, text: str | None) -> None:
    """Replace one line, counted from 1, or drop it."""
    lines = path.read_text().splitlines()
    lines[number - 1 : number] = [] if text is None else [text]
    write_lines(path, lines)


def test_samples_are_spread_evenly_between_uneven_frames(tmp_path: Path) -> None:
    world = car_world(frames=3)
    sequence = write_kitti_odometry(tmp_path, world)
    stamps = ["2011-10-03 14:34:18.100000000", "2011-10-03 14:34:18.200000000", "2011-10-03 14:34:18.310000007"]
    write_lines(sequence / "oxts_timestamps.txt", stamps)
    recording = open_recording(sequence)
    relative = recording.imu.timestamps_ns - recording.frame_timestamps_ns[0]
    assert relative[:11].tolist() == [k * 10_000_000 for k in range(11)]
    assert relative[10:].tolist() == [100_000_000 + k * 110_000_007 // 10 for k in range(11)]
    assert relative[10] == recording.frame_timestamps_ns[1] - recording.frame_timestamps_ns[0]


def test_per_frame_columns(tmp_path: Path) -> None:
    world = car_world()
    imu = open_recording(write_kitti_odometry(tmp_path, world)).imu
    inside = (world.imu.timestamps_ns >= world.frame_timestamps_ns[0]) & (
        world.imu.timestamps_ns <= world.frame_timestamps_ns[-1]
    )
    assert world.imu.accel_m_s2 is not None
    np.testing.assert_array_equal(imu.gyro_rad_s, world.imu.gyro_rad_s[inside])
    np.testing.assert_array_equal(imu.accel_m_s2, world.imu.accel_m_s2[inside])


def test_any_rate_in_the_files_name(tmp_path: Path) -> None:
    sequence = write_kitti_odometry(tmp_path, car_world(frames=3))
    header = "sample,ax,ay,az,wx,wy,wz"
    (sequence / "imu_10perframe.csv").unlink()
    write_lines(sequence / "imu_2perframe.csv", [header, *(f"{k},0,0,9.8,0,0,{k}" for k in range(5))])
    imu = open_recording(sequence).imu
    assert imu.gyro_rad_s[:, 2].tolist() == [0, 1, 2, 3, 4]
    assert np.diff(imu.timestamps_ns).tolist() == [50_000_000] * 4


@pytest.mark.parametrize("change", ["drop", "add"])
def test_another_number_of_samples(change: str, tmp_path: Path) -> None:
    path = write_kitti_odometry(tmp_path) / "imu_10perframe.csv"
    if change == "drop":
        edit(path, 52, None)
    else:
        write_lines(path, [*path.read_text().splitlines(), "51,0,0,0,0,0,0"])
    expect(tmp_path, "csv_malformed", "expected 51 samples (10 for each of 5 frame intervals")


def test_a_sample_left_out(tmp_path: Path) -> None:
    path = write_kitti_odometry(tmp_path) / "imu_10perframe.csv"
    edit(path, 5, None)
    expect(tmp_path, "csv_malformed", "imu_10perframe.csv, line 5: expected sample 3, found 4")


def test_missing_images_do_not_move_the_samples(tmp_path: Path) -> None:
    sequence = write_kitti_odometry(tmp_path)
    before = open_recording(sequence)
    (sequence / "image_0" / "000002.png").unlink()
    after = open_recording(sequence)
    np.testing.assert_array_equal(after.imu.timestamps_ns, before.imu.timestamps_ns)
    assert after.frame_timestamps_ns.tolist() == np.delete(before.frame_timestamps_ns, 2).tolist()


def test_times_are_seconds_since_the_first_frame(tmp_path: Path) -> None:
    sequence = write_kitti_odometry(tmp_path, imu="plain", times="times")
    lines = ["0.000000e+00", "1.036224e-01", "2.072e-01", "0.3108", "4.1e-1", "1.0362245"]
    write_lines(sequence / "times.txt", lines)
    expected = [0, 103_622_400, 207_200_000, 310_800_000, 410_000_000, 1_036_224_500]
    assert open_recording(sequence).frame_timestamps_ns.tolist() == expected


@pytest.mark.parametrize("text", ["-1.0", "nan", "x", "1e99", "9e9 1", "9000000001"])
def test_times_malformed(text: str, tmp_path: Path) -> None:
    sequence = write_kitti_odometry(tmp_path, imu="plain", times="times")
    edit(sequence / "times.txt", 3, text)
    expect(sequence, "timestamps_malformed", "times.txt, line 3: expected seconds")


def test_times_win_over_oxts_stamps(tmp_path: Path) -> None:
    sequence = write_kitti_odometry(tmp_path)
    write_lines(sequence / "times.txt", [f"{k}.5" for k in range(6)])
    assert open_recording(sequence).frame_timestamps_ns[0] == 500_000_000


def test_frames_out_of_order(tmp_path: Path) -> None:
    sequence = write_kitti_odometry(tmp_path, imu="plain", times="times")
    edit(sequence / "times.txt", 3, "0.05")
    expect(sequence, "timestamps_not_increasing", "times.txt, line 3: ")


@pytest.mark.parametrize("imu", ["plain", "perframe"])
def test_a_repeated_stamp_of_a_frame_without_image(imu: str, tmp_path: Path) -> None:
    """The poses belong to all frames, so that the trajectory would need it."""
    sequence = write_kitti_odometry(tmp_path, imu=imu, times="times")
    edit(sequence / "times.txt", 3, (sequence / "times.txt").read_text().splitlines()[1])
    (sequence / "image_0" / "000002.png").unlink()
    expect(sequence, "timestamps_not_increasing", "times.txt, line 3: ")


def test_more_images_than_stamps(tmp_path: Path) -> None:
    sequence = write_kitti_odometry(tmp_path, imu="plain", times="times")
    edit(sequence / "times.txt", 6, None)
    expect(sequence, "timestamps_missing", "times.txt, line 6: ")


def test_no_images(tmp_path: Path) -> None:
    sequence = write_kitti_odometry(tmp_path)
    shutil.rmtree(sequence / "image_0")
    (sequence / "image_0").mkdir()
    expect(sequence, "no_frames", "image_0")


def test_cameras(tmp_path: Path) -> None:
    sequence = write_kitti_odometry(tmp_path)
    shutil.copytree(sequence / "image_0", sequence / "image_2")
    assert "image_0" in str(open_recording(sequence).frame_path(0))
    assert "image_2" in str(open_recording(sequence, camera="image_2").frame_path(0))
    assert "image_0, image_2" in expect(sequence, "camera_unknown", camera="image_02")
    shutil.rmtree(sequence / "image_0")
    assert "image_2" in str(open_recording(sequence).frame_path(0))


def test_speed_from_the_oxts_file(tmp_path: Path) -> None:
    sequence = write_kitti_odometry(tmp_path)
    rows = [oxts_text(np.zeros(3), np.zeros(3), 10.0 + k) for k in range(6)]
    write_lines(sequence / "oxts_first6.txt", rows)
    speeds = [open_recording(sequence).motor_command(k) for k in range(6)]
    assert [speed.tolist() for speed in speeds if speed is not None] == [[10.0 + k] for k in range(6)]
    write_lines(sequence / "oxts_first6.txt", rows[:5])
    expect(sequence, "oxts_malformed", "oxts_first6.txt, line 6: ")


# -- calibration


def test_unnamed_lines_are_P0_P1(tmp_path: Path) -> None:
    sequence = write_kitti_odometry(tmp_path)
    (sequence / "calib.txt").unlink()
    write_lines(sequence / "calib_x.txt", ["70 0 40 0 0 71 30 0 0 0 1 0", "70 0 40 -35 0 71 30 0 0 0 1 0"])
    shutil.copytree(sequence / "image_0", sequence / "image_1")
    left, right = (open_recording(sequence, camera=name).camera for name in ("image_0", "image_1"))
    assert left is not None
    assert right is not None
    assert left.T_cam_imu is not None
    assert right.T_cam_imu is not None
    assert (left.fx, left.fy, left.cx, left.cy) == (70, 71, 40, 30)
    np.testing.assert_allclose(right.T_cam_imu[:3, 3] - left.T_cam_imu[:3, 3], (-0.5, 0, 0), atol=1e-12)


def test_nominal_mounting_turns_front_left_top_to_camera_axes(tmp_path: Path) -> None:
    camera = open_recording(write_kitti_odometry(tmp_path)).camera
    assert camera is not None
    assert camera.R_cam_imu is not None
    front, left, top = np.eye(3)
    np.testing.assert_array_equal(camera.R_cam_imu @ front, (0, 0, 1))
    np.testing.assert_array_equal(camera.R_cam_imu @ left, (-1, 0, 0))
    np.testing.assert_array_equal(camera.R_cam_imu @ top, (0, -1, 0))


def test_exact_mounting_where_the_files_are(tmp_path: Path) -> None:
    sequence = write_kitti_odometry(tmp_path)
    with (sequence / "calib.txt").open("a") as file:
        file.write("Tr: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3\n")
    nominal = open_recording(sequence).camera
    write_lines(sequence / "calib_imu_to_velo.txt", ["R: 1 0 0 0 1 0 0 0 1", "T: 1 2 3"])
    exact = open_recording(sequence).camera
    assert nominal is not None
    assert exact is not None
    assert nominal.T_cam_imu is not None
    assert exact.T_cam_imu is not None
    assert nominal.T_cam_imu[0, 3] == -0.32
    np.testing.assert_allclose(exact.T_cam_imu[:3, 3], (-1.9, -2.8, 1.3))


def test_a_lone_imu_to_velo_is_no_camera_calibration(tmp_path: Path) -> None:
    sequence = write_kitti_odometry(tmp_path)
    (sequence / "calib.txt").rename(sequence / "calib_imu_to_velo.txt")
    assert open_recording(sequence).camera is None


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("P1: 1 0 0 0 0 1 0 0 0 0 1 0", "expected the key P0"),
        ("P0: 1 0 0", "line 1: P0: expected 12 numbers"),
        ("P0: -80 0 40 0 0 80 30 0 0 0 1 0", "fx"),
        ("P0: 80 0 600 0 0 80 30 0 0 0 1 0", "have they been resized"),
        ("P0: 80 0 40 0 0 80 -1 0 0 0 1 0", "have they been resized"),
        ("P0: 80 0 -1 0 0 80 30 0 0 0 1 0", "have they been resized"),
        ("P0: 80 0 40 0 0 80 64 0 0 0 1 0", "have they been resized"),
    ],
)
def test_calibration_malformed(text: str, problem: str, tmp_path: Path) -> None:
    sequence = write_kitti_odometry(tmp_path)
    write_lines(sequence / "calib.txt", [text])
    expect(sequence, "calibration_malformed", problem)


def test_a_scaled_Tr_is_refused(tmp_path: Path) -> None:
    sequence = write_kitti_odometry(tmp_path)
    with (sequence / "calib.txt").open("a") as file:
        file.write("Tr: 2 0 0 0 0 2 0 0 0 0 2 0\n")
    write_lines(sequence / "calib_imu_to_velo.txt", ["R: 1 0 0 0 1 0 0 0 1", "T: 1 2 3"])
    expect(sequence, "calibration_malformed", "T_cam_imu")


def test_only_broken_images(tmp_path: Path) -> None:
    sequence = write_kitti_odometry(tmp_path)
    for image in (sequence / "image_0").iterdir():
        image.write_bytes(b"")
    with pytest.raises(InvalidInputError) as caught:
        open_recording(sequence)
    assert caught.value.code == "image_empty"


@pytest.mark.parametrize("name", ["imu_0perframe.csv", "imu_perframe.csv", "imu_xperframe.csv"])
def test_a_file_without_rate_is_no_imu_file(name: str, tmp_path: Path) -> None:
    sequence = write_kitti_odometry(tmp_path)
    (sequence / "imu_10perframe.csv").rename(sequence / name)
    expect(sequence, "layout_unknown", "imu_<n>perframe")
