"""What every network of this package returns."""

from __future__ import annotations

from typing import NamedTuple

import torch


class RigidScene(NamedTuple):
    """The static world and the camera's motion, from which flow follows.

    Attributes:
        inverse_depth: [B, 1, h, w] along the optical axis, over its mean in the view (which is 1).
        rotation: [B, 3, 3], maps source-camera to target-camera coordinates.
        translation: [B, K, 3], X_target = rotation X_source + translation, one for each hypothesis; the unit of length
            is the inverse of the mean inverse depth.
    """

    inverse_depth: torch.Tensor
    rotation: torch.Tensor
    translation: torch.Tensor


class ViflowOutput(NamedTuple):
    """Flow hypotheses.

    Attributes:
        flow_px: [B, K, 2, h, w] in pixels of the network's input image, source to target; cell (i, j) is centred on
            input pixel ((j + 0.5) * stride - 0.5, (i + 0.5) * stride - 0.5).
        stride: input pixels for one cell (1: full resolution).
        scene: what the flow was computed from, where the network knows (preset ``calibrated``).
    """

    flow_px: torch.Tensor
    stride: int
    scene: RigidScene | None = None
