"""KITTI raw: exact stamps, OXTS columns, rectified, reduced and unrectified calibration."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds import car_world, stamp_text, textured_image, write_kitti_raw, write_lines, write_png

from viflow_anomaly.datasets.kitti_files import parse_oxts, parse_stamp_ns
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.errors import DatasetError, InvalidInputError


def expect(drive: Path, code: str, where: str = "", **options: str) -> str:
    with pytest.raises(DatasetError) as caught:
        open_recording(drive, format="kitti_raw", **options)  # type: ignore[arg-type]
    assert caught.value.code == code
    assert where in caught.value.message
    return caught.value.message


def replace_line(path: Path, number: int, text: str) -> None:
    lines = path.read_text().splitlines()
    lines[number - 1] = text
    write_lines(path, lines)


# -- stamps


def test_stamp_of_a_known_moment() -> None:
    assert parse_stamp_ns("1970-01-02 00:00:01.000000001") == 86_401_000_000_001
    assert parse_stamp_ns("2011-09-26 13:04:32.349659964") == 1_317_042_272_349_659_964
    assert parse_stamp_ns("2011-09-26 13:04:32.35") == 1_317_042_272_350_000_000


@given(st.integers(0, 4_000_000_000 * 10**9))
def test_stamps_keep_every_nanosecond(stamp: int) -> None:
    assert parse_stamp_ns(stamp_text(stamp)) == stamp


@pytest.mark.parametrize(
    "text", ["", "1317042272.35", "2011-09-26T13:04:32.35", "2011-13-26 13:04:32.35", "2011-09-26 13:04:32.1234567890"]
)
def test_no_stamp(text: str) -> None:
    assert parse_stamp_ns(text) is None


def test_malformed_stamp_names_its_line(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    replace_line(drive / "oxts" / "timestamps.txt", 3, "2011-09-26")
    expect(drive, "timestamps_malformed", "timestamps.txt, line 3: ")


@pytest.mark.parametrize(("kind", "file"), [("sync", "oxts"), ("extract", "oxts"), ("extract", "image_02")])
def test_a_record_without_stamp(kind: str, file: str, tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path, kind=kind)
    replace_line(drive / file / "timestamps.txt", 4, "")
    expect(drive, "timestamps_missing", f"{file}/timestamps.txt, line 4: ")


def test_duplicate_and_disordered_frame_stamps(tmp_path: Path) -> None:
    for name, source in (("duplicate", 2), ("disorder", 1)):
        drive = write_kitti_raw(tmp_path / name, kind="extract")
        path = drive / "image_02" / "timestamps.txt"
        replace_line(path, 3, path.read_text().splitlines()[source - 1])
        expect(drive, "timestamps_not_increasing", "image_02/timestamps.txt, line 3: ")


# -- pairing images with stamps


def test_sync_takes_the_oxts_stamps_without_image_stamps(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    recording = open_recording(drive)
    np.testing.assert_array_equal(recording.frame_timestamps_ns, recording.imu.timestamps_ns)


def test_sync_prefers_the_image_stamps(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    stamps = car_world().frame_timestamps_ns + 1_234_567
    write_lines(drive / "image_02" / "timestamps.txt", [stamp_text(stamp) for stamp in stamps])
    np.testing.assert_array_equal(open_recording(drive).frame_timestamps_ns, stamps)


def test_a_missing_image_keeps_the_others_on_their_lines(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    stamps = open_recording(drive).frame_timestamps_ns
    (drive / "image_02" / "data" / "0000000002.png").unlink()
    recording = open_recording(drive)
    assert recording.frame_timestamps_ns.tolist() == np.delete(stamps, 2).tolist()
    assert recording.frame_path(2).name == "0000000003.png"


def test_an_image_beyond_the_stamps(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    write_png(drive / "image_02" / "data" / "0000000009.png", textured_image(96, 64))
    expect(drive, "timestamps_missing", "line 10: ")


def test_extract_without_image_stamps_is_refused(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path, kind="extract")
    (drive / "image_02" / "timestamps.txt").unlink()
    expect(drive, "timestamps_missing", "image_02/timestamps.txt")


def test_extract_reads_every_oxts_record(tmp_path: Path) -> None:
    world = car_world()
    recording = open_recording(write_kitti_raw(tmp_path, world, kind="extract"))
    np.testing.assert_array_equal(recording.imu.timestamps_ns, world.imu.timestamps_ns)
    np.testing.assert_array_equal(recording.imu.gyro_rad_s, world.imu.gyro_rad_s)
    np.testing.assert_array_equal(recording.imu.accel_m_s2, world.imu.accel_m_s2)


def test_extract_disorder_opens_and_touches_only_its_pairs(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path, kind="extract")
    path = drive / "oxts" / "timestamps.txt"
    replace_line(path, 76, path.read_text().splitlines()[74])  # 0.5 s before the first frame, 100 Hz: frame 2 to 3
    pairs = RecordingPairs(open_recording(drive), before_s=0.01, after_s=0.01)
    for k in (0, 1, 3, 4):
        assert len(pairs[k].imu)
    with pytest.raises(InvalidInputError) as caught:
        pairs[2]
    assert caught.value.code == "imu_duplicate_timestamps"


def test_speed_is_that_of_the_closest_record(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path, kind="extract")  # record k has speed 10 + k, the first frame is at record 50
    speeds = [open_recording(drive).motor_command(k) for k in range(6)]
    assert [float(speed[0]) for speed in speeds if speed is not None] == [60, 70, 80, 90, 100, 110]


def test_one_oxts_record_is_enough_to_open(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path, car_world(frames=1))
    recording = open_recording(drive)
    command = recording.motor_command(0)
    assert command is not None
    assert command.tolist() == [10.0]


@pytest.mark.parametrize("folder", ["image_02/data", "oxts/data"])
@pytest.mark.parametrize("name", ["frame", "2", "00000000002"])
def test_file_names_that_are_no_number_of_their_own(folder: str, name: str, tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    suffix = ".png" if folder.startswith("image") else ".txt"
    shutil.copy(drive / folder / f"0000000002{suffix}", drive / folder / f"{name}{suffix}")
    expect(drive, "file_name_malformed", "expected a number of its own as the file's name, found '")


def test_other_files_beside_the_images_are_left_alone(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    (drive / "image_02" / "data" / "Thumbs.db").write_text("x")
    assert len(open_recording(drive)) == 6


def test_no_images(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    for image in (drive / "image_02" / "data").iterdir():
        image.unlink()
    expect(drive, "no_frames", "image_02/data")


def test_no_oxts_records(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    for record in (drive / "oxts" / "data").iterdir():
        record.unlink()
    expect(drive, "oxts_malformed", "oxts/data")


# -- OXTS


def test_oxts_columns_are_the_sensors_own_axes() -> None:
    row = parse_oxts(Path("t"), 1, " ".join(str(k) for k in range(30)))
    assert row.accel_m_s2.tolist() == [11, 12, 13]
    assert row.gyro_rad_s.tolist() == [17, 18, 19]
    assert row.forward_speed_m_s == 8


@pytest.mark.parametrize("text", [" ".join(["1"] * 29), " ".join(["1"] * 31), "1 " * 29 + "nan", "1 " * 29 + "x"])
def test_oxts_malformed(text: str, tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    write_lines(drive / "oxts" / "data" / "0000000003.txt", [text])
    expect(drive, "oxts_malformed", "0000000003.txt, line 1: ")


@pytest.mark.parametrize("lines", [[], ["1 " * 30] * 2])
def test_oxts_file_with_another_number_of_lines(lines: list[str], tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    write_lines(drive / "oxts" / "data" / "0000000003.txt", lines)
    expect(drive, "oxts_malformed", "0000000003.txt, line 1: expected one line")


# -- cameras and calibration


def test_cameras(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path, camera="image_00")
    assert "image_00" in str(open_recording(drive).frame_path(0))
    shutil.copytree(drive / "image_00", drive / "image_03")
    assert "image_00" in str(open_recording(drive).frame_path(0))
    assert "image_03" in str(open_recording(drive, camera="image_03").frame_path(0))
    shutil.copytree(drive / "image_00", drive / "image_02")
    assert "image_02" in str(open_recording(drive).frame_path(0))
    assert "image_02, image_00, image_03" in expect(drive, "camera_unknown", camera="image_01")


def shrink_images(drive: Path, width: int, height: int) -> None:
    for image in (drive / "image_02" / "data").iterdir():
        write_png(image, textured_image(width, height))


def test_reduced_images_scale_the_camera(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    full = open_recording(drive).camera
    shrink_images(drive, 48, 32)
    half = open_recording(drive).camera
    assert full is not None
    assert half is not None
    assert (half.width, half.height, half.fx, half.fy) == (48, 32, 40.0, 40.0)
    assert (half.cx, half.cy) == (23.5, 15.5)
    np.testing.assert_allclose(half.T_cam_imu, full.T_cam_imu)


@pytest.mark.parametrize("missing", ["S_rect_02", None])
def test_official_size_stands_in_for_S_rect(missing: str | None, tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path, car_world(width=1242, height=375, frames=1))
    if missing:
        drop_key(drive, missing)
    shrink_images(drive, 400, 120)
    camera = open_recording(drive).camera
    assert camera is not None
    assert (camera.fx, camera.fy) == (pytest.approx(80 * 400 / 1242), pytest.approx(80 * 120 / 375))


def drop_key(drive: Path, key: str) -> None:
    path = drive.parent / "calib_cam_to_cam.txt"
    write_lines(path, [text for text in path.read_text().splitlines() if not text.startswith(key + ":")])


def test_cropped_images_fit_no_calibration(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    shrink_images(drive, 96, 40)
    expect(drive, "calibration_malformed", "calib_cam_to_cam.txt: expected images of the shape of 96x64")


def unrectified(drive: Path) -> None:
    """Calibration of a raw camera of 139x51 px beside the rectified one's, and images of that size."""
    rotation = cv2.Rodrigues(np.array([0.01, 0.02, 0.03]))[0].reshape(-1)
    with (drive.parent / "calib_cam_to_cam.txt").open("a") as file:
        file.write("S_02: 139 51\nK_02: 90 0 70 0 91 26 0 0 1\nD_02: -0.3 0.1 0.001 0.002 -0.02\n")
        file.write(f"R_02: {' '.join(map(repr, rotation.tolist()))}\nT_02: 0.06 -0.001 0.005\n")
    shrink_images(drive, 139, 51)


