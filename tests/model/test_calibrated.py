"""The calibrated network: any size, flow that obeys the rigid motion field, gradient of the winner alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from viflow_anomaly.config import ModelConfig
from viflow_anomaly.correction import RigidMotion, rigid_flow_px
from viflow_anomaly.geometry import so3_exp
from viflow_anomaly.losses import photometric_loss
from viflow_anomaly.model.builder import build_model
from viflow_anomaly.model.calibrated import CalibratedViflow
from viflow_anomaly.model.outputs import ViflowOutput
from viflow_anomaly.prediction import view_rays

CONFIG = ModelConfig(preset="calibrated", hypotheses=4)


def calibrated(seed: int = 0) -> CalibratedViflow:
    network = build_model(CONFIG, seed=seed)
    assert isinstance(network, CalibratedViflow)
    return network


def random_input(batch: int, height: int, width: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    source = torch.rand(batch, 1, height, width, generator=generator)
    motion = 0.3 * torch.randn(batch, CONFIG.motion_window.rows, 6, generator=generator)
    return source, motion, torch.full((batch,), 0.05)


@pytest.mark.parametrize(("height", "width"), [(65, 65), (224, 225), (33, 97), (32, 32), (1, 1)])
def test_any_size(height: int, width: int) -> None:
    with torch.no_grad():
        flow, stride, scene = calibrated()(*random_input(2, height, width))
    rows, columns = -(-height // 4), -(-width // 4)
    assert (flow.shape, stride) == ((2, 4, 2, rows, columns), 4)
    assert scene is not None
    assert scene.inverse_depth.shape == (2, 1, rows, columns)
    assert (scene.rotation.shape, scene.translation.shape) == ((2, 3, 3), (2, 4, 3))
    assert bool((scene.inverse_depth > 0).all())
    assert bool(torch.isfinite(flow).all())


def test_the_flow_is_that_of_its_scene() -> None:
    source, motion, interval_s = random_input(1, 64, 96)
    with torch.no_grad():
        output: ViflowOutput = calibrated()(source, motion, interval_s)
    assert output.scene is not None
    inverse_depth, rotation, translation = (one[0].double().numpy() for one in output.scene)
    rays = view_rays(16, 24, 4, 64, 96, CONFIG.view.focal_px)
    for k in range(4):
        expected = rigid_flow_px(
            rays, inverse_depth[0].astype(np.float32), RigidMotion(rotation, translation[k]), CONFIG.view.focal_px
        )
        np.testing.assert_allclose(output.flow_px[0, k].permute(1, 2, 0).numpy(), expected, atol=1e-3)


def test_the_gyro_turns_the_camera_exactly() -> None:
    rate_rad_s, interval_s = np.array([0.4, -1.2, 0.8]), 0.05
    motion = torch.zeros(1, CONFIG.motion_window.rows, 6)
    motion[:, -CONFIG.motion_window.samples_between :, :3] = torch.tensor(rate_rad_s, dtype=torch.float32)
    with torch.no_grad():
        scene = calibrated()(torch.rand(1, 1, 32, 32), motion, torch.tensor([interval_s])).scene
    np.testing.assert_allclose(scene.rotation[0].numpy(), so3_exp(-rate_rad_s * interval_s), atol=1e-6)


@pytest.mark.parametrize(("height", "width"), [(64, 64), (33, 65)])
def test_the_mean_inverse_depth_is_the_unit(height: int, width: int) -> None:
    with torch.no_grad():
        scene = calibrated()(*random_input(2, height, width)).scene
    torch.testing.assert_close(scene.inverse_depth.mean(dim=(1, 2, 3)), torch.ones(2))


def test_untrained_hypotheses_lie_apart() -> None:
    with torch.no_grad():
        scene = calibrated()(*random_input(1, 64, 64)).scene
    apart = torch.cdist(scene.translation[0], scene.translation[0]) + torch.eye(4)
    assert apart.min() > 0.002


def test_only_the_winners_translation_learns() -> None:
    network = calibrated()
    source, motion, interval_s = random_input(1, 64, 96)
    target = torch.rand(1, 1, 64, 96, generator=torch.Generator().manual_seed(1))
    result = photometric_loss(network(source, motion, interval_s), source, target, relaxation=0.0)
    result.loss.backward()
    assert isinstance(network.velocity_head.weight.grad, torch.Tensor)
    learns = (network.velocity_head.weight.grad.reshape(4, -1).abs().amax(dim=1) > 0).tolist()
    assert learns == [k == int(result.winners) for k in range(4)]
    for part in (network.depth_head, network.encode4, network.encode32, network.mounting):
        assert isinstance(part, nn.Module)
        assert all(p.grad is not None and bool(p.grad.abs().max() > 0) for p in part.parameters())
