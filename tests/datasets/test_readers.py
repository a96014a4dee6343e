"""One contract for all readers, over the same synthetic world in every layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from worlds import WRITERS, car_world, make_world, write_euroc, write_kitti_odometry, write_kitti_raw, write_plain

from viflow_anomaly.config import ImageLimits
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.recording import FileRecording, Recording
from viflow_anomaly.datasets.registry import READERS, open_recording, recognise
from viflow_anomaly.errors import DatasetError, TooLargeError
from viflow_anomaly.geometry import integrate_gyro, so3_log
from viflow_anomaly.imu_log import ImuLog

FORMATS = {name: name if name in READERS else name.rsplit("_", 1)[0] for name in WRITERS}
FORMATS["kitti_odometry_plain_imu"] = "kitti_odometry"


@pytest.fixture(params=sorted(WRITERS))
def layout(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def folder(layout: str, tmp_path: Path) -> Path:
    return WRITERS[layout](tmp_path / "recording")


@pytest.fixture
def recording(folder: Path) -> Recording:
    return open_recording(folder)


def test_is_recognised_by_content(layout: str, folder: Path) -> None:
    assert recognise(folder) == FORMATS[layout]
    renamed = folder.rename(folder.with_name("anything"))
    assert recognise(str(renamed)) == FORMATS[layout]
    assert open_recording(renamed, format=FORMATS[layout]).format == FORMATS[layout]


def test_length_name_and_root(layout: str, recording: Recording, folder: Path) -> None:
    assert len(recording) == 6
    assert recording.name == folder.name
    assert recording.root.is_relative_to(folder)
    assert recording.format == FORMATS[layout]


def test_stamps_increase_and_belong_to_the_frames(recording: Recording) -> None:
    stamps = recording.frame_timestamps_ns
    assert stamps.dtype == np.int64
    assert (np.diff(stamps) > 0).all()
    assert [recording.frame(k).timestamp_ns for k in range(len(recording))] == stamps.tolist()


def test_stamps_are_exact(layout: str, recording: Recording) -> None:
    world = make_world() if layout in {"euroc", "plain"} else car_world()
    start = 0 if layout == "kitti_odometry_plain_imu" else int(world.frame_timestamps_ns[0])
    assert (recording.frame_timestamps_ns - start).tolist() == (
        world.frame_timestamps_ns - world.frame_timestamps_ns[0]
    ).tolist()


def test_random_access_equals_sequential(recording: Recording) -> None:
    sequential = [recording.frame(k).image for k in range(len(recording))]
    for index in (4, 0, 5, 2, -1, -6):
        np.testing.assert_array_equal(recording.frame(index).image, sequential[index])
        assert recording.frame_path(index) == recording.frame_path(index % 6)


def test_images_are_the_worlds(recording: Recording) -> None:
    for index, image in enumerate(make_world().images):
        np.testing.assert_array_equal(recording.frame(index).image, image)


@pytest.mark.parametrize("index", [6, -7])
def test_outside_is_an_index_error(recording: Recording, index: int) -> None:
    for read in (recording.frame, recording.frame_path, recording.motor_command):
        with pytest.raises(IndexError):
            read(index)


def test_camera_fits_the_images(recording: Recording) -> None:
    assert recording.camera is not None
    assert recording.frame(0).image.shape == (recording.camera.height, recording.camera.width)
    assert recording.camera.fx == pytest.approx(80.0)
    assert recording.camera.cx == pytest.approx(47.5)


def test_mounting_is_the_worlds(layout: str, recording: Recording) -> None:
    world = make_world() if layout in {"euroc", "plain"} else car_world()
    assert recording.camera is not None
    np.testing.assert_allclose(recording.camera.T_cam_imu, world.camera.T_cam_imu, atol=1e-9)


def test_gyro_between_frames_is_the_cameras_turn(layout: str, recording: Recording) -> None:
    pairs = RecordingPairs(recording, before_s=0.0, after_s=0.0)
    camera = recording.camera
    assert camera is not None
    imu = pairs[2].imu
    turn = camera.R_cam_imu @ so3_log(integrate_gyro(imu.timestamps_ns, imu.gyro_rad_s))
    rate = turn / ((imu.timestamps_ns[-1] - imu.timestamps_ns[0]) * 1e-9)
    expected = 0.5 if layout in {"euroc", "plain"} else 0.25
    np.testing.assert_allclose(rate, (0.0, expected, 0.0), atol=5e-3)


def test_accelerometer_reads_plus_g_upwards(recording: Recording) -> None:
    assert recording.camera is not None
    assert recording.imu.accel_m_s2 is not None
    np.testing.assert_allclose(
        recording.camera.R_cam_imu @ recording.imu.accel_m_s2.mean(axis=0), (0, -9.81, 0), atol=0.05
    )


def test_every_pair_has_imu_on_both_sides(recording: Recording) -> None:
    pairs = RecordingPairs(recording, before_s=0.05, after_s=0.05)
    assert len(pairs) == 5
    for pair in pairs:
        assert pair.imu.timestamps_ns[0] <= pair.source.timestamp_ns
        assert pair.imu.timestamps_ns[-1] >= pair.target.timestamp_ns


def test_motor_command_is_a_speed_or_nothing(layout: str, recording: Recording) -> None:
    if layout.startswith("kitti_raw"):
        command = recording.motor_command(2)
        assert command is not None
        assert command.shape == (1,)
        assert command[0] >= 10.0
    else:
        assert recording.motor_command(2) is None


def test_limits_reach_the_decoder(folder: Path, layout: str) -> None:
    if layout.startswith("kitti"):  # they read the first header while opening
        with pytest.raises(TooLargeError):
            open_recording(folder, limits=ImageLimits(max_pixels=100))
        return
    with pytest.raises(TooLargeError):
        open_recording(folder, limits=ImageLimits(max_pixels=100)).frame(0)


def test_an_image_that_vanishes_after_opening_is_named(recording: Recording) -> None:
    recording.frame_path(3).unlink()
    with pytest.raises(DatasetError) as caught:
        recording.frame(3)
    assert caught.value.code == "image_missing"
    assert str(recording.frame_path(3)) in caught.value.message
    recording.frame(2)


def test_unknown_camera_is_refused(folder: Path) -> None:
    with pytest.raises(DatasetError) as caught:
        open_recording(folder, camera="image_9")
    assert caught.value.code == "camera_unknown"
    assert "image_9" in caught.value.message


@pytest.mark.parametrize(
    ("table", "code"),
    [
        ("euroc:mav0/cam0/data.csv", "no_frames"),
        ("plain:frames.csv", "no_frames"),
        ("euroc:mav0/imu0/data.csv", "csv_malformed"),
        ("plain:imu.csv", "csv_malformed"),
        ("kitti_odometry_plain_imu:imu.csv", "csv_malformed"),
        ("kitti_odometry_perframe:imu_10perframe.csv", "csv_malformed"),
    ],
)
def test_tables_that_are_only_a_header(table: str, code: str, tmp_path: Path) -> None:
    name, _, file = table.partition(":")
    path = WRITERS[name](tmp_path) / file
    path.write_text(path.read_text().splitlines()[0] + "\n")
    with pytest.raises(DatasetError) as caught:
        open_recording(tmp_path)
    assert caught.value.code == code


def test_recordings_without_calibration_have_no_camera(tmp_path: Path) -> None:
    raw = write_kitti_raw(tmp_path / "raw")
    odometry = write_kitti_odometry(tmp_path / "odometry")
    euroc = write_euroc(tmp_path / "euroc")
    plain = write_plain(tmp_path / "plain", camera=False)
    (raw.parent / "calib_cam_to_cam.txt").unlink()
    (odometry / "calib.txt").unlink()
    (euroc / "mav0" / "cam0" / "sensor.yaml").unlink()
    for folder in (raw, odometry, euroc, plain):
        recording = open_recording(folder)
        assert recording.camera is None
        assert RecordingPairs(recording)[0].camera is None


def test_recording_without_frames(tmp_path: Path) -> None:
    imu = ImuLog(np.array([1], dtype=np.int64), np.zeros((1, 3)))
    with pytest.raises(DatasetError) as caught:
        FileRecording("x", tmp_path, "plain", None, imu, np.zeros(0, np.int64), ())
    assert caught.value.code == "no_frames"
