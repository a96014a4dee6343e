"""Classical detectors on drawn worlds: what each explains, and what is left."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from worlds import textured_image

from viflow_anomaly.evaluation.rivals import RIVALS
from viflow_anomaly.geometry import so3_exp
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples, PinholeCamera, Uint8Array

STAMPS = np.arange(0, 100_000_001, 5_000_000)
IMU = ImuSamples(STAMPS, np.zeros((len(STAMPS), 3)), np.tile((0.0, -9.81, 0.0), (len(STAMPS), 1)))
FOCAL_PX, SIZE = 120.0, (160, 120)
RATE_RAD_S = np.array([0.4, -0.9, 0.6])
# The camera's x is the IMU's y, its y the IMU's z, its z the IMU's x.
T_CAM_IMU = np.array([[0.0, 1, 0, 0.3], [0, 0, 1, 0], [1, 0, 0, -0.1], [0, 0, 0, 1]])


def pair(source: Uint8Array, target: Uint8Array) -> FramePair:
    return FramePair(Frame(20_000_000, source), Frame(70_000_000, target), IMU, None)


def moving_square() -> FramePair:
    """The camera pans by 3 px; a square of another texture goes 8 px the other way."""
    texture, square = textured_image(170, 120, seed=1), textured_image(30, 30, seed=2)
    source, target = texture[:, 3:163].copy(), texture[:, :160].copy()
    source[40:70, 60:90], target[40:70, 52:82] = square, square
    return pair(source, target)


def turning(*, offset_s: float = 0.0) -> FramePair:
    """A camera that turns at a constant rate in a world far away, with a mover; outside the interval the gyro lies."""
    middle = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    camera = PinholeCamera(FOCAL_PX, FOCAL_PX, *middle, *SIZE, T_cam_imu=T_CAM_IMU, time_offset_s=offset_s)
    K = np.array([[FOCAL_PX, 0, middle[0]], [0, FOCAL_PX, middle[1]], [0, 0, 1]])
    R_source_target = T_CAM_IMU[:3, :3] @ so3_exp(RATE_RAD_S * 0.05) @ T_CAM_IMU[:3, :3].T
    source = cv2.GaussianBlur(textured_image(*SIZE, seed=4), (0, 0), 1.5)
    target = cv2.warpPerspective(source, K @ R_source_target.T @ np.linalg.inv(K), SIZE)
    source[50:70, 60:80] = 255
    start = 20_000_000 + round(offset_s * 1e9)
    within = (start <= STAMPS) & (start + 50_000_000 >= STAMPS)
    gyro = np.where(within[:, None], RATE_RAD_S, 5.0)
    imu = ImuSamples(STAMPS, gyro, np.zeros((len(STAMPS), 3)))
    return FramePair(Frame(20_000_000, source), Frame(70_000_000, np.asarray(target, np.uint8)), imu, camera)


@pytest.mark.parametrize("name", [name for name in RIVALS if name not in {"frame difference", "gyro difference"}])
def test_a_rival_sees_the_square_and_not_the_pan(name: str) -> None:
    found = RIVALS[name](moving_square())
    assert found is not None
    evidence, inside = found
    assert evidence.shape == inside.shape == (120, 160)
    assert evidence.dtype == np.float32
    background = evidence[10:110, 100:150].mean()
    assert evidence[44:66, 64:86].mean() > 4 * background


def test_the_frame_difference_sees_both() -> None:
    found = RIVALS["frame difference"](moving_square())
    assert found is not None
    assert found.inside.all()
    assert found.evidence[10:110, 100:150].mean() > 0.3 * found.evidence[44:66, 64:86].mean()


@pytest.mark.parametrize("offset_s", [0.0, 0.01])
def test_the_gyro_explains_a_rotation_and_not_what_moves(offset_s: float) -> None:
    two = turning(offset_s=offset_s)
    found = RIVALS["gyro difference"](two)
    plain = RIVALS["frame difference"](two)
    assert found is not None
    assert plain is not None
    rest = found.inside.copy()
    rest[45:75, 55:85] = False
    assert 0.6 < found.inside.mean() < 1
    assert found.evidence[rest].mean() < 0.1 * plain.evidence[rest].mean()
    assert found.evidence[50:70, 60:80].mean() > 50
    assert not found.evidence[~found.inside].any()


def test_the_gyro_needs_to_know_how_it_is_mounted() -> None:
    two = turning()
    assert two.camera is not None
    unmounted = PinholeCamera(FOCAL_PX, FOCAL_PX, 79.5, 59.5, *SIZE)
    assert RIVALS["gyro difference"](replace(two, camera=unmounted)) is None
    assert RIVALS["gyro difference"](replace(two, camera=None)) is None


def test_a_turn_beyond_the_side_leaves_nothing_inside() -> None:
    two = turning()
    away = ImuSamples(STAMPS, np.tile(np.array([0.0, 0.0, 60.0]), (len(STAMPS), 1)), None)  # 3 rad
    found = RIVALS["gyro difference"](replace(two, imu=away))
    assert found is not None
    assert not found.inside.any()


@pytest.mark.parametrize("name", RIVALS)
def test_rivals_take_pictures_without_anything_to_track(name: str) -> None:
    flat = np.full((64, 96), 90, np.uint8)
    camera = PinholeCamera(80.0, 80.0, 47.5, 31.5, 96, 64, T_cam_imu=np.eye(4))
    found = RIVALS[name](replace(pair(flat, flat), camera=camera))
    assert found is not None
    assert np.isfinite(found.evidence).all()
    assert found.evidence.max() < 1.0
