"""Choosing among hypotheses, on shifts whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import make_world, textured_image

from viflow_anomaly.config import CorrectionConfig, ModelConfig
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.model_input import ModelInput, prepare
from viflow_anomaly.prediction import choose_hypothesis, correct, view_rays
from viflow_anomaly.runtime.interface import Hypotheses
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples, Uint8Array

SHIFTS_PX = [(0.0, 0.0), (-8.0, 0.0), (8.0, 4.0), (4.0, -8.0)]


def shifted_pair(du: int, dv: int, *, side: int = 64) -> tuple[Uint8Array, Uint8Array]:
    """What is at p in the source is at p + (du, dv) in the target."""
    margin = 16
    texture = textured_image(side + 2 * margin, side + 2 * margin, seed=0)

    def window(x: int, y: int) -> Uint8Array:
        return np.ascontiguousarray(texture[y : y + side, x : x + side])

    return window(margin, margin), window(margin - du, margin - dv)


def hypotheses(stride: int, *, side: int = 64, shifts: list[tuple[float, float]] = SHIFTS_PX) -> Hypotheses:
    cells = -(-side // stride)
    flow: Float32Array = np.empty((len(shifts), cells, cells, 2), dtype=np.float32)
    flow[:] = np.array(shifts, dtype=np.float32)[:, None, None]
    return Hypotheses(flow, stride, None)


@pytest.mark.parametrize("side", [64, 67])
@pytest.mark.parametrize("stride", [1, 2, 4, 8])
@pytest.mark.parametrize("true", range(4))
def test_the_hypothesis_with_the_true_shift_is_chosen(true: int, stride: int, side: int) -> None:
    source, target = shifted_pair(*(int(shift) for shift in SHIFTS_PX[true]), side=side)
    assert choose_hypothesis(hypotheses(stride, side=side), source, target) == true


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 20.0), (0.7, 20.0), (1.2, -10.0)])
def test_a_change_of_exposure_does_not_change_the_choice(gain: float, offset: float) -> None:
    source, target = shifted_pair(8, 4)
    exposed = np.clip(target * gain + offset, 0, 255).astype(np.uint8)
    assert choose_hypothesis(hypotheses(4), source, exposed) == 2


def test_one_hypothesis_needs_no_choice() -> None:
    assert choose_hypothesis(hypotheses(4, shifts=[(99.0, 99.0)]), *shifted_pair(0, 0)) == 0


def test_a_flow_that_leaves_the_image_never_pays() -> None:
    noise = np.random.default_rng(5).integers(0, 256, (64, 64), dtype=np.uint8)
    away = hypotheses(4, shifts=[(1.0, 0.0), (10_000.0, 0.0)])
    assert choose_hypothesis(away, noise, np.roll(noise, 1, axis=1)) == 0


def shifted_input(du: int, dv: int) -> ModelInput:
    world = make_world()
    imu = ImuSamples(world.imu.timestamps_ns, world.imu.gyro_rad_s, world.imu.accel_m_s2)
    frames = [Frame(int(world.frame_timestamps_ns[k]), world.images[k]) for k in (1, 2)]
    prepared = prepare(FramePair(frames[0], frames[1], imu, world.camera), ModelConfig())
    source, target = shifted_pair(du, dv, side=128)
    return ModelInput(source, target, prepared.window, prepared.view)


@pytest.mark.parametrize("true", range(4))
def test_corrected_or_not_the_same_hypothesis_wins(true: int) -> None:
    model_input = shifted_input(*(int(shift) for shift in SHIFTS_PX[true]))
    for enabled in (False, True):
        predicted = correct(hypotheses(4, side=128), model_input, CorrectionConfig(enabled=enabled), focal_px=60.0)
        assert predicted.hypothesis == true
        assert (predicted.correction is not None) == (predicted.measured is not None) == enabled
        np.testing.assert_allclose(predicted.flow_px.mean(axis=(0, 1)), SHIFTS_PX[true], atol=0.25)


def test_a_flow_between_the_hypotheses_is_found() -> None:
    model_input = shifted_input(4, 0)
    between = hypotheses(4, side=128, shifts=[(1.0, 0.0), (9.0, 0.0)])
    predicted = correct(between, model_input, CorrectionConfig(), focal_px=60.0)
    assert predicted.hypothesis == 0
    assert predicted.hypothesis_px.mean() == 0.5
    np.testing.assert_allclose(predicted.flow_px.mean(axis=(0, 1)), (4.0, 0.0), atol=0.3)


def test_rays_are_the_cells_centres_from_the_middle() -> None:
    rays = view_rays(2, 3, 4, 8, 12, 2.0)
    assert rays.shape == (2, 3, 2)
    np.testing.assert_allclose(rays[0, 0], [(1.5 - 5.5) / 2, (1.5 - 3.5) / 2])
    np.testing.assert_allclose(rays[1, 2], [(9.5 - 5.5) / 2, (5.5 - 3.5) / 2])
    assert not rays.flags.writeable
