"""The compact preset: VIFlow's parts in a fully convolutional network that trains and runs on a CPU.

Global shifter: the gyro's rotation between the frames, through a learned 3x3 mounting that starts at the identity,
moves every ray exactly; the motion code adds an eight-parameter quadratic motion model for each hypothesis. Local
shifter: encoder and top-down decoder on the source image alone, each scale modulated by the motion code (the paper's
fusion, without a fixed image size). Hypotheses differ in both.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812  # torch's own convention
from torch import nn

from viflow_anomaly.model.outputs import ViflowOutput

COARSEST_STRIDE = 32
FLOW_STRIDE = 4
QUADRATIC_PARAMETERS = 8


class MotionEncoder(nn.Module):
    """Motion window -> code [B, C].

    Rates are also given times the frame interval: what moves pixels is the angle, not the rate.

    Args:
        rows: T of the window.
        width: of the hidden layers.
        code_width: C.
    """

    def __init__(self, *, rows: int, width: int, code_width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(rows * 9 + 1, width),
            nn.LeakyReLU(0.1, inplace=True),
            nn.Linear(width, width),
            nn.LeakyReLU(0.1, inplace=True),
            nn.Linear(width, code_width),
            nn.LeakyReLU(0.1, inplace=True),
        )

    def forward(self, motion: torch.Tensor, interval_s: torch.Tensor) -> torch.Tensor:
        """motion [B, T, 6] in rad/s and m/s^2, interval_s [B] -> code [B, C]."""
        interval = interval_s[:, None]
        gyro, accel = motion[..., :3].flatten(1), motion[..., 3:].flatten(1)
        features = torch.cat([gyro, gyro * interval * 10.0, accel / 9.81, interval * 10.0], dim=1)
        code: torch.Tensor = self.layers(features)
        return code


class Modulate(nn.Module):
    """Scale and shift feature maps by the motion code (FiLM)."""

    def __init__(self, *, code_width: int, channels: int) -> None:
        super().__init__()
        self.linear = nn.Linear(code_width, 2 * channels)
        nn.init.normal_(self.linear.weight, std=0.02)
        nn.init.zeros_(self.linear.bias)

    def forward(self, features: torch.Tensor, code: torch.Tensor) -> torch.Tensor:
        """features [B, C, h, w], code [B, M] -> [B, C, h, w]."""
        scale, shift = self.linear(code)[:, :, None, None].chunk(2, dim=1)
        return torch.addcmul(shift, features, scale + 1.0)


def _convolution(channels_in: int, channels_out: int, *, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, 3, stride=stride, padding=1), nn.LeakyReLU(0.1, inplace=True)
    )


class CompactViflow(nn.Module):
    """Fully convolutional VIFlow for images of any size.

    Args:
        motion_rows: T of the [T, 6] window.
        interval_rows: how many of them, at its end, cover the frame interval evenly.
        hypotheses: K.
        focal_px: pixels that the coordinate inputs are divided by (the view's focal length).
        widths: channels at strides 4, 8, 16, 32.
        motion_width, code_width: of the motion encoder.
    """

    def __init__(
        self,
        *,
        motion_rows: int,
        interval_rows: int,
        hypotheses: int,
        focal_px: float,
        widths: tuple[int, int, int, int] = (24, 48, 112, 128),
        motion_width: int = 256,
        code_width: int = 128,
    ) -> None:
        super().__init__()
        w4, w8, w16, w32 = widths
        self.interval_rows = interval_rows
        self.hypotheses = hypotheses
        self.focal_px = focal_px
        self.mounting = nn.Linear(3, 3, bias=False)
        nn.init.eye_(self.mounting.weight)
        self.motion_encoder = MotionEncoder(rows=motion_rows, width=motion_width, code_width=code_width)
        self.global_head = nn.Linear(code_width, hypotheses * QUADRATIC_PARAMETERS)
        self.encode4 = _convolution(16 + 2, w4)
        self.encode8 = nn.Sequential(_convolution(w4, w8, stride=2), _convolution(w8, w8))
        self.encode16 = nn.Sequential(_convolution(w8, w16, stride=2), _convolution(w16, w16))
        self.encode32 = _convolution(w16, w32, stride=2)
        self.context = nn.Linear(w32, w32)
        self.modulate32 = Modulate(code_width=code_width, channels=w32)
        self.decode32 = _convolution(w32, w16)
        self.modulate16 = Modulate(code_width=code_width, channels=w16)
        self.decode16 = _convolution(w16, w8)
        self.modulate8 = Modulate(code_width=code_width, channels=w8)
        self.decode8 = _convolution(w8, w4)
        self.modulate4 = Modulate(code_width=code_width, channels=w4)
        self.local_head = nn.Conv2d(w4, hypotheses * 2, 1)
        for head in (self.global_head, self.local_head):
            nn.init.normal_(head.weight, std=1e-3)
            assert head.bias is not None
            nn.init.zeros_(head.bias)

    def forward(self, source: torch.Tensor, motion: torch.Tensor, interval_s: torch.Tensor) -> ViflowOutput:
        """source [B, 1, H, W] in 0..1, motion [B, T, 6], interval_s [B] -> flow [B, K, 2, ceil(H/4), ceil(W/4)]."""
        height, width = source.shape[-2:]
        code = self.motion_encoder(motion, interval_s)
        rays = self._rays(source)
        turned = self._rotation_flow(motion, interval_s, rays).unsqueeze(1)
        flow = (turned + self._global_flow(code, rays) + self._local_flow(source, code, rays)) * self.focal_px
        rows, columns = -(-height // FLOW_STRIDE), -(-width // FLOW_STRIDE)
        return ViflowOutput(flow[..., :rows, :columns], stride=FLOW_STRIDE)

    def _rays(self, source: torch.Tensor) -> torch.Tensor:
        """[1, 2, h, w]: (x, y) of each flow cell from the image's middle, in focal lengths."""
        height, width = source.shape[-2:]
        cells_h, cells_w = (-(-side // COARSEST_STRIDE) * COARSEST_STRIDE // FLOW_STRIDE for side in (height, width))
        half = (FLOW_STRIDE - 1) / 2
        y = torch.arange(cells_h, device=source.device, dtype=source.dtype) * FLOW_STRIDE + half - (height - 1) / 2
        x = torch.arange(cells_w, device=source.device, dtype=source.dtype) * FLOW_STRIDE + half - (width - 1) / 2
        grid = torch.stack([x.expand(cells_h, -1), y[:, None].expand(-1, cells_w)])
        return grid.unsqueeze(0) / self.focal_px

    def _rotation_flow(self, motion: torch.Tensor, interval_s: torch.Tensor, rays: torch.Tensor) -> torch.Tensor:
        """Flow of a camera that only turns [B, 2, h, w] in focal lengths: X_target = exp(-[theta]x) X_source."""
        rate = motion[:, -self.interval_rows :, :3].mean(dim=1)
        theta = self.mounting(rate * interval_s[:, None])
        rotation = _rotation_matrix(-theta)  # B, 3, 3
        moved = torch.einsum("bij,jhw->bihw", rotation[:, :, :2], rays[0]) + rotation[:, :, 2, None, None]
        return moved[:, :2] / moved[:, 2:].clamp_min(0.1) - rays

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
        batch, _, height, width = source.shape
        padding = (0, -width % COARSEST_STRIDE, 0, -height % COARSEST_STRIDE)
        if any(padding):
            source = F.pad(source, padding, mode="replicate")
        pixels = F.pixel_unshuffle(source - 0.5, FLOW_STRIDE)
        at4 = self.encode4(torch.cat([pixels, rays.expand(batch, -1, -1, -1)], dim=1))
        at8 = self.encode8(at4)
        at16 = self.encode16(at8)
        at32 = self.encode32(at16)
        context = self.context(at32.mean(dim=(2, 3)))[:, :, None, None]
        top = self.decode32(self.modulate32(at32 + context, code))
        top = self.decode16(self.modulate16(at16 + _doubled(top), code))
        top = self.decode8(self.modulate8(at8 + _doubled(top), code))
        top = self.modulate4(at4 + _doubled(top), code)
        shifts: torch.Tensor = self.local_head(F.leaky_relu(top, 0.1))
        return shifts.reshape(batch, self.hypotheses, 2, *shifts.shape[-2:])


def _rotation_matrix(theta: torch.Tensor) -> torch.Tensor:
    """Rodrigues: rotation vectors [B, 3] in rad -> matrices [B, 3, 3]; smooth at zero."""
    x, y, z = theta.unbind(dim=1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    angle2 = theta.square().sum(dim=1)[:, None, None] + 1e-12
    angle = angle2.sqrt()
    identity = torch.eye(3, device=theta.device, dtype=theta.dtype)
    turned: torch.Tensor = (
        identity + torch.sin(angle) / angle * cross + (1 - torch.cos(angle)) / angle2 * (cross @ cross)
    )
    return turned


def _doubled(features: torch.Tensor) -> torch.Tensor:
    return F.interpolate(features, scale_factor=2.0, mode="bilinear", align_corners=False)
