"""What the fully convolutional presets are built from: motion code, modulation, trunk, rays."""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812  # torch's own convention
from torch import nn

from viflow_anomaly.correction import MIN_DEPTH_RATIO

COARSEST_STRIDE = 32
FLOW_STRIDE = 4


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


class MotorEncoder(nn.Module):
    """Motor numbers -> code [B, C]: the second stream of the paper's global shifter, in the same three layers.

    Args:
        numbers: M, of ``ModelConfig.motor_numbers``.
        width: of the hidden layers.
        code_width: C.
    """

    def __init__(self, *, numbers: int, width: int, code_width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(numbers, width),
            nn.LeakyReLU(0.1, inplace=True),
            nn.Linear(width, width),
            nn.LeakyReLU(0.1, inplace=True),
            nn.Linear(width, code_width),
            nn.LeakyReLU(0.1, inplace=True),
        )

    def forward(self, motor: torch.Tensor) -> torch.Tensor:
        """motor [B, M] -> code [B, C]."""
        code: torch.Tensor = self.layers(motor)
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


class ConvolutionalViflow(nn.Module):
    """The trunk that the presets share: motion code, gyro rotation, and image features at stride 4 modulated by motion.

    Args:
        motion_rows: T of the [T, 6] window; 0: no IMU stream, and no rotation is known.
        motor_numbers: M of the motor stream; 0: none. The codes of two streams are concatenated [Approach].
        interval_rows: how many of them, at its end, cover the frame interval evenly.
        hypotheses: K.
        focal_px: pixels that the coordinate inputs are divided by (the view's focal length).
        widths: channels at strides 4, 8, 16, 32.
        motion_width, code_width: of each stream's encoder.
    """

    def __init__(
        self,
        *,
        motion_rows: int,
        motor_numbers: int,
        interval_rows: int,
        hypotheses: int,
        focal_px: float,
        widths: tuple[int, int, int, int],
        motion_width: int,
        code_width: int,
    ) -> None:
        super().__init__()
        w4, w8, w16, w32 = widths
        self.interval_rows = interval_rows
        self.hypotheses = hypotheses
        self.focal_px = focal_px
        self.mounting, self.motion_encoder, self.motor_encoder = None, None, None
        if motion_rows:
            self.mounting = nn.Linear(3, 3, bias=False)
            nn.init.eye_(self.mounting.weight)
            self.motion_encoder = MotionEncoder(rows=motion_rows, width=motion_width, code_width=code_width)
        if motor_numbers:
            self.motor_encoder = MotorEncoder(numbers=motor_numbers, width=motion_width, code_width=code_width)
        code_width *= bool(motion_rows) + bool(motor_numbers)
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

    def motion_code(self, motion: torch.Tensor, interval_s: torch.Tensor, motor: torch.Tensor | None) -> torch.Tensor:
        """motion [B, T, 6], interval_s [B], motor [B, M] or None -> [B, C], the streams' codes side by side."""
        codes = []
        if self.motion_encoder is not None:
            codes.append(self.motion_encoder(motion, interval_s))
        if self.motor_encoder is not None:
            assert motor is not None
            codes.append(self.motor_encoder(motor))
        return torch.cat(codes, dim=1)

    def rotation(self, motion: torch.Tensor, interval_s: torch.Tensor) -> torch.Tensor:
        """[B, 3, 3]: the gyro's turn between the frames, source-camera to target-camera coordinates.

        Without an IMU stream nothing is known of it: the identity.
        """
        if self.mounting is None:
            return torch.eye(3, device=motion.device, dtype=motion.dtype).repeat(len(interval_s), 1, 1)
        rate = motion[:, -self.interval_rows :, :3].mean(dim=1)
        turned = rate * interval_s[:, None]
        return rotation_matrix(-(turned.unsqueeze(1) * self.mounting.weight).sum(dim=-1))

    def rays(self, source: torch.Tensor) -> torch.Tensor:
        """source [B, 1, H, W] -> [1, 2, h, w]: (x, y) of each flow cell from the image's middle, in focal lengths."""
        height, width = source.shape[-2:]
        cells_h, cells_w = (-(-side // COARSEST_STRIDE) * COARSEST_STRIDE // FLOW_STRIDE for side in (height, width))
        half = (FLOW_STRIDE - 1) / 2
        y = torch.arange(cells_h, device=source.device, dtype=source.dtype) * FLOW_STRIDE + half - (height - 1) / 2
        x = torch.arange(cells_w, device=source.device, dtype=source.dtype) * FLOW_STRIDE + half - (width - 1) / 2
        grid = torch.stack([x.expand(cells_h, -1), y[:, None].expand(-1, cells_w)])
        return grid.unsqueeze(0) / self.focal_px

    def features(self, source: torch.Tensor, code: torch.Tensor, rays: torch.Tensor) -> torch.Tensor:
        """source [B, 1, H, W], code [B, M], rays [1, 2, h, w] -> [B, C, h, w] at stride 4."""
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
        return F.leaky_relu(top, 0.1)


def rotation_matrix(theta: torch.Tensor) -> torch.Tensor:
    """Rodrigues: rotation vectors [B, 3] in rad -> matrices [B, 3, 3]; smooth at zero."""
    x, y, z = theta.unbind(dim=1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    # At least 1e-4 rad, where both quotients have long reached their limits: 1 - cos is below float32's resolution
    # there, and OpenVINO's sine over an angle of 1e-6 rad is not a number.
    half = theta.square().sum(dim=1)[:, None, None].clamp_min(1e-8).sqrt() / 2
    sinc_half = torch.sin(half) / half
    sinc = sinc_half * torch.cos(half)
    identity = torch.eye(3, device=theta.device, dtype=theta.dtype)
    turned: torch.Tensor = identity + sinc * cross + 0.5 * sinc_half.square() * (cross @ cross)
    return turned


def rigid_flow(
    rays: torch.Tensor, inverse_depth: torch.Tensor, rotation: torch.Tensor, translation: torch.Tensor
) -> torch.Tensor:
    """Flow of a static world under a rigid camera motion: X_target = R X_source + t.

    Args:
        rays: [1, 2, h, w] (x, y) in focal lengths.
        inverse_depth: [B, 1, h, w] in any unit whose inverse the translation has; zeros: rotation only.
        rotation: [B, 3, 3].
        translation: [B, K, 3].

    Returns:
        [B, K, 2, h, w] in focal lengths.
    """
    # Element by element and in float32: under autocast a product of matrices would round angles to eight bits.
    columns = rotation.float()[..., None, None].unbind(dim=2)  # 3 of B, 3, 1, 1
    moved = columns[0] * rays[:, :1] + columns[1] * rays[:, 1:] + columns[2]
    moved = moved.unsqueeze(1) + inverse_depth.float().unsqueeze(1) * translation.float()[..., None, None]
    return moved[:, :, :2] / moved[:, :, 2:].clamp_min(MIN_DEPTH_RATIO) - rays.unsqueeze(1)


def _doubled(features: torch.Tensor) -> torch.Tensor:
    return F.interpolate(features, scale_factor=2.0, mode="bilinear", align_corners=False)
