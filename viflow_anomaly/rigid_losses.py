"""The unsupervised loss of the preset ``calibrated``: hypotheses compete, depth is judged under the corrected motion.

The IMU cannot see speed, so no hypothesis fits a pair exactly, and depth judged by the winner alone would learn to make
up for a wrong translation. So the winner's motion is first corrected on the target image, with the same function that
the detector uses and without gradient; the depth map is judged by the flow it gives under that motion.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812  # torch's own convention

from viflow_anomaly.batch import Batch
from viflow_anomaly.config import CorrectionConfig
from viflow_anomaly.correction import RigidMotion, correct_motion
from viflow_anomaly.losses import LossResult, photometric_error, photometric_loss
from viflow_anomaly.model.layers import rigid_flow
from viflow_anomaly.model.outputs import RigidScene, ViflowOutput

MEASURED_WEIGHT = 1.0
TRANSLATION_WEIGHT = 0.2
SMOOTHNESS_WEIGHT = 0.02
MEASURED_TOLERANCE_PX = 0.5


def corrected_loss(
    output: ViflowOutput, batch: Batch, rays: torch.Tensor, *, focal_px: float, relaxation: float
) -> LossResult:
    """Photometric error of the hypotheses (winner takes all) and of the corrected motion, measured flow, smooth depth.

    Args:
        output: of the preset ``calibrated``.
        batch: with ``measured`` flow.
        rays: [1, 2, h, w] of the output's cells, in focal lengths.
        focal_px: of the view.
        relaxation: as in ``photometric_loss``.
    """
    scene = output.scene
    assert scene is not None
    # Depth learns under the corrected motion only: judged by hypotheses it would make up for their wrong translations.
    flow_px = rigid_flow(rays, scene.inverse_depth.detach(), scene.rotation, scene.translation) * focal_px
    hypotheses = ViflowOutput(flow_px, output.stride)
    competition = photometric_loss(hypotheses, batch.source, batch.target, relaxation=relaxation)
    rotation, translation, trusted = _corrected(scene, competition.winners, batch, rays, focal_px)
    flow_px = rigid_flow(rays, scene.inverse_depth, rotation, translation.unsqueeze(1))[:, 0] * focal_px
    photometric = photometric_error(flow_px, batch.source, batch.target, stride=output.stride)
    loss = competition.loss + (trusted * photometric).mean()
    loss = loss + MEASURED_WEIGHT * (trusted * _measured_error(flow_px, batch)).mean()
    chosen = scene.translation[torch.arange(len(translation)), competition.winners]
    missed = (chosen - translation).norm(dim=-1) / (translation.norm(dim=-1) + 0.005)
    loss = loss + TRANSLATION_WEIGHT * (trusted * missed.clamp_max(3.0)).mean()
    loss = loss + SMOOTHNESS_WEIGHT * _roughness(scene.inverse_depth, batch.source, output.stride)
    return LossResult(loss, competition.winners)


def _corrected(
    scene: RigidScene, winners: torch.Tensor, batch: Batch, rays: torch.Tensor, focal_px: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rotation [B, 3, 3], translation [B, 3] and whether the correction converged [B], without gradient."""
    config = CorrectionConfig(depth_rounds=0)  # only the motion is wanted
    rays_of_cells = np.ascontiguousarray(rays[0].permute(1, 2, 0).cpu().numpy())
    depth = scene.inverse_depth.detach().float().cpu().numpy()[:, 0]
    rotations = scene.rotation.detach().double().cpu().numpy()
    chosen = scene.translation.detach()[torch.arange(len(winners)), winners].double().cpu().numpy()
    motions, trusted = [], []
    for index, measured in enumerate(batch.measured):
        start = RigidMotion(rotations[index], chosen[index])
        correction = correct_motion(rays_of_cells, depth[index], start, measured, focal_px, config)
        motions.append(correction.motion or start)
        trusted.append(float(correction.converged))
    like = scene.inverse_depth
    return (
        like.new_tensor(np.stack([motion.rotation for motion in motions])),
        like.new_tensor(np.stack([motion.translation for motion in motions])),
        like.new_tensor(trusted),
    )


def _measured_error(flow_px: torch.Tensor, batch: Batch) -> torch.Tensor:
    """Robust distance [B] to the measured flow; large errors, as of movers, cost logarithmically."""
    measured = flow_px.new_tensor(np.stack([one.flow_px for one in batch.measured])).permute(0, 3, 1, 2)
    confidence = flow_px.new_tensor(np.stack([one.confidence for one in batch.measured]))
    squared = (flow_px - measured).square().sum(dim=1) / MEASURED_TOLERANCE_PX**2
    return (confidence * torch.log1p(squared)).mean(dim=(1, 2))


def _roughness(inverse_depth: torch.Tensor, source: torch.Tensor, stride: int) -> torch.Tensor:
    """Edge-aware first differences of the inverse depth, whose mean is 1."""
    image = F.avg_pool2d(source, stride)
    across = (inverse_depth.diff(dim=3).abs() * torch.exp(-10 * image.diff(dim=3).abs())).mean()
    down = (inverse_depth.diff(dim=2).abs() * torch.exp(-10 * image.diff(dim=2).abs())).mean()
    return across + down
