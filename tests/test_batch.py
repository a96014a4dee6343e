"""From pairs to tensors."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from worlds import World, make_world

from viflow_anomaly.batch import collate, collate_arrays, require_device
from viflow_anomaly.config import ModelConfig, ViewConfig
from viflow_anomaly.errors import ConfigError, InvalidInputError
from viflow_anomaly.model_input import prepare
from viflow_anomaly.motion_input import build_motion_window
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples

CONFIG = ModelConfig()


def pair_of(world: World, source: int, target: int) -> FramePair:
    imu = ImuSamples(world.imu.timestamps_ns, world.imu.gyro_rad_s, world.imu.accel_m_s2)
    frames = [Frame(int(world.frame_timestamps_ns[k]), world.images[k]) for k in (source, target)]
    return FramePair(frames[0], frames[1], imu, world.camera)


def test_prepare_renders_both_views_and_the_window() -> None:
    pair = pair_of(make_world(), 1, 2)
    one = prepare(pair, CONFIG)
    assert one.source.shape == one.target.shape == (one.view.height, one.view.width)
    np.testing.assert_array_equal(one.source, one.view.render(pair.source.image))
    np.testing.assert_array_equal(one.target, one.view.render(pair.target.image))
    np.testing.assert_array_equal(one.window.values, build_motion_window(pair, CONFIG.motion_window).values)


def test_collate_keeps_the_order_and_scales_the_images() -> None:
    world = make_world()
    inputs = [prepare(pair_of(world, 0, 1), CONFIG), prepare(pair_of(world, 1, 3), CONFIG)]
    batch = collate(inputs)
    height, width = inputs[0].source.shape
    assert batch.source.shape == batch.target.shape == (2, 1, height, width)
    assert batch.motion.shape == (2, CONFIG.motion_window.rows, 6)
    assert {tensor.dtype for tensor in batch[:4]} == {torch.float32}
    for index, one in enumerate(inputs):
        np.testing.assert_allclose(batch.source[index, 0].numpy() * 255, one.source, atol=1e-4)
        np.testing.assert_allclose(batch.target[index, 0].numpy() * 255, one.target, atol=1e-4)
        np.testing.assert_array_equal(batch.motion[index].numpy(), one.window.values)
    np.testing.assert_allclose(batch.interval_s.numpy(), [0.05, 0.1], rtol=1e-6)
    assert float(batch.source.min()) >= 0.0
    assert float(batch.source.max()) <= 1.0


def test_the_batch_goes_to_the_device_that_is_asked_for() -> None:
    batch = collate([prepare(pair_of(make_world(), 0, 1), CONFIG)], "meta")
    assert {tensor.device.type for tensor in batch[:4]} == {"meta"}


def test_arrays_and_inputs_make_the_same_batch() -> None:
    one = prepare(pair_of(make_world(), 0, 1), CONFIG)
    batch = collate([one])
    interval_s = np.array([one.window.interval_s], dtype=np.float32)
    same = collate_arrays(one.source[None], one.target[None], one.window.values[None].copy(), interval_s)
    assert all(torch.equal(a, b) for a, b in zip(batch[:4], same[:4], strict=True))


def test_an_image_that_the_view_cannot_take_is_refused() -> None:
    config = CONFIG.model_copy(update={"view": ViewConfig(mode="center_crop")})
    with pytest.raises(InvalidInputError) as caught:
        prepare(pair_of(make_world(), 0, 1), config)
    assert caught.value.code == "image_smaller_than_crop"


def test_a_device_without_memory_is_refused() -> None:
    with pytest.raises(ConfigError) as caught:
        require_device("meta")
    assert caught.value.code == "device_unavailable"
