"""What every network of this package returns."""

from __future__ import annotations

from typing import NamedTuple

import torch


class ViflowOutput(NamedTuple):
    """Flow hypotheses.

    Attributes:
        flow_px: [B, K, 2, h, w] in pixels of the network's input image, source to target; cell (i, j) is centred on
            input pixel ((j + 0.5) * stride - 0.5, (i + 0.5) * stride - 0.5).
        stride: input pixels for one cell (1: full resolution).
    """

    flow_px: torch.Tensor
    stride: int
