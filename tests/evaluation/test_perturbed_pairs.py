"""What each perturbation does to a pair, in closed form."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from drawn_methods import LOW, MOVER, DrawnMethod, DrawnPairs

from viflow_anomaly.config import MotionWindowConfig
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.evaluation import perturbed_pairs as perturbed
from viflow_anomaly.evaluation.detection_quality import measure_detection
from viflow_anomaly.evaluation.labelled_pairs import LabelledPairs
from viflow_anomaly.evaluation.perturbed_pairs import PERTURBATIONS, TOLERATED, UNPERTURBED, PerturbedPairs
from viflow_anomaly.geometry import so3_log
from viflow_anomaly.motion_input import build_motion_window
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples, PinholeCamera

SHAPE = (48, 64)
# IMU x front, y left, z top.
MOUNTED = np.array([[0, -1.0, 0, -0.3], [0, 0, -1.0, 0.7], [1.0, 0, 0, -1.1], [0, 0, 0, 1.0]])
RAMP_RAD_S2 = 2.0


def ramp_pair(camera: PinholeCamera | None = None) -> FramePair:
    """Frames at 1.0 and 1.1 s; the gyro about x reads twice the time in seconds."""
    stamps = np.arange(0, 2_000_000_001, 5_000_000)
    gyro = np.zeros((stamps.size, 3))
    gyro[:, 0] = RAMP_RAD_S2 * stamps * 1e-9
    imu = ImuSamples(stamps, gyro, np.full((stamps.size, 3), 9.81))
    image = np.full(SHAPE, 100, np.uint8)
    return FramePair(Frame(1_000_000_000, image), Frame(1_100_000_000, image), imu, camera)


def camera(**changes: object) -> PinholeCamera:
    known = PinholeCamera(fx=80.0, fy=82.0, cx=31.0, cy=23.0, width=64, height=48, T_cam_imu=MOUNTED)
    return replace(known, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("by_s", [0.005, -0.005, 0.02])
def test_a_shifted_imu_moves_the_window_by_as_much(by_s: float) -> None:
    pair = ramp_pair(camera())
    shifted = perturbed.shift_imu(pair, by_s=by_s)
    config = MotionWindowConfig(axes="sensor")
    before, after = (build_motion_window(one, config).values for one in (pair, shifted))
    np.testing.assert_allclose(after[:, 0] - before[:, 0], -RAMP_RAD_S2 * by_s, atol=1e-6)
    np.testing.assert_array_equal(after[:, 1:], before[:, 1:])
    # The same as a camera whose clock is that much earlier than it says.
    told = replace(pair, camera=camera(time_offset_s=-by_s))
    np.testing.assert_allclose(build_motion_window(told, config).values, after, atol=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_mounting_turns_by_exactly_one_degree_about_a_camera_axis(axis: int) -> None:
    turned = perturbed.turn_mounting(ramp_pair(camera()), axis=axis, by_rad=perturbed.ONE_DEGREE).camera
    assert turned is not None
    assert turned.T_cam_imu is not None
    between = so3_log(turned.T_cam_imu[:3, :3] @ MOUNTED[:3, :3].T)
    np.testing.assert_allclose(between, math.pi / 180 * np.eye(3)[axis], atol=1e-12)
    np.testing.assert_array_equal(turned.T_cam_imu[:, 3], MOUNTED[:, 3])
    assert (turned.fx, turned.time_offset_s) == (80.0, 0.0)


def test_a_biased_gyro_reads_more_on_every_axis() -> None:
    pair = ramp_pair()
    biased = perturbed.bias_gyro(pair, by_rad_s=0.02)
    np.testing.assert_allclose(biased.imu.gyro_rad_s - pair.imu.gyro_rad_s, 0.02, atol=1e-12)
    np.testing.assert_array_equal(biased.imu.accel_m_s2, pair.imu.accel_m_s2)


def test_a_focal_length_is_scaled_about_the_same_middle() -> None:
    scaled = perturbed.scale_focal_length(ramp_pair(camera()), factor=1.02).camera
    assert scaled is not None
    assert (scaled.fx, scaled.fy, scaled.cx, scaled.cy) == pytest.approx((81.6, 83.64, 31.0, 23.0))


def test_noise_has_its_sigma_and_belongs_to_the_frame() -> None:
    pair = ramp_pair()
    noisy, again = (perturbed.add_image_noise(pair, sigma_gray=5.0) for _ in range(2))
    added = noisy.source.image.astype(float) - 100
    assert added.std() == pytest.approx(5.0, rel=0.05)
    assert abs(added.mean()) < 0.3
    assert not np.array_equal(noisy.source.image, noisy.target.image)
    np.testing.assert_array_equal(noisy.source.image, again.source.image)
    later = replace(pair, source=pair.target, target=Frame(1_200_000_000, pair.source.image))
    np.testing.assert_array_equal(perturbed.add_image_noise(later, sigma_gray=5.0).source.image, noisy.target.image)


def test_only_the_target_becomes_brighter() -> None:
    pair = ramp_pair()
    pair.target.image[0, 0] = 250
    bright = perturbed.brighten_target(replace(pair, source=Frame(0, np.full(SHAPE, 7, np.uint8))), gain=1.2)
    assert bright.source.image[0, 0] == 7
    assert (bright.target.image[0, 0], bright.target.image[1, 1]) == (255, 120)


def test_what_is_not_known_cannot_be_made_wrong() -> None:
    for unmounted in (ramp_pair(), ramp_pair(camera(T_cam_imu=None))):
        with pytest.raises(InvalidInputError) as caught:
            perturbed.turn_mounting(unmounted, axis=0, by_rad=0.1)
        assert caught.value.code == "mounting_missing"
    with pytest.raises(InvalidInputError) as caught:
        perturbed.scale_focal_length(ramp_pair(), factor=1.02)
    assert caught.value.code == "camera_missing"


def test_without_accelerometer_the_gyro_stays() -> None:
    pair = ramp_pair(camera())
    seen = perturbed.drop_accelerometer(pair)
    assert seen.imu.accel_m_s2 is None
    np.testing.assert_array_equal(seen.imu.gyro_rad_s, pair.imu.gyro_rad_s)


def test_every_perturbation_but_one_changes_the_pair() -> None:
    pair = ramp_pair(camera())
    for name, perturb in PERTURBATIONS.items():
        seen = perturb(pair)
        assert (seen is pair) == (name == UNPERTURBED)
        assert seen.source.timestamp_ns == pair.source.timestamp_ns
    assert len(TOLERATED) == 5
    assert {"time offset +5 ms", "time offset -5 ms"} < set(TOLERATED)


def test_the_method_sees_the_perturbed_pair_and_the_ruler_the_same_labels() -> None:
    drawn: LabelledPairs = DrawnPairs("drone_1", "drone")
    pairs = PerturbedPairs(drawn, partial(perturbed.shift_imu, by_s=0.005))
    method = DrawnMethod("drawn", {LOW: [(MOVER, 0.9)]})
    run = measure_detection([method], [pairs])
    assert [int(pair.imu.timestamps_ns[0]) for pair in method.seen] == [5_000_000, 5_000_000]
    assert run.total()["drawn"].findings[LOW].boxes.average_precision() == pytest.approx(1.0)
    assert (pairs.sequence, pairs.group, len(pairs)) == ("drone_1", "drone", 2)


def test_pairs_that_a_perturbation_cannot_be_applied_to_are_counted() -> None:
    method = DrawnMethod("drawn", {LOW: []})
    blind = PerturbedPairs(DrawnPairs("a_1", "a"), partial(perturbed.scale_focal_length, factor=1.02))
    run = measure_detection([method], [blind, DrawnPairs("a_2", "a")])
    assert run.skipped == {"camera_missing": 2}
    assert len(method.seen) == 2
