"""Labelled pairs whose calibration or images are wrong in one stated way: what a detector is told, not what is true.

A perturbation is a pure function from pair to pair; labels stay as they are. Its random numbers come from a frame's
stamp, so that a frame is the same in both of its pairs and in every run.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Final

import numpy as np

from viflow_anomaly.config import MotorSource
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.evaluation.labelled_pairs import LabelledPairs, Labels
from viflow_anomaly.geometry import so3_exp
from viflow_anomaly.sensor_data import Float64Array, Frame, FramePair, PinholeCamera, Uint8Array

Perturbation = Callable[[FramePair], FramePair]

NOISE_SEED = 20_240_501
MAX_GRAY = 255


def unperturbed(pair: FramePair) -> FramePair:
    """The pair as it is."""
    return pair


def shift_imu(pair: FramePair, *, by_s: float) -> FramePair:
    """IMU stamps later by ``by_s``, the camera's ``time_offset_s`` as it was: the offset is wrong by as much.

    A sample then stands for what happened ``by_s`` before its stamp.
    """
    stamps = pair.imu.timestamps_ns + round(by_s * 1e9)
    return replace(pair, imu=replace(pair.imu, timestamps_ns=stamps))


def turn_mounting(pair: FramePair, *, axis: int, by_rad: float) -> FramePair:
    """``T_cam_imu`` turned about an axis of the camera (0 right, 1 down, 2 ahead); the IMU stays in its place.

    Raises:
        InvalidInputError: ``mounting_missing``.
    """
    camera = pair.camera
    if camera is None or camera.T_cam_imu is None:
        raise InvalidInputError(
            "camera: expected one whose mounting is known (T_cam_imu), to turn it; found none",
            code="mounting_missing",
            field="camera.T_cam_imu",
        )
    transform = np.array(camera.T_cam_imu)
    transform[:3, :3] = so3_exp(by_rad * np.eye(3)[axis]) @ transform[:3, :3]
    return replace(pair, camera=replace(camera, T_cam_imu=transform))


def bias_gyro(pair: FramePair, *, by_rad_s: float) -> FramePair:
    """The same error added to each of the gyro's three axes."""
    return replace(pair, imu=replace(pair.imu, gyro_rad_s=pair.imu.gyro_rad_s + by_rad_s))


def drop_accelerometer(pair: FramePair) -> FramePair:
    """The gyro alone, as of a phone or a stabiliser."""
    return replace(pair, imu=replace(pair.imu, accel_m_s2=None))


def scale_focal_length(pair: FramePair, *, factor: float) -> FramePair:
    """The camera is said to have a longer (> 1) or shorter focal length than it has.

    Raises:
        InvalidInputError: ``camera_missing``.
    """
    camera: PinholeCamera | None = pair.camera
    if camera is None:
        raise InvalidInputError(
            "camera: expected a calibrated one, to change its focal length; found none",
            code="camera_missing",
            field="camera",
        )
    return replace(pair, camera=replace(camera, fx=camera.fx * factor, fy=camera.fy * factor))


def add_image_noise(pair: FramePair, *, sigma_gray: float) -> FramePair:
    """Normal noise on both images, independent from pixel to pixel and from frame to frame."""
    return replace(pair, source=_noisy(pair.source, sigma_gray), target=_noisy(pair.target, sigma_gray))


def brighten_target(pair: FramePair, *, gain: float) -> FramePair:
    """The target image alone multiplied by ``gain``; what leaves the range is cut off."""
    return replace(pair, target=replace(pair.target, image=_gray(pair.target.image * np.float64(gain))))


def _noisy(frame: Frame, sigma_gray: float) -> Frame:
    rng = np.random.default_rng((NOISE_SEED, frame.timestamp_ns))
    return replace(frame, image=_gray(frame.image + rng.normal(0.0, sigma_gray, frame.image.shape)))


def _gray(values: Float64Array) -> Uint8Array:
    return np.asarray(np.clip(np.rint(values), 0, MAX_GRAY), dtype=np.uint8)


ONE_DEGREE: Final = math.radians(1.0)
UNPERTURBED: Final = "unperturbed"
PERTURBATIONS: Final = MappingProxyType[str, Perturbation](
    {
        UNPERTURBED: unperturbed,
        "time offset +5 ms": partial(shift_imu, by_s=0.005),
        "time offset -5 ms": partial(shift_imu, by_s=-0.005),
        "time offset +20 ms": partial(shift_imu, by_s=0.020),
        "time offset -20 ms": partial(shift_imu, by_s=-0.020),
        "mounting 1 deg about x (right)": partial(turn_mounting, axis=0, by_rad=ONE_DEGREE),
        "mounting 1 deg about y (down)": partial(turn_mounting, axis=1, by_rad=ONE_DEGREE),
        "mounting 1 deg about z (ahead)": partial(turn_mounting, axis=2, by_rad=ONE_DEGREE),
        "gyro bias 0.02 rad/s": partial(bias_gyro, by_rad_s=0.02),
        "no accelerometer": drop_accelerometer,
        "focal length +2 %": partial(scale_focal_length, factor=1.02),
        "focal length -2 %": partial(scale_focal_length, factor=0.98),
        "image noise sigma 5": partial(add_image_noise, sigma_gray=5.0),
        "target brighter x1.2": partial(brighten_target, gain=1.2),
    }
)
"""Name -> what is made wrong, each alone."""

TOLERATED: Final = tuple(name for name in PERTURBATIONS if "5 ms" in name or "1 deg" in name)
"""What a user's calibration is likely to be off by: average precision may fall by ``MAX_AP_DROP`` under each."""
MAX_AP_DROP: Final = 0.02


class PerturbedPairs:
    """Labelled pairs seen through a perturbation; a pair that it cannot be applied to cannot be used.

    Args:
        pairs: what is true.
        perturbation: of each pair.
    """

    def __init__(self, pairs: LabelledPairs, perturbation: Perturbation) -> None:
        self._pairs = pairs
        self._perturbation = perturbation
        self.sequence = pairs.sequence
        self.group = pairs.group

    def __len__(self) -> int:
        return len(self._pairs)

    def pair(self, index: int, motor_source: MotorSource | None = None) -> FramePair:
        return self._perturbation(self._pairs.pair(index, motor_source))

    def labels(self, index: int) -> Labels:
        return self._pairs.labels(index)
