"""The evidence head: cues of a judged reconstruction -> which source pixels belong to something that moves.

A small U-Net of plain convolutions. It never works at full resolution: every block of 4x4 pixels brings its pixels'
photometric cues as channels and gives its pixels' logits as channels, so that edges stay sharp at a sixteenth of the
cost.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812  # torch's own convention
from torch import nn

from viflow_anomaly.config import EVIDENCE_BLOCK_PX

COARSEST_STRIDE = 32
OUTPUTS = 2
"""Motion, and seam: a moving pixel beside another moving thing, so that two that touch can be told apart."""
OFFSETS = 2
"""Of every block, in blocks down and to the right: where the middle of the thing is that it belongs to."""
OFFSET_SCALE_BLOCKS = 8.0


def _convolution(channels_in: int, channels: int, *, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(channels_in, channels, 3, stride, 1), nn.ReLU(inplace=True))


def _twice_as_fine(features: torch.Tensor) -> torch.Tensor:
    return F.interpolate(features, scale_factor=2.0, mode="nearest")


class EvidenceHead(nn.Module):
    """Cues -> logits.

    Args:
        photometric: cues of every pixel.
        geometric: cues of every block.
        widths: channels at strides 4, 8, 16 and 32.
    """

    def __init__(self, *, photometric: int, geometric: int, widths: tuple[int, int, int, int]) -> None:
        super().__init__()
        w4, w8, w16, w32 = widths
        self.mix = nn.Sequential(
            nn.Conv2d(photometric * EVIDENCE_BLOCK_PX**2 + geometric, w4, 1), nn.ReLU(inplace=True)
        )
        self.at4 = _convolution(w4, w4)
        self.at8 = nn.Sequential(_convolution(w4, w8, stride=2), _convolution(w8, w8))
        self.at16 = nn.Sequential(_convolution(w8, w16, stride=2), _convolution(w16, w16))
        self.at32 = nn.Sequential(_convolution(w16, w32, stride=2), _convolution(w32, w32))
        self.from32, self.skip16, self.merge16 = nn.Conv2d(w32, w16, 1), nn.Conv2d(w16, w16, 1), _convolution(w16, w16)
        self.from16, self.skip8, self.merge8 = nn.Conv2d(w16, w8, 1), nn.Conv2d(w8, w8, 1), _convolution(w8, w8)
        self.from8, self.skip4, self.merge4 = nn.Conv2d(w8, w4, 1), nn.Conv2d(w4, w4, 1), _convolution(w4, w4)
        self.logits = nn.Conv2d(w4, OUTPUTS * EVIDENCE_BLOCK_PX**2, 1)
        self.offsets = nn.Conv2d(w4, OFFSETS, 1)

    def forward(self, photometric: torch.Tensor, geometric: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """photometric [B, P, H, W], geometric [B, G, H/4, W/4], sides multiples of 32 -> logits [B, 2, H, W] of motion
        and of seam, offsets [B, 2, H/4, W/4] in blocks (y, x)."""
        cues = torch.cat([F.pixel_unshuffle(photometric, EVIDENCE_BLOCK_PX), geometric], dim=1)
        at4 = self.at4(self.mix(cues))  # B, w4, H/4, W/4
        at8 = self.at8(at4)
        at16 = self.at16(at8)
        at32 = self.at32(at16)
        up16 = self.merge16(F.relu(self.skip16(at16) + _twice_as_fine(self.from32(at32))))
        up8 = self.merge8(F.relu(self.skip8(at8) + _twice_as_fine(self.from16(up16))))
        up4 = self.merge4(F.relu(self.skip4(at4) + _twice_as_fine(self.from8(up8))))
        return F.pixel_shuffle(self.logits(up4), EVIDENCE_BLOCK_PX), self.offsets(up4) * OFFSET_SCALE_BLOCKS
