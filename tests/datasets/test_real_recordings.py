"""Real recordings open, give sensible pairs, and their axes are right: gyro against ground truth and against images."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
from worlds import REAL_DATA

from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.datasets.registry import open_recording, recognise
from viflow_anomaly.geometry import integrate_gyro, so3_log, unproject_pixels
from viflow_anomaly.sensor_data import Frame, PinholeCamera

RECORDINGS = {
    "euroc/V1_01_easy": ("euroc", 60, (752, 480), 20.0, 200.0),
    "kitti/2011_09_26/2011_09_26_drive_0005_sync": ("kitti_raw", 154, (400, 120), 10.0, 10.0),
    "kitti/2011_09_26/2011_09_26_drive_0027_sync": ("kitti_raw", 188, (400, 120), 10.0, 10.0),
    "kitti/2011_09_26/2011_09_26_drive_0011_sync": ("kitti_raw", 61, (1242, 375), 10.0, 10.0),
    "kitti/odometry/sequences/01": ("kitti_odometry", 51, (1241, 376), 10.0, 100.0),
    "kitti/odometry/sequences/06": ("kitti_odometry", 51, (1226, 370), 10.0, 100.0),
}


def real(relative: str) -> Path:
    path = REAL_DATA / relative
    if not path.exists():
        pytest.skip(f"no real data at {path}; set VIFLOW_REAL_DATA to the folder that holds it")
    return path


@pytest.mark.parametrize("relative", RECORDINGS)
def test_opens_and_pairs(relative: str) -> None:
    layout, frames, size, frame_rate_hz, imu_rate_hz = RECORDINGS[relative]
    assert recognise(real(relative)) == layout
    recording = open_recording(real(relative))
    assert len(recording) == frames
    assert 1e9 / np.median(np.diff(recording.frame_timestamps_ns)) == pytest.approx(frame_rate_hz, rel=0.05)
    assert 1e9 / np.median(np.diff(recording.imu.timestamps_ns)) == pytest.approx(imu_rate_hz, rel=0.05)
    pairs = RecordingPairs(recording, (1, 4))
    assert len(pairs) == 2 * frames - 5
    for k in (0, len(pairs) // 2, -1):
        pair = pairs[k]
        assert pair.source.image.shape == (size[1], size[0])
        assert pair.camera is not None
        assert pair.camera.T_cam_imu is not None
        assert pair.source.image.std() > 10
        assert pair.imu.timestamps_ns[0] <= pair.source.timestamp_ns
        assert pair.imu.timestamps_ns[-1] >= pair.target.timestamp_ns


@pytest.mark.parametrize("relative", RECORDINGS)
def test_gravity_points_up_in_the_image(relative: str) -> None:
    recording = open_recording(real(relative))
    assert recording.camera is not None
    assert recording.imu.accel_m_s2 is not None
    first, last = recording.frame_timestamps_ns[[0, -1]]
    during = (recording.imu.timestamps_ns >= first) & (recording.imu.timestamps_ns <= last)
    force = recording.camera.R_cam_imu @ recording.imu.accel_m_s2[during].mean(axis=0)
    assert np.linalg.norm(force) == pytest.approx(9.8, abs=0.7)  # the motorway ramp adds 4 m/s^2 sideways
    assert force[1] < -8.5  # y is down


def gyro_turns(
    recording: Recording, bias: tuple[float, float, float] = (0.0, 0.0, 0.0), offset_s: float = 0.0
) -> np.ndarray:
    """[F - 1, 3] rotation vectors from each frame to the next in IMU axes, by the gyro, at the edges interpolated."""
    stamps = (recording.frame_timestamps_ns + round(offset_s * 1e9)).astype(np.int64)
    imu, turns = recording.imu, []
    for start, end in itertools.pairwise(stamps):
        inside = imu.timestamps_ns[(imu.timestamps_ns > start) & (imu.timestamps_ns < end)]
        times = np.concatenate([[start], inside, [end]])
        rates = [np.interp(times - stamps[0], imu.timestamps_ns - stamps[0], imu.gyro_rad_s[:, k]) for k in range(3)]
        turns.append(so3_log(integrate_gyro(times, np.column_stack(rates) - bias)))
    return np.array(turns)


def image_turns(recording: Recording, indices: range) -> np.ndarray:
    """[K, 3] rotation vectors from frame k to k + 1 in camera axes, from tracked corners and the essential matrix."""
    assert recording.camera is not None
    return np.array([_image_turn(recording.camera, recording.frame(k), recording.frame(k + 1)) for k in indices])


def _image_turn(camera: PinholeCamera, source: Frame, target: Frame) -> np.ndarray:
    corners = cv2.goodFeaturesToTrack(source.image, 400, 0.01, 8)
    tracked, found, _ = cv2.calcOpticalFlowPyrLK(source.image, target.image, corners, np.empty_like(corners))
    good = found[:, 0] == 1
    before, after = (unproject_pixels(camera, points[good, 0]) for points in (corners, tracked))
    E, _ = cv2.findEssentialMat(before, after, np.eye(3), cv2.RANSAC, 0.999, 0.7 / camera.fx)
    first, second, _ = cv2.decomposeEssentialMat(E)
    # Of the two rotations the small one: with a short baseline cheirality cannot tell them apart.
    return min((so3_log(R_target_source.T) for R_target_source in (first, second)), key=np.linalg.norm)


def quaternion_matrix(wxyz: np.ndarray) -> np.ndarray:
    w, x, y, z = wxyz / np.linalg.norm(wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_euroc_gyro_is_the_ground_truth_rotation() -> None:
    folder = real("euroc/V1_01_easy")
    truth_file = "mav0/state_groundtruth_estimate0/openvins_V1_01_easy_corrected_20Hz.csv"
    lines = real(f"euroc/V1_01_easy/{truth_file}").read_text().splitlines()[1:]
    truth = {int(row[0]): np.array([float(x) for x in row[4:8]]) for row in (line.split(",") for line in lines)}
    stamps = np.array(list(truth))
    recording = open_recording(folder)
    poses = []
    for stamp in recording.frame_timestamps_ns:
        nearest = int(stamps[np.argmin(np.abs(stamps - stamp))])
        assert abs(nearest - stamp) <= 256  # both were written through doubles
        poses.append(quaternion_matrix(truth[nearest]))
    expected = np.array([so3_log(a.T @ b) for a, b in itertools.pairwise(poses)])
    turns = gyro_turns(recording, bias=(-0.0022, 0.0215, 0.0770))
    np.testing.assert_allclose(turns, expected, atol=1e-3)
    assert np.abs(expected).max() > 0.01


def test_euroc_trajectory_turns_the_camera_as_the_gyro_says() -> None:
    recording = open_recording(real("euroc/V1_01_easy"))
    trajectory, camera = recording.trajectory, recording.camera
    assert trajectory is not None
    assert camera is not None
    pairs = list(itertools.pairwise(recording.frame_timestamps_ns.tolist()))
    found = np.array([so3_log(trajectory.motion(*pair)[:3, :3].T) for pair in pairs])
    expected = gyro_turns(recording, bias=(-0.0022, 0.0215, 0.0770)) @ camera.R_cam_imu.T
    np.testing.assert_allclose(found, expected, atol=2e-3)  # Vicon's noise; the states are 5 ms apart
    assert np.abs(expected).max() > 0.01
    moved = np.linalg.norm([trajectory.displacement_m(*pair) for pair in pairs], axis=1)
    assert 0.2 < moved.mean() / 0.05 < 2.0  # an easy flight, m/s
    assert np.abs(np.diff(moved)).max() < 0.02  # it accelerates by less than 8 m/s^2


def test_euroc_images_turn_as_the_gyro_says_through_T_cam_imu() -> None:
    recording = open_recording(real("euroc/V1_01_easy"))
    assert recording.camera is not None
    assert recording.camera.R_cam_imu is not None
    indices = range(0, 12)
    turns = gyro_turns(recording, bias=(-0.0022, 0.0215, 0.0770))[indices.start : indices.stop]
    by_image = image_turns(recording, indices)
    right = np.abs(turns @ recording.camera.R_cam_imu.T - by_image).mean()
    wrong = np.abs(turns @ recording.camera.R_cam_imu - by_image).mean()
    assert right < 2e-3
    assert wrong > 3 * right


@pytest.mark.parametrize(("sequence", "turning"), [("01", 0.03), ("06", 0.0005)])
def test_odometry_gyro_is_the_ground_truth_rotation(sequence: str, turning: float) -> None:
    recording = open_recording(real(f"kitti/odometry/sequences/{sequence}"))
    poses = np.loadtxt(real(f"kitti/odometry/poses/{sequence}_first51.txt")).reshape(-1, 3, 4)[:, :, :3]
    expected = np.array([so3_log(a.T @ b) for a, b in itertools.pairwise(poses)])[:-1]
    assert recording.camera is not None
    assert recording.camera.R_cam_imu is not None
    turns = gyro_turns(recording, offset_s=0.06)[:-1] @ recording.camera.R_cam_imu.T  # the last one has no IMU left
    assert np.abs(expected).mean(axis=0).max() > turning
    for axis, least in ((0, 0.9), (1, 0.9), (2, 0.7)):
        assert np.corrcoef(turns[:, axis], expected[:, axis])[0, 1] > least
    assert np.abs(turns - expected).mean() < 0.15 * np.abs(expected).mean() + 2e-4


def test_kitti_raw_images_turn_as_the_gyro_says_through_T_cam_imu() -> None:
    recording = open_recording(real("kitti/2011_09_26/2011_09_26_drive_0011_sync"))
    assert recording.camera is not None
    turns = gyro_turns(recording) @ recording.camera.R_cam_imu.T
    sharpest = int(np.argmax(np.abs(turns[:-6, 1])))
    indices = range(sharpest, sharpest + 6)
    by_image = image_turns(recording, indices)
    np.testing.assert_allclose(by_image[:, 1].mean(), turns[indices.start : indices.stop, 1].mean(), rtol=0.25)
    assert abs(turns[sharpest, 1]) > 0.002


def test_kitti_forward_speed_is_plausible() -> None:
    recording = open_recording(real("kitti/2011_09_26/2011_09_26_drive_0027_sync"))
    speeds = [recording.motor_command(k) for k in range(len(recording))]
    assert all(speed is not None and 10.0 < speed[0] < 23.0 for speed in speeds)
