"""VIFlow with the paper's sizes: global shifter, local shifter, fusion, K parallel pathways [Approach]."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import nn

from viflow_anomaly.geometry import pixel_grid
from viflow_anomaly.model.outputs import ViflowOutput

GLOBAL_WIDTHS = (512, 4096, 4096, 512)
LOCAL_FILTERS = (32, 64, 128, 256, 512)
FUSION_WIDTH = 4096


class PaperGlobalShifter(nn.Module):
    """Motion input -> code, and for each hypothesis a 2x3 affine matrix on normalised coordinates.

    Four fully connected layers of 512, 4096, 4096, 512; the affine layers start at the identity.
    """

    def __init__(self, *, motion_numbers: int, hypotheses: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        width_in = motion_numbers
        for width in GLOBAL_WIDTHS:
            layers += [nn.Linear(width_in, width), nn.ReLU(inplace=True)]
            width_in = width
        self.trunk = nn.Sequential(*layers)
        self.affine = nn.ModuleList(nn.Linear(width_in, 6) for _ in range(hypotheses))
        for layer in self.affine:
            assert isinstance(layer, nn.Linear)
            nn.init.zeros_(layer.weight)
            layer.bias.data = torch.tensor([1.0, 0.0, 0.0, 0.0, 1.0, 0.0])

    def forward(self, motion: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """motion [B, T, 6] -> code [B, 512], affine matrices [B, K, 2, 3]."""
        code = self.trunk(motion.flatten(1))
        matrices = torch.stack([layer(code) for layer in self.affine], dim=1)
        return code, matrices.view(-1, len(self.affine), 2, 3)


class PaperDecoder(nn.Module):
    """One pathway: five 5x5 transposed convolutions of 512, 256, 128, 64, 32 filters, then 2 pixel shifts."""

    def __init__(self) -> None:
        super().__init__()
        filters = (LOCAL_FILTERS[-1], *reversed(LOCAL_FILTERS))
        layers: list[nn.Module] = []
        for filters_in, filters_out in pairwise(filters):
            layers += [
                nn.ConvTranspose2d(filters_in, filters_out, 5, stride=2, padding=2, output_padding=1),
                nn.ReLU(inplace=True),
            ]
        shifts = nn.Conv2d(filters[-1], 2, 3, padding=1)
        nn.init.normal_(shifts.weight, std=1e-3)
        nn.init.zeros_(shifts.bias)  # type: ignore[arg-type]
        self.layers = nn.Sequential(*layers, shifts)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """[B, 512, h, w] -> local shifts [B, 2, 32 h, 32 w] in pixels."""
        shifts: torch.Tensor = self.layers(features)
        return shifts


class PaperViflow(nn.Module):
    """The network of the paper.

    What is shared and what each hypothesis owns: encoder, fusion and the global trunk are shared; every hypothesis
    has its own affine layer and its own decoder. (The paper's runtimes grow by 0.5 ms a hypothesis, so most of the
    network must be shared there too.)

    Args:
        motion_rows: T of the [T, 6] window (50 for EuRoC, 20 for KITTI).
        hypotheses: K.
        image_size: (height, width), multiples of 32; the fully connected fusion fixes it.
    """

    def __init__(self, *, motion_rows: int, hypotheses: int, image_size: tuple[int, int] = (224, 224)) -> None:
        super().__init__()
        height, width = image_size
        self.image_size = image_size
        self.global_shifter = PaperGlobalShifter(motion_numbers=motion_rows * 6, hypotheses=hypotheses)
        filters = (1, *LOCAL_FILTERS)
        layers: list[nn.Module] = []
        for filters_in, filters_out in pairwise(filters):
            layers += [nn.Conv2d(filters_in, filters_out, 5, stride=2, padding=2), nn.ReLU(inplace=True)]
        self.encoder = nn.Sequential(*layers)
        self.code_shape = (LOCAL_FILTERS[-1], height // 32, width // 32)
        code_numbers = self.code_shape[0] * self.code_shape[1] * self.code_shape[2]
        self.fusion = nn.Sequential(
            nn.Linear(code_numbers + GLOBAL_WIDTHS[-1], FUSION_WIDTH),
            nn.ReLU(inplace=True),
            nn.Linear(FUSION_WIDTH, code_numbers),
            nn.ReLU(inplace=True),
        )
        self.decoders = nn.ModuleList(PaperDecoder() for _ in range(hypotheses))
        self.register_buffer("grid", torch.from_numpy(pixel_grid(height, width)), persistent=False)

    def forward(self, source: torch.Tensor, motion: torch.Tensor, interval_s: torch.Tensor) -> ViflowOutput:
        """source [B, 1, H, W] in 0..1, motion [B, T, 6] -> flow [B, K, 2, H, W] px (the interval is not used)."""
        del interval_s  # the paper's window says it by its zero rows
        code, matrices = self.global_shifter(motion)
        features = self.encoder(source).flatten(1)
        fused = self.fusion(torch.cat([features, code], dim=1)).unflatten(1, self.code_shape)
        local = torch.stack([decoder(fused) for decoder in self.decoders], dim=1)  # B, K, 2, H, W
        return ViflowOutput(self._global_flow(matrices) + local, stride=1)

    def _global_flow(self, matrices: torch.Tensor) -> torch.Tensor:
        """Affine matrices [B, K, 2, 3] on coordinates normalised to -1..1 -> flow [B, K, 2, H, W] in pixels."""
        height, width = self.image_size
        assert isinstance(self.grid, torch.Tensor)
        half = self.grid.new_tensor([(width - 1) / 2, (height - 1) / 2])
        normalised = self.grid / half - 1.0  # H, W, 2
        homogeneous = torch.cat([normalised, torch.ones_like(normalised[..., :1])], dim=-1)
        moved = torch.einsum("bkij,hwj->bkihw", matrices, homogeneous)
        shift = moved - normalised.permute(2, 0, 1)
        return shift * half.view(2, 1, 1)
