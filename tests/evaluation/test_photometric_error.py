"""Photometric error of flows whose answer can be worked out."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import make_world, textured_image

from viflow_anomaly.evaluation.photometric_error import photometric_error
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples


def pair_shifted_by(pixels: int) -> FramePair:
    """What is at u in the source is at u - pixels in the target."""
    wide, world = textured_image(80, 40, seed=2), make_world(frames=2)
    images = (wide[:, :60].copy(), wide[:, pixels : 60 + pixels].copy())
    frames = [Frame(int(stamp), image) for stamp, image in zip(world.frame_timestamps_ns, images, strict=True)]
    return FramePair(*frames, ImuSamples(world.imu.timestamps_ns, world.imu.gyro_rad_s, world.imu.accel_m_s2), None)


def test_the_true_flow_leaves_nothing_and_none_leaves_the_difference() -> None:
    pair = pair_shifted_by(5)
    flow = np.zeros((40, 60, 2), np.float32)
    still = photometric_error(pair, flow)
    assert still.residual_gray == pytest.approx(still.frame_difference_gray)
    flow[..., 0] = -5
    right = photometric_error(pair, flow)
    assert right.residual_gray == 0.0
    inside = np.abs(pair.source.image.astype(float) - pair.target.image)[:, 5:]
    assert right.frame_difference_gray == pytest.approx(inside.mean(), rel=1e-5)


def test_pixels_without_a_flow_do_not_count() -> None:
    pair = pair_shifted_by(5)
    flow = np.full((40, 60, 2), np.nan, np.float32)
    flow[10:20, 20:30] = (-5, 0)
    error = photometric_error(pair, flow)
    assert error.residual_gray == 0.0
    part = np.abs(pair.source.image.astype(float) - pair.target.image)[10:20, 20:30]
    assert error.frame_difference_gray == pytest.approx(part.mean(), rel=1e-5)
