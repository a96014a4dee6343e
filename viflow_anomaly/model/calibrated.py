"""The calibrated preset: inverse depth from the image, camera motion from the IMU, flow from the rigid motion field.

The view's focal length and the IMU's axes are fixed by the calibration, so the same motion and the same depth give the
same flow on every rig: weights trained on many simulated rigs run on a new one from its calibration file (the paper's
first limit [Limitations]). Global shifter: the gyro's rotation moves every ray exactly, and the motion code gives one
translation for each hypothesis, because speed does not show in a short IMU window. Local shifter: one inverse depth a
cell, from the source image alone. Flow depends on depth and translation only through their ratio, so the unit of length
is the view's own: the depth whose inverse is the mean inverse depth. Left free, the scale drifted by a thousand.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812  # torch's own convention
from torch import nn

from viflow_anomaly.model.layers import FLOW_STRIDE, ConvolutionalViflow, rigid_flow
from viflow_anomaly.model.outputs import RigidScene, ViflowOutput

FIRST_SPEED_PER_S = 0.3
"""Deviation of the untrained hypotheses' velocities along each axis, in the view's unit of length a second."""
MIN_INVERSE_DEPTH = 1e-3
"""Of the mean, before normalisation: nothing is infinitely far, so the mean is never zero."""


class CalibratedViflow(ConvolutionalViflow):
    """Depth, rotation and translation hypotheses; its parts are those of ``ConvolutionalViflow``."""

    def __init__(self, **parts: Any) -> None:
        super().__init__(**parts)
        code_width, features = self.modulate4.linear.in_features, self.modulate4.linear.out_features // 2
        self.velocity_head = nn.Linear(code_width, self.hypotheses * 3)
        nn.init.normal_(self.velocity_head.weight, std=0.02)
        nn.init.normal_(self.velocity_head.bias, std=FIRST_SPEED_PER_S)
        self.depth_head = nn.Conv2d(features, 1, 1)
        nn.init.normal_(self.depth_head.weight, std=1e-2)
        assert self.depth_head.bias is not None
        nn.init.zeros_(self.depth_head.bias)

    def forward(
        self,
        source: torch.Tensor,
        motion: torch.Tensor,
        interval_s: torch.Tensor,
        motor: torch.Tensor | None = None,
    ) -> ViflowOutput:
        """source [B, 1, H, W] in 0..1, motion [B, T, 6], interval_s [B], motor [B, M] where the network has that stream
        -> flow [B, K, 2, ceil(H/4), ceil(W/4)]."""
        height, width = source.shape[-2:]
        rows, columns = -(-height // FLOW_STRIDE), -(-width // FLOW_STRIDE)
        code = self.motion_code(motion, interval_s, motor)
        rays = self.rays(source)
        velocity = self.velocity_head(code).unflatten(-1, (self.hypotheses, 3))
        translation = velocity * interval_s[:, None, None]
        rotation = self.rotation(motion, interval_s)
        raw = self.depth_head(self.features(source, code, rays)).float()
        positive = F.softplus(raw * 3.0) + MIN_INVERSE_DEPTH
        inverse_depth = positive / positive[..., :rows, :columns].mean(dim=(2, 3), keepdim=True)
        flow = rigid_flow(rays, inverse_depth, rotation, translation) * self.focal_px
        scene = RigidScene(inverse_depth[..., :rows, :columns], rotation, translation)
        return ViflowOutput(flow[..., :rows, :columns], FLOW_STRIDE, scene)
