"""VIFlow with the paper's sizes: global shifter, local shifter, fusion, K parallel pathways [Approach]."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import nn

from viflow_anomaly.geometry import pixel_grid
from viflow_anomaly.model.outputs import ViflowOutput

GLOBAL_WIDTHS = (512, 4096, 4096, 512)
LOCAL_FILTERS = (32, 64, 128, 256, 512)
FUSION_WIDTH = 4096


def _stream(numbers: int) -> nn.Sequential:
    """One modality's four fully connected layers of 512, 4096, 4096, 512."""
    layers: list[nn.Module] = []
    for width_in, width in pairwise((numbers, *GLOBAL_WIDTHS)):
        layers += [_he(nn.Linear(width_in, width)), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


def _he(layer: nn.Linear | nn.Conv2d | nn.ConvTranspose2d) -> nn.Module:
    """Start a layer so that ReLU layers keep the size of what goes through them (He et al., ICCV 2015).

    The paper does not say how it starts. With torch's default a dozen layers shrink the image to nothing, and the local
    shifter says the same of every picture for hundreds of steps. A number leaves a transposed convolution of stride 2
    through a quarter of its kernel.
    """
    fan_in = layer.weight[0].numel()
    if isinstance(layer, nn.ConvTranspose2d):
        fan_in = layer.weight[:, 0].numel() // (layer.stride[0] * layer.stride[1])
    nn.init.normal_(layer.weight, std=math.sqrt(2 / fan_in))
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)
    return layer


class PaperGlobalShifter(nn.Module):
    """Motion inputs -> code, and for each hypothesis a 2x3 affine matrix on normalised coordinates.

    Each modality goes through four fully connected layers of its own; two codes are concatenated to 1024 numbers. The
    affine layers start at the identity.

    Args:
        motion_numbers: of the IMU stream, 0: none.
        motor_numbers: of the motor stream, 0: none.
        hypotheses: K.
    """

    def __init__(self, *, motion_numbers: int, motor_numbers: int, hypotheses: int) -> None:
        super().__init__()
        self.trunk = _stream(motion_numbers) if motion_numbers else None
        self.motor_trunk = _stream(motor_numbers) if motor_numbers else None
        width_in = self.code_width = GLOBAL_WIDTHS[-1] * (bool(motion_numbers) + bool(motor_numbers))
        self.affine = nn.ModuleList(nn.Linear(width_in, 6) for _ in range(hypotheses))
        for layer in self.affine:
            assert isinstance(layer, nn.Linear)
            nn.init.zeros_(layer.weight)
            layer.bias.data = torch.tensor([1.0, 0.0, 0.0, 0.0, 1.0, 0.0])

    def forward(self, motion: torch.Tensor, motor: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """motion [B, T, 6], motor [B, M] or None -> code [B, 512 or 1024], affine matrices [B, K, 2, 3]."""
        codes = [] if self.trunk is None else [self.trunk(motion.flatten(1))]
        if self.motor_trunk is not None:
            assert motor is not None
            codes.append(self.motor_trunk(motor))
        code = torch.cat(codes, dim=1)
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
                _he(nn.ConvTranspose2d(filters_in, filters_out, 5, stride=2, padding=2, output_padding=1)),
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
        motion_rows: T of the [T, 6] window (50 for EuRoC, 20 for KITTI); 0: no IMU stream.
        motor_numbers: M of the motor stream (20 clusters in the paper); 0: none.
        hypotheses: K.
        image_size: (height, width), multiples of 32; the fully connected fusion fixes it.
    """

    def __init__(
        self, *, motion_rows: int, hypotheses: int, motor_numbers: int = 0, image_size: tuple[int, int] = (224, 224)
    ) -> None:
        super().__init__()
        height, width = image_size
        self.image_size = image_size
        self.global_shifter = PaperGlobalShifter(
            motion_numbers=motion_rows * 6, motor_numbers=motor_numbers, hypotheses=hypotheses
        )
        filters = (1, *LOCAL_FILTERS)
        layers: list[nn.Module] = []
        for filters_in, filters_out in pairwise(filters):
            layers += [_he(nn.Conv2d(filters_in, filters_out, 5, stride=2, padding=2)), nn.ReLU(inplace=True)]
        self.encoder = nn.Sequential(*layers)
        self.code_shape = (LOCAL_FILTERS[-1], height // 32, width // 32)
        code_numbers = self.code_shape[0] * self.code_shape[1] * self.code_shape[2]
        self.fusion = nn.Sequential(
            _he(nn.Linear(code_numbers + self.global_shifter.code_width, FUSION_WIDTH)),
            nn.ReLU(inplace=True),
            _he(nn.Linear(FUSION_WIDTH, code_numbers)),
            nn.ReLU(inplace=True),
        )
        self.decoders = nn.ModuleList(PaperDecoder() for _ in range(hypotheses))
        self.register_buffer("grid", torch.from_numpy(pixel_grid(height, width)), persistent=False)

    def forward(
        self,
        source: torch.Tensor,
        motion: torch.Tensor,
        interval_s: torch.Tensor,
        motor: torch.Tensor | None = None,
    ) -> ViflowOutput:
        """source [B, 1, H, W] in 0..1, motion [B, T, 6], motor [B, M] where the network has that stream
        -> flow [B, K, 2, H, W] px (the interval is not used)."""
        del interval_s  # the paper's window says it by its zero rows
        code, matrices = self.global_shifter(motion, motor)
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
