"""A network that predicts what a test tells it to."""

from __future__ import annotations

import torch
from torch import nn

from viflow_anomaly.model.outputs import ViflowOutput


class ConstantFlow(nn.Module):
    """One uniform flow a hypothesis, in pixels of the view."""

    def __init__(self, *flows: tuple[float, float], stride: int = 4) -> None:
        super().__init__()
        self.flows = torch.tensor(flows)
        self.stride = stride

    def forward(
        self, source: torch.Tensor, motion: torch.Tensor, interval_s: torch.Tensor, motor: None = None
    ) -> ViflowOutput:
        del motion, interval_s
        rows, columns = (side // self.stride for side in source.shape[-2:])
        flow = self.flows[None, :, :, None, None].expand(len(source), -1, -1, rows, columns)
        return ViflowOutput(flow.clone(), self.stride)
