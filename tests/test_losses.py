"""Warping and the unsupervised losses, on shifts whose answer is known."""

from __future__ import annotations

import pytest
import torch
from worlds import textured_image

from viflow_anomaly.losses import (
    photometric_loss,
    squared_error_loss,
    warp,
    winner_take_all,
)
from viflow_anomaly.model.outputs import ViflowOutput

SHIFTS_PX = [(0.0, 0.0), (-8.0, 0.0), (8.0, 4.0), (4.0, -8.0)]


def flow_of(du: float, dv: float, height: int, width: int, *, batch: int = 1) -> torch.Tensor:
    return torch.tensor([du, dv]).view(1, 2, 1, 1).expand(batch, 2, height, width).contiguous()


def shifted_pair(du: int, dv: int, *, side: int = 64, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """source and target [1, 1, side, side] in 0..1: what is at p in the source is at p + (du, dv) in the target."""
    margin = 16
    texture = torch.from_numpy(textured_image(side + 2 * margin, side + 2 * margin, seed=seed)).float() / 255

    def window(x: int, y: int) -> torch.Tensor:
        return texture[y : y + side, x : x + side][None, None].clone()

    return window(margin, margin), window(margin - du, margin - dv)


def hypotheses(stride: int, *, side: int = 64, shifts: list[tuple[float, float]] = SHIFTS_PX) -> ViflowOutput:
    cells = -(-side // stride)
    return ViflowOutput(torch.stack([flow_of(du, dv, cells, cells) for du, dv in shifts], dim=1), stride)


def test_a_whole_pixel_shift_is_exact_and_knows_what_is_inside() -> None:
    image = torch.rand(2, 3, 6, 8, generator=torch.Generator().manual_seed(0))
    sampled, inside = warp(image, flow_of(2, -1, 6, 8, batch=2))
    torch.testing.assert_close(sampled[:, :, 1:, :6], image[:, :, :-1, 2:], atol=1e-6, rtol=0)
    assert sampled.shape == image.shape
    expected = torch.zeros(2, 1, 6, 8, dtype=torch.bool)
    expected[:, :, 1:, :6] = True
    assert torch.equal(inside, expected)
    torch.testing.assert_close(sampled[:, :, 1:, 6:], image[:, :, :-1, 7:].expand(-1, -1, -1, 2))


def test_no_flow_is_the_image_and_all_of_it_is_inside() -> None:
    image = torch.rand(1, 1, 5, 7, generator=torch.Generator().manual_seed(0))
    sampled, inside = warp(image, flow_of(0, 0, 5, 7))
    torch.testing.assert_close(sampled, image, atol=1e-6, rtol=0)
    assert bool(inside.all())


def test_half_a_pixel_is_the_mean_of_two() -> None:
    image = torch.rand(1, 1, 5, 7, generator=torch.Generator().manual_seed(0))
    sampled, _ = warp(image, flow_of(0.5, 0, 5, 7))
    torch.testing.assert_close(sampled[..., :6], (image[..., :6] + image[..., 1:]) / 2, atol=1e-6, rtol=0)


def test_warp_has_the_right_gradient() -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(1, 1, 5, 6, dtype=torch.float64, generator=generator).requires_grad_()
    # Away from whole pixels, where bilinear sampling has a kink.
    flow = (torch.rand(1, 2, 5, 6, dtype=torch.float64, generator=generator) * 0.6 + 0.2).requires_grad_()
    assert torch.autograd.gradcheck(lambda i, f: warp(i, f)[0], (image, flow))


def test_the_winner_takes_all() -> None:
    errors = torch.tensor([[3.0, 1.0, 2.0], [4.0, 6.0, 5.0]], requires_grad=True)
    loss, winners = winner_take_all(errors)
    loss.backward()
    assert winners.tolist() == [1, 0]
    assert loss.item() == pytest.approx(2.5)
    torch.testing.assert_close(errors.grad, torch.tensor([[0, 0.5, 0], [0.5, 0, 0]]))


def test_relaxation_keeps_the_losers_alive() -> None:
    errors = torch.tensor([[3.0, 1.0, 2.0], [4.0, 6.0, 5.0]], requires_grad=True)
    loss, winners = winner_take_all(errors, relaxation=0.25)
    loss.backward()
    assert winners.tolist() == [1, 0]
    assert loss.item() == pytest.approx(0.75 * 2.5 + 0.25 * 3.5)
    share = 0.25 / 6
    torch.testing.assert_close(
        errors.grad, torch.tensor([[share, share + 0.375, share], [share + 0.375, share, share]])
    )


def test_squared_error_is_the_sum_of_squares() -> None:
    generator = torch.Generator().manual_seed(0)
    source, target = torch.rand(2, 3, 1, 6, 6, generator=generator)
    result = squared_error_loss(ViflowOutput(torch.zeros(3, 1, 2, 6, 6), 1), source, target)
    expected = float((source - target).square().sum()) / 3
    assert result.loss.item() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("true", range(4))
def test_squared_error_finds_the_true_shift(true: int) -> None:
    du, dv = SHIFTS_PX[true]
    source, target = shifted_pair(int(du), int(dv))
    assert squared_error_loss(hypotheses(1), source, target).winners.tolist() == [true]


@pytest.mark.parametrize("stride", [2, 4, 8])
@pytest.mark.parametrize("true", range(4))
def test_photometric_loss_is_least_for_the_true_flow(true: int, stride: int) -> None:
    source, target = shifted_pair(*(int(shift) for shift in SHIFTS_PX[true]))
    losses = [
        photometric_loss(hypotheses(stride, shifts=[shift]), source, target, relaxation=0.0).loss.item()
        for shift in SHIFTS_PX
    ]
    assert losses.index(min(losses)) == true
    assert losses[true] < 0.6 * min(loss for k, loss in enumerate(losses) if k != true)
    assert photometric_loss(hypotheses(stride), source, target, relaxation=0.0).winners.tolist() == [true]


@pytest.mark.parametrize(("gain", "bias"), [(1.0, 0.2), (0.7, 0.2), (1.4, -0.1)])
def test_photometric_loss_does_not_mind_gain_and_bias(gain: float, bias: float) -> None:
    source, target = shifted_pair(8, 4)
    true, wrong = hypotheses(4, shifts=[(8.0, 4.0)]), hypotheses(4, shifts=[(0.0, 0.0)])
    exposed = gain * target + bias
    least = photometric_loss(true, source, exposed, relaxation=0.0).loss.item()
    plain = photometric_loss(true, source, target, relaxation=0.0).loss.item()
    other = photometric_loss(wrong, source, target, relaxation=0.0).loss.item()
    # Not quite nothing: the deviation is floored, so that a flat image does not become noise.
    assert abs(least - plain) < (1e-4 if gain == 1.0 else 0.1 * other)


def test_photometric_loss_of_flow_that_leaves_the_image_is_finite() -> None:
    source, target = shifted_pair(0, 0)
    output = hypotheses(4, shifts=[(1000.0, 0.0)])
    assert torch.isfinite(photometric_loss(output, source, target, relaxation=0.0).loss)


def test_photometric_loss_pulls_the_flow_towards_the_truth() -> None:
    source, target = shifted_pair(4, 0)
    flow = hypotheses(4, shifts=[(3.0, 0.0)]).flow_px.requires_grad_()
    photometric_loss(ViflowOutput(flow, 4), source, target, relaxation=0.0).loss.backward()
    assert flow.grad is not None
    assert flow.grad[0, 0, 0].mean() < 0


def test_flat_images_cost_next_to_nothing_and_give_no_nan() -> None:
    flat = torch.full((1, 1, 64, 64), 0.5)
    flow = hypotheses(4).flow_px.requires_grad_()
    loss = photometric_loss(ViflowOutput(flow, 4), flat, flat, relaxation=0.05).loss
    loss.backward()
    assert loss.item() < 0.05
    assert flow.grad is not None
    assert bool(torch.isfinite(flow.grad).all())


def test_a_flow_that_leaves_the_image_never_pays() -> None:
    generator = torch.Generator().manual_seed(5)
    source = torch.rand(1, 1, 64, 96, generator=generator)
    target = torch.roll(source, 1, dims=3)
    flow = torch.zeros(1, 4, 2, 16, 24)
    flow[:, 2] = 10_000.0
    flow[:, 3, 0] = 1.0
    assert int(photometric_loss(ViflowOutput(flow, 4), source, target, relaxation=0.0).winners) != 2
    away = photometric_loss(ViflowOutput(flow[:, 2:3], 4), source, target, relaxation=0.0).loss
    right = photometric_loss(ViflowOutput(flow[:, 3:4], 4), source, target, relaxation=0.0).loss
    assert float(away) > float(right) > 0.0