def test_unrectified_images_take_K_and_D(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path, kind="extract")
    rectified = open_recording(drive).camera
    unrectified(drive)
    camera = open_recording(drive).camera
    assert rectified is not None
    assert camera is not None
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height) == (90, 91, 70, 26, 139, 51)
    assert (camera.distortion_model, camera.distortion_coeffs) == ("radtan", (-0.3, 0.1, 0.001, 0.002, -0.02))
    # Undo what the writer put between cam0 and the rectified camera, then apply R_02, T_02.
    T_rect_cam0, T_02 = np.eye(4), np.eye(4)
    T_rect_cam0[:3, :3] = cv2.Rodrigues(np.array([0.02, 0.01, -0.01]))[0]
    T_rect_cam0[:3, 3] = (0.06, 0.01, 0.003)
    T_02[:3, :3], T_02[:3, 3] = cv2.Rodrigues(np.array([0.01, 0.02, 0.03]))[0], (0.06, -0.001, 0.005)
    np.testing.assert_allclose(camera.T_cam_imu, T_02 @ np.linalg.inv(T_rect_cam0) @ rectified.T_cam_imu, atol=1e-9)


@pytest.mark.parametrize("key", ["K_02", "D_02", "R_02", "T_02"])
def test_unrectified_images_need_every_key(key: str, tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path, kind="extract")
    unrectified(drive)
    drop_key(drive, key)
    expect(drive, "calibration_malformed", f"expected the key {key}")


