"""Bilinear warping and the unsupervised losses: photometric error of each hypothesis, winner takes all [Approach]."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812  # torch's own convention

from viflow_anomaly.model.outputs import ViflowOutput

FARTHEST = 1e4
"""Half image sides at which a coordinate is far enough outside: torch's gradient crashes at what no integer holds."""
CHARBONNIER_EPSILON = 0.01
"""In the normalised intensities of ``photometric_loss``, about one gray level."""


class LossResult(NamedTuple):
    """loss: scalar; winners: [B] index of the hypothesis that reconstructed each example best."""

    loss: torch.Tensor
    winners: torch.Tensor


def warp(image: torch.Tensor, flow_px: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Sample ``image`` at each pixel plus flow, bilinearly; pixel centres lie at integer coordinates.

    Args:
        image: [B, C, H, W].
        flow_px: [B, 2, H, W] (du, dv) in pixels.

    Returns:
        sampled [B, C, H, W] (border repeated) and inside [B, 1, H, W] bool.
    """
    height, width = image.shape[-2:]
    x = torch.arange(width, device=image.device, dtype=flow_px.dtype) + flow_px[:, 0]
    y = torch.arange(height, device=image.device, dtype=flow_px.dtype)[:, None] + flow_px[:, 1]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    grid = torch.stack([2 * x / (width - 1) - 1, 2 * y / (height - 1) - 1], dim=-1)
    grid = grid.clamp(-FARTHEST, FARTHEST)
    sampled = F.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=True)
    return sampled, inside.unsqueeze(1)


def winner_take_all(errors: torch.Tensor, *, relaxation: float = 0.0) -> LossResult:
    """The least error of each example, averaged; only its hypothesis receives gradient.

    Args:
        errors: [B, K].
        relaxation: weight of the mean over all hypotheses, which keeps losers alive (0: the paper's loss).
    """
    best, winners = errors.min(dim=1)
    loss = best.mean()
    if relaxation:
        loss = (1 - relaxation) * loss + relaxation * errors.mean()
    return LossResult(loss, winners)


def squared_error_loss(output: ViflowOutput, source: torch.Tensor, target: torch.Tensor) -> LossResult:
    """The paper's loss: squared Euclidean error of each reconstruction, winner takes all.

    Args:
        output: full-resolution hypotheses (stride 1).
        source, target: [B, 1, H, W] in 0..1.
    """
    flow = output.flow_px
    hypotheses = flow.shape[1]
    errors = []
    for k in range(hypotheses):
        reconstruction, _ = warp(target, flow[:, k])
        errors.append((reconstruction - source).square().sum(dim=(1, 2, 3)))
    return winner_take_all(torch.stack(errors, dim=1))


def photometric_loss(
    output: ViflowOutput, source: torch.Tensor, target: torch.Tensor, *, relaxation: float
) -> LossResult:
    """Charbonnier error over a pyramid, winner takes all with a relaxation.

    All hypotheses compete on the flow's own grid and at half of it; the winner alone is also judged at twice the
    grid's resolution. Images are normalised to mean 0 and deviation 1, so that a change of exposure costs nothing.

    Args:
        output: hypotheses of an even stride S.
        source, target: [B, 1, H, W], H and W multiples of 2 S.
        relaxation: weight of the mean over all hypotheses.
    """
    flow, stride = output.flow_px, output.stride
    batch, hypotheses = flow.shape[:2]
    source, target = _normalised(source), _normalised(target)
    errors = flow.new_zeros(batch, hypotheses)
    for shrink, weight in ((stride * 2, 0.5), (stride, 1.0)):
        level_flow = flow.flatten(0, 1) / shrink
        if shrink != stride:
            level_flow = F.avg_pool2d(level_flow, shrink // stride)
        level_source = F.avg_pool2d(source, shrink).repeat_interleave(hypotheses, dim=0)
        level_target = F.avg_pool2d(target, shrink).repeat_interleave(hypotheses, dim=0)
        errors = errors + weight * _charbonnier(level_source, level_target, level_flow).view(batch, -1)
    _, winners = errors.min(dim=1)
    winning = flow[torch.arange(batch, device=flow.device), winners]
    fine = stride // 2
    fine_flow = F.interpolate(winning, scale_factor=2.0, mode="bilinear", align_corners=False) / fine
    fine_error = _charbonnier(F.avg_pool2d(source, fine), F.avg_pool2d(target, fine), fine_flow)
    coarse = winner_take_all(errors, relaxation=relaxation)
    return LossResult(coarse.loss + fine_error.mean(), winners)


def photometric_error(
    flow_px: torch.Tensor, source: torch.Tensor, target: torch.Tensor, *, stride: int
) -> torch.Tensor:
    """Charbonnier error [B] of one flow [B, 2, h, w], on its own grid and on every doubled one down to the pixels."""
    source, target = _normalised(source), _normalised(target)
    error = flow_px.new_zeros(len(flow_px))
    while True:
        level = (source, target) if stride == 1 else (F.avg_pool2d(source, stride), F.avg_pool2d(target, stride))
        error = error + _charbonnier(*level, flow_px / stride)
        if stride == 1:
            return error
        flow_px = F.interpolate(flow_px, scale_factor=2.0, mode="bilinear", align_corners=False)
        stride //= 2


def _normalised(image: torch.Tensor) -> torch.Tensor:
    centred = image - image.mean(dim=(1, 2, 3), keepdim=True)
    deviation = centred.square().mean(dim=(1, 2, 3), keepdim=True).sqrt()
    return centred / (deviation + 0.02)


def _charbonnier(source: torch.Tensor, target: torch.Tensor, flow_px: torch.Tensor) -> torch.Tensor:
    """Mean error [N]; a pixel whose prediction leaves the target costs what it would had nothing moved.

    So leaving the image never pays: a hypothesis is not chosen, nor learnt, because little of it is left to judge.
    """
    reconstruction, inside = warp(target, flow_px)
    error = torch.sqrt((reconstruction - source).square() + CHARBONNIER_EPSILON**2)
    unmoved = torch.sqrt((target - source).square() + CHARBONNIER_EPSILON**2)
    return torch.where(inside, error, unmoved).mean(dim=(1, 2, 3))
