"""The calibrated loss: least where depth and motion are the world's, gradients that go the right way."""

from __future__ import annotations

import numpy as np
import torch
from worlds import textured_image

from viflow_anomaly.batch import Batch
from viflow_anomaly.correction import RigidMotion, rigid_flow_px
from viflow_anomaly.losses import LossResult
from viflow_anomaly.measured_flow import MeasuredFlow
from viflow_anomaly.model.layers import rigid_flow
from viflow_anomaly.model.outputs import RigidScene, ViflowOutput
from viflow_anomaly.prediction import view_rays
from viflow_anomaly.rigid_losses import corrected_loss

FOCAL_PX, HEIGHT, WIDTH, STRIDE = 60.0, 64, 96, 4
ROWS, COLUMNS = HEIGHT // STRIDE, WIDTH // STRIDE
RAYS = view_rays(ROWS, COLUMNS, STRIDE, HEIGHT, WIDTH, FOCAL_PX)
TRANSLATIONS_M = ((0.2, 0.0, 0.0), (-0.2, 0.1, 0.0), (0.0, 0.0, 0.3), (0.0, 0.2, 0.0))
DEPTH_M = 3.0


def example() -> Batch:
    """A wall 3 m away, seen while the camera moves by the first translation: 4 px to the right."""
    texture = textured_image(WIDTH + 32, HEIGHT, seed=2)
    images = [texture[:, start : start + WIDTH] for start in (16, 12)]
    source, target = (torch.from_numpy(np.ascontiguousarray(one)).float()[None, None] / 255 for one in images)
    flow = np.zeros((ROWS, COLUMNS, 2), np.float32)
    flow[..., 0] = FOCAL_PX / DEPTH_M * TRANSLATIONS_M[0][0]
    measured = MeasuredFlow(flow, np.ones((ROWS, COLUMNS), np.float32), STRIDE)
    return Batch(source, target, torch.zeros(1, 16, 6), torch.tensor([0.05]), measured=(measured,))


def loss_of(inverse_depth: torch.Tensor, batch: Batch) -> LossResult:
    rays = torch.from_numpy(np.array(RAYS)).permute(2, 0, 1)[None]
    rotation, translations = torch.eye(3)[None], torch.tensor(TRANSLATIONS_M)[None]
    flow = rigid_flow(rays, inverse_depth, rotation, translations) * FOCAL_PX
    output = ViflowOutput(flow, STRIDE, RigidScene(inverse_depth, rotation, translations))
    return corrected_loss(output, batch, rays, focal_px=FOCAL_PX, relaxation=0.05)


def wall(noise: float = 0.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(4)
    return 1 / DEPTH_M * torch.exp(noise * torch.randn(1, 1, ROWS, COLUMNS, generator=generator))


def test_the_flow_of_the_wall_is_what_was_measured() -> None:
    flow = rigid_flow_px(RAYS, wall()[0, 0].numpy(), RigidMotion(np.eye(3), np.array(TRANSLATIONS_M[0])), FOCAL_PX)
    np.testing.assert_allclose(flow, example().measured[0].flow_px, atol=1e-4)


def test_the_true_depth_costs_least_and_the_true_translation_wins() -> None:
    batch = example()
    true = loss_of(wall(), batch)
    assert true.winners.tolist() == [0]
    for noise in (0.2, 0.6):
        assert float(loss_of(wall(noise), batch).loss) > float(true.loss) + 0.1 * noise


def test_the_gradient_leads_to_the_true_depth() -> None:
    batch = example()
    raw = torch.log(wall(0.5)).requires_grad_()
    optimizer = torch.optim.Adam([raw], lr=0.05)
    for _ in range(60):
        optimizer.zero_grad()
        loss_of(torch.exp(raw), batch).loss.backward()
        optimizer.step()
    middle = torch.exp(raw.detach())[0, 0, 2:-2, 2:-4]
    # The scale is the motion's to choose: depth is judged by how even the wall has become.
    assert float(middle.std() / middle.mean()) < 0.5 * float(wall(0.5).std() / wall(0.5).mean())


def test_an_example_that_cannot_be_corrected_still_has_a_finite_loss() -> None:
    batch = example()
    nothing = MeasuredFlow(np.zeros((ROWS, COLUMNS, 2), np.float32), np.zeros((ROWS, COLUMNS), np.float32), STRIDE)
    depth = wall(0.3).requires_grad_()
    loss = loss_of(depth, batch._replace(measured=(nothing,))).loss
    loss.backward()
    assert bool(torch.isfinite(loss))
    assert depth.grad is not None
    assert bool(torch.isfinite(depth.grad).all())
