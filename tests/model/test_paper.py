"""The paper's network: its sizes, and which weights a hypothesis owns."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from viflow_anomaly.losses import squared_error_loss
from viflow_anomaly.model.paper import PaperViflow

KITTI_NUMBERS = 20 * 6


@pytest.fixture(scope="module")
def small() -> PaperViflow:
    """Two hypotheses on 32x32 px: the fusion stays small."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        return PaperViflow(motion_rows=2, hypotheses=2, image_size=(32, 32))


def linear(numbers_in: int, numbers_out: int) -> int:
    return numbers_in * numbers_out + numbers_out


def convolution(filters_in: int, filters_out: int, side: int) -> int:
    return filters_in * filters_out * side * side + filters_out


def test_the_number_of_parameters_is_that_of_the_papers_layers() -> None:
    with torch.device("meta"):
        network = PaperViflow(motion_rows=20, hypotheses=1)
    trunk = linear(KITTI_NUMBERS, 512) + linear(512, 4096) + linear(4096, 4096) + linear(4096, 512)
    affine = linear(512, 6)
    encoder = sum(convolution(*pair, 5) for pair in [(1, 32), (32, 64), (64, 128), (128, 256), (256, 512)])
    code = 512 * 7 * 7  # 224 px halved five times
    fusion = linear(code + 512, 4096) + linear(4096, code)
    decoder = sum(convolution(*pair, 5) for pair in [(512, 512), (512, 256), (256, 128), (128, 64), (64, 32)])
    shifts = convolution(32, 2, 3)
    parts = {
        "global_shifter": trunk + affine,
        "encoder": encoder,
        "fusion": fusion,
        "decoders": decoder + shifts,
    }
    found = {name: sum(p.numel() for p in part.parameters()) for name, part in network.named_children()}
    assert found == parts
    assert sum(found.values()) == 243_953_448


@pytest.mark.parametrize("hypotheses", [1, 4, 8])
def test_shapes_at_the_papers_size(hypotheses: int) -> None:
    with torch.device("meta"):
        network = PaperViflow(motion_rows=20, hypotheses=hypotheses).to("meta")
        output = network(torch.empty(3, 1, 224, 224), torch.empty(3, 20, 6), torch.empty(3))
    assert output.flow_px.shape == (3, hypotheses, 2, 224, 224)
    assert output.stride == 1


def test_a_hypothesis_adds_its_affine_layer_and_its_decoder_only() -> None:
    with torch.device("meta"):
        counts = [sum(p.numel() for p in PaperViflow(motion_rows=20, hypotheses=k).parameters()) for k in (1, 4)]
        one = PaperViflow(motion_rows=20, hypotheses=1)
    own = [one.global_shifter.affine, one.decoders]
    assert counts[1] - counts[0] == 3 * sum(p.numel() for part in own for p in part.parameters())


def random_input(batch: int = 1, side: int = 32) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    source = torch.rand(batch, 1, side, side, generator=generator)
    return source, torch.randn(batch, 2, 6, generator=generator), torch.full((batch,), 0.05)


def test_at_the_start_the_global_part_is_the_identity(small: PaperViflow) -> None:
    source, motion, interval_s = random_input(2)
    with torch.no_grad():
        code, matrices = small.global_shifter(motion)
        fused = small.fusion(torch.cat([small.encoder(source).flatten(1), code], dim=1)).unflatten(1, small.code_shape)
        local = torch.stack([decoder(fused) for decoder in small.decoders], dim=1)
        flow = small(source, motion, interval_s).flow_px
    torch.testing.assert_close(matrices, torch.tensor([[1.0, 0, 0], [0, 1.0, 0]]).expand(2, 2, 2, 3))
    torch.testing.assert_close(flow, local, atol=1e-5, rtol=0)
    assert (flow[:, 0] - flow[:, 1]).abs().max() > 1e-6


def test_the_affine_part_is_in_pixels_of_the_image() -> None:
    with torch.random.fork_rng(devices=[]):
        network = PaperViflow(motion_rows=2, hypotheses=1, image_size=(32, 64))
    affine = network.global_shifter.affine[0]
    with torch.no_grad():
        assert isinstance(affine, nn.Linear)
        affine.bias.copy_(torch.tensor([1.0, 0.0, 0.5, 0.0, 1.1, 0.0]))
        for parameter in network.decoders.parameters():
            parameter.zero_()
        flow = network(torch.rand(1, 1, 32, 64), torch.zeros(1, 2, 6), torch.zeros(1)).flow_px[0, 0]
    torch.testing.assert_close(flow[0], torch.full((32, 64), 0.5 * 31.5))
    rows = (torch.arange(32.0) - 15.5) * 0.1
    torch.testing.assert_close(flow[1], rows[:, None].expand(32, 64), atol=1e-5, rtol=0)


def test_only_the_winner_learns(small: PaperViflow) -> None:
    source, motion, interval_s = random_input()
    target = torch.rand(1, 1, 32, 32, generator=torch.Generator().manual_seed(1))
    small.zero_grad()
    result = squared_error_loss(small(source, motion, interval_s), source, target)
    result.loss.backward()
    winner = int(result.winners)
    for hypothesis in range(2):
        parts: list[nn.Module] = [small.global_shifter.affine[hypothesis], small.decoders[hypothesis]]
        assert [learns(part) for part in parts] == [hypothesis == winner] * 2
    assert all(learns(part) for part in (small.encoder, small.fusion, small.global_shifter.trunk))


def learns(part: nn.Module) -> bool:
    return any(p.grad is not None and bool(p.grad.abs().max() > 0) for p in part.parameters())
