"""The compact preset: VIFlow's parts in a fully convolutional network that trains and runs on a CPU.

Global shifter: the gyro's rotation between the frames, through a learned 3x3 mounting that starts at the identity,
moves every ray exactly; the motion code adds an eight-parameter quadratic motion model for each hypothesis. Local
shifter: encoder and top-down decoder on the source image alone, each scale modulated by the motion code (the paper's
fusion, without a fixed image size). Hypotheses differ in both.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from viflow_anomaly.model.layers import FLOW_STRIDE, ConvolutionalViflow, rigid_flow
from viflow_anomaly.model.outputs import ViflowOutput

QUADRATIC_PARAMETERS = 8


class CompactViflow(ConvolutionalViflow):
    """Fully convolutional VIFlow for images of any size; its parts are those of ``ConvolutionalViflow``."""

    def __init__(self, **parts: Any) -> None:
        super().__init__(**parts)
        code_width, features = self.modulate4.linear.in_features, self.modulate4.linear.out_features // 2
        self.global_head = nn.Linear(code_width, self.hypotheses * QUADRATIC_PARAMETERS)
        self.local_head = nn.Conv2d(features, self.hypotheses * 2, 1)
        for head in (self.global_head, self.local_head):
            nn.init.normal_(head.weight, std=1e-3)
            assert head.bias is not None
            nn.init.zeros_(head.bias)

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
        code = self.motion_code(motion, interval_s, motor)
        rays = self.rays(source)
        still = rays.new_zeros(1, 1, 3)
        turned = rigid_flow(rays, rays.new_zeros(1, 1, 1, 1), self.rotation(motion, interval_s), still)
        flow = (turned + self._global_flow(code, rays) + self._local_flow(source, code, rays)) * self.focal_px
        rows, columns = -(-height // FLOW_STRIDE), -(-width // FLOW_STRIDE)
        return ViflowOutput(flow[..., :rows, :columns], stride=FLOW_STRIDE)

    def _global_flow(self, code: torch.Tensor, rays: torch.Tensor) -> torch.Tensor:
        """Quadratic motion model [B, K, 2, h, w] in focal lengths: affine + (a x + b y) (x, y)."""
        x, y = rays[0]
        ones, zeros = torch.ones_like(x), torch.zeros_like(x)
        basis = torch.stack(
            [
                torch.stack([ones, x, y, zeros, zeros, zeros, x * x, x * y]),
                torch.stack([zeros, zeros, zeros, ones, x, y, x * y, y * y]),
            ]
        )  # 2, 8, h, w
        parameters = self.global_head(code).unflatten(-1, (self.hypotheses, QUADRATIC_PARAMETERS))
        return torch.einsum("bkp,cphw->bkchw", parameters, basis)

    def _local_flow(self, source: torch.Tensor, code: torch.Tensor, rays: torch.Tensor) -> torch.Tensor:
        """Shifts [B, K, 2, h, w] in focal lengths, from the source image and the motion code."""
        shifts: torch.Tensor = self.local_head(self.features(source, code, rays))
        return shifts.reshape(len(shifts), self.hypotheses, 2, *shifts.shape[-2:])
