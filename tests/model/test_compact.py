"""The compact network: any size, its share of gradient, and the rotation that it does not have to learn."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch import nn

from viflow_anomaly.config import ModelConfig
from viflow_anomaly.geometry import so3_exp
from viflow_anomaly.losses import photometric_loss
from viflow_anomaly.model.builder import build_model
from viflow_anomaly.model.compact import QUADRATIC_PARAMETERS, CompactViflow

CONFIG = ModelConfig(preset="compact")
MAX_WEIGHTS_BYTES = 8 * 1024 * 1024


def compact(seed: int = 0, hypotheses: int = 4) -> CompactViflow:
    network = build_model(CONFIG.model_copy(update={"hypotheses": hypotheses}), seed=seed)
    assert isinstance(network, CompactViflow)
    return network


def random_input(batch: int, height: int, width: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    source = torch.rand(batch, 1, height, width, generator=generator)
    motion = 0.3 * torch.randn(batch, CONFIG.motion_window.rows, 6, generator=generator)
    return source, motion, torch.full((batch,), 0.05)


@pytest.mark.parametrize(("height", "width"), [(65, 65), (224, 225), (33, 97), (224, 224), (32, 32), (1, 1)])
def test_any_size(height: int, width: int) -> None:
    with torch.no_grad():
        flow, stride, _ = compact()(*random_input(2, height, width))
    assert flow.shape == (2, 4, 2, -(-height // 4), -(-width // 4))
    assert stride == 4
    assert bool(torch.isfinite(flow).all())


@pytest.mark.parametrize("hypotheses", [1, 4, 8])
def test_hypotheses_differ_and_their_number_is_asked_for(hypotheses: int) -> None:
    with torch.no_grad():
        flow = compact(hypotheses=hypotheses)(*random_input(1, 32, 64)).flow_px
    assert flow.shape[1] == hypotheses
    for first in range(hypotheses):
        for second in range(first):
            assert (flow[:, first] - flow[:, second]).abs().max() > 1e-4


def test_only_the_winners_rows_of_the_heads_learn() -> None:
    network = compact()
    source, motion, interval_s = random_input(1, 32, 64)
    target = torch.rand(1, 1, 32, 64, generator=torch.Generator().manual_seed(1))
    result = photometric_loss(network(source, motion, interval_s), source, target, relaxation=0.0)
    result.loss.backward()
    for head, rows in ((network.global_head, QUADRATIC_PARAMETERS), (network.local_head, 2)):
        assert isinstance(head, nn.Module)
        assert isinstance(head.weight.grad, torch.Tensor)
        by_hypothesis = head.weight.grad.reshape(4, rows, -1).abs().amax(dim=(1, 2))
        learns = (by_hypothesis > 0).tolist()
        assert learns == [k == int(result.winners) for k in range(4)]
    shared = [network.motion_encoder, network.encode4, network.encode32, network.decode8, network.mounting]
    for part in shared:
        assert all(p.grad is not None and bool(p.grad.abs().max() > 0) for p in part.parameters())


def test_with_relaxation_every_hypothesis_learns() -> None:
    network = compact()
    source, motion, interval_s = random_input(1, 32, 64)
    target = torch.rand(1, 1, 32, 64, generator=torch.Generator().manual_seed(1))
    photometric_loss(network(source, motion, interval_s), source, target, relaxation=0.1).loss.backward()
    assert isinstance(network.global_head.weight.grad, torch.Tensor)
    assert bool((network.global_head.weight.grad.reshape(4, -1).abs().amax(dim=1) > 0).all())


def test_untrained_heads_leave_the_gyros_rotation_exactly() -> None:
    network = compact()
    for head in (network.global_head, network.local_head):
        nn.init.zeros_(head.weight)
    rate_rad_s, interval_s = np.array([0.4, -1.2, 0.8]), 0.05
    motion = torch.zeros(1, CONFIG.motion_window.rows, 6)
    motion[:, -CONFIG.motion_window.samples_between :, :3] = torch.tensor(rate_rad_s, dtype=torch.float32)
    with torch.no_grad():
        flow = network(torch.rand(1, 1, 64, 96), motion, torch.tensor([interval_s])).flow_px[0]
    focal_px, middle = CONFIG.view.focal_px, np.array([47.5, 31.5])
    cells = np.stack(np.meshgrid(np.arange(24), np.arange(16)), axis=-1) * 4 + 1.5
    rays = np.concatenate([(cells - middle) / focal_px, np.ones((16, 24, 1))], axis=-1)
    turned = rays @ so3_exp(-rate_rad_s * interval_s).T
    expected = turned[..., :2] / turned[..., 2:] * focal_px + middle - cells
    assert np.abs(expected).max() > 5
    for hypothesis in flow:
        np.testing.assert_allclose(hypothesis.permute(1, 2, 0).numpy(), expected, atol=1e-3)


def test_no_motion_at_all_has_a_finite_gradient() -> None:
    network = compact()
    source = torch.rand(1, 1, 32, 32)
    output = network(source, torch.zeros(1, CONFIG.motion_window.rows, 6), torch.tensor([0.05]))
    photometric_loss(output, source, source, relaxation=0.05).loss.backward()
    assert all(bool(torch.isfinite(p.grad).all()) for p in network.parameters() if p.grad is not None)


def test_two_threads_get_what_one_gets() -> None:
    network = compact().eval()
    inputs = [random_input(1, 64, 64), random_input(1, 33, 97)]

    def run(index: int) -> torch.Tensor:
        with torch.no_grad():
            flow: torch.Tensor = network(*inputs[index % 2]).flow_px
        return flow

    alone = [run(0), run(1)]
    before = {name: value.clone() for name, value in network.state_dict().items()}
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(run, range(8)))
    for index, flow in enumerate(together):
        assert torch.equal(flow, alone[index % 2])
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


def test_an_example_does_not_depend_on_its_batch() -> None:
    network = compact()
    source, motion, interval_s = random_input(3, 32, 64)
    with torch.no_grad():
        together = network(source, motion, interval_s).flow_px
        alone = network(source[1:2], motion[1:2], interval_s[1:2]).flow_px
    torch.testing.assert_close(together[1:2], alone, atol=1e-4, rtol=1e-4)


def test_the_weights_are_small_enough_to_ship() -> None:
    network = compact(hypotheses=8)
    assert sum(p.numel() * p.element_size() for p in network.parameters()) <= MAX_WEIGHTS_BYTES
