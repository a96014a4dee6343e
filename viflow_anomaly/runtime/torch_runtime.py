"""The reference runtime: PyTorch on any of its devices."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from viflow_anomaly.batch import collate
from viflow_anomaly.config import Precision
from viflow_anomaly.model_input import ModelInput
from viflow_anomaly.pair_detector import Backend
from viflow_anomaly.runtime.interface import Hypotheses, Scene


def bfloat16_where(backend: Backend) -> torch.autocast:
    """A context in which convolutions and products are bfloat16's, where the backend says so."""
    enabled = backend.precision == "bf16"
    return torch.autocast(torch.device(backend.device).type if enabled else "cpu", torch.bfloat16, enabled)


class TorchRuntime:
    """A network in evaluation mode.

    Args:
        network: of this package; moved to ``device``.
        device: torch device name.
        precision: "auto" is bfloat16 on CUDA, else float32; "bf16" is torch's autocast.
    """

    def __init__(self, network: nn.Module, *, device: str = "cpu", precision: Precision = "auto") -> None:
        self._device = torch.device(device)
        in_bfloat16 = precision == "bf16" or (precision == "auto" and self._device.type == "cuda")
        self.backend = Backend("torch", device, "bf16" if in_bfloat16 else "f32")
        self._network: nn.Module = network.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def predict(self, model_input: ModelInput) -> Hypotheses:
        """All hypotheses of one pair."""
        batch = collate([model_input], self._device)
        with torch.inference_mode(), bfloat16_where(self.backend):
            source = batch.source.contiguous(memory_format=torch.channels_last)
            output = self._network(source, batch.motion, batch.interval_s, batch.motor)
        scene = None
        if output.scene is not None:
            inverse_depth, rotation, translation = (one[0].float().cpu().numpy() for one in output.scene)
            scene = Scene(inverse_depth[0], rotation.astype(np.float64), translation.astype(np.float64))
        flow_px = output.flow_px[0].permute(0, 2, 3, 1).float().cpu().contiguous().numpy()
        return Hypotheses(flow_px, output.stride, scene)