@pytest.mark.parametrize("key", ["P_rect_02", "R_rect_00"])
def test_rectified_images_need_every_key(key: str, tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    drop_key(drive, key)
    expect(drive, "calibration_malformed", f"expected the key {key}")


@pytest.mark.parametrize("file", ["calib_velo_to_cam.txt", "calib_imu_to_velo.txt"])
def test_mounting_is_unknown_without_its_file(file: str, tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    (drive.parent / file).unlink()
    camera = open_recording(drive).camera
    assert camera is not None
    assert camera.T_cam_imu is None


@pytest.mark.parametrize("file", ["calib_velo_to_cam.txt", "calib_imu_to_velo.txt"])
@pytest.mark.parametrize("key", ["R", "T"])
def test_mounting_files_need_both_keys(file: str, key: str, tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    path = drive.parent / file
    write_lines(path, [text for text in path.read_text().splitlines() if not text.startswith(key)])
    expect(drive, "calibration_malformed", f"{file}: expected the key {key}")


@pytest.mark.parametrize("numbers", ["1 2 3", "1 " * 11 + "x", "1 " * 11 + "inf", ""])
def test_malformed_key_names_its_line(numbers: str, tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    path = drive.parent / "calib_cam_to_cam.txt"
    number = next(k for k, text in enumerate(path.read_text().splitlines(), 1) if text.startswith("P_rect_02"))
    replace_line(path, number, f"P_rect_02: {numbers}")
    expect(drive, "calibration_malformed", f"calib_cam_to_cam.txt, line {number}: ")


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("P_rect_02", "0 0 48 0 0 80 32 0 0 0 1 0"),
        ("P_rect_02", "80 5 48 0 0 80 32 0 0 0 1 0"),
        ("P_rect_02", "80 0 48 0 0 80 32 0 0 0 0 0"),
        ("R_rect_00", "2 0 0 0 1 0 0 0 1"),
        ("S_rect_02", "0 64"),
    ],
)
def test_impossible_calibration(key: str, text: str, tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    drop_key(drive, key)
    with (drive.parent / "calib_cam_to_cam.txt").open("a") as file:
        file.write(f"{key}: {text}\n")
    expect(drive, "calibration_malformed", "calib_cam_to_cam.txt")


def test_one_broken_image_does_not_spoil_the_drive(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    (drive / "image_02" / "data" / "0000000000.png").write_bytes(b"")
    recording = open_recording(drive)
    assert recording.camera is not None
    recording.frame(1)
    with pytest.raises(InvalidInputError):
        recording.frame(0)


def test_only_broken_images(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    for image in (drive / "image_02" / "data").iterdir():
        image.write_bytes(b"text")
    with pytest.raises(InvalidInputError) as caught:
        open_recording(drive)
    assert caught.value.code == "image_unsupported_type"
