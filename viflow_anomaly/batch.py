"""The only numpy -> torch step: prepared pairs become one batch. Training, command line and service share it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from viflow_anomaly.errors import ConfigError
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.measured_flow import MeasuredFlow
from viflow_anomaly.model_input import ModelInput
from viflow_anomaly.sensor_data import Uint8Array


class Batch(NamedTuple):
    """Tensors on one device.

    Attributes:
        source, target: [B, 1, H, W] in 0..1.
        motion: [B, T, 6] in rad/s and m/s^2.
        interval_s: [B].
        motor: [B, M], None for networks without a motor stream.
        measured: what the images say of their flow, one for each example (training of preset ``calibrated`` only).
    """

    source: torch.Tensor
    target: torch.Tensor
    motion: torch.Tensor
    interval_s: torch.Tensor
    motor: torch.Tensor | None = None
    measured: tuple[MeasuredFlow, ...] = ()


def require_device(device: str) -> None:
    """Find out whether this machine and this torch can compute on ``device``.

    Raises:
        ConfigError: ``device_unavailable``.
    """
    try:
        torch.zeros(1, device=device).cpu()
    except (
        RuntimeError,
        AssertionError,
        NotImplementedError,
    ) as err:  # a torch without CUDA asserts, "meta" has no data
        raise ConfigError(
            f"device: expected one that this machine has, found {device!r}: {str(err).splitlines()[0]}",
            code="device_unavailable",
            field="device",
        ) from err


def collate(inputs: Sequence[ModelInput], device: torch.device | str = "cpu") -> Batch:
    """Inputs of one size -> a batch on ``device``."""
    return collate_arrays(
        np.stack([one.source for one in inputs]),
        np.stack([one.target for one in inputs]),
        np.stack([one.window.values for one in inputs]),
        np.array([one.window.interval_s for one in inputs], dtype=np.float32),
        np.stack([one.motor for one in inputs if one.motor is not None]) if inputs[0].motor is not None else None,
        device=device,
    )


def collate_arrays(
    source: Uint8Array,
    target: Uint8Array,
    motion: Float32Array,
    interval_s: Float32Array,
    motor: Float32Array | None = None,
    *,
    device: torch.device | str = "cpu",
) -> Batch:
    """source, target [B, H, W] uint8, motion [B, T, 6], interval_s [B], motor [B, M] -> a batch on ``device``."""

    def images(array: Uint8Array) -> torch.Tensor:
        return torch.from_numpy(array).to(device).unsqueeze(1).float().div_(255.0)

    return Batch(
        source=images(source),
        target=images(target),
        motion=torch.from_numpy(motion).to(device),
        interval_s=torch.from_numpy(interval_s).to(device),
        motor=None if motor is None else torch.from_numpy(motor).to(device),
    )
