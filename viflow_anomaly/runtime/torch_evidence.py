"""The evidence head in PyTorch, on any of its devices."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from viflow_anomaly.config import Precision
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.pair_detector import Backend
from viflow_anomaly.runtime.interface import HeadAnswer
from viflow_anomaly.runtime.torch_runtime import bfloat16_where


class TorchEvidence:
    """A head in evaluation mode; arguments as ``TorchRuntime``."""

    def __init__(self, network: nn.Module, *, device: str = "cpu", precision: Precision = "auto") -> None:
        self._device = torch.device(device)
        in_bfloat16 = precision == "bf16" or (precision == "auto" and self._device.type == "cuda")
        self.backend = Backend("torch", device, "bf16" if in_bfloat16 else "f32")
        self._network: nn.Module = network.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def judge(self, photometric: Float32Array, geometric: Float32Array) -> HeadAnswer:
        with torch.inference_mode(), bfloat16_where(self.backend):
            cues = (torch.from_numpy(one)[None].to(self._device) for one in (photometric, geometric))
            outputs = self._network(*(one.contiguous(memory_format=torch.channels_last) for one in cues))
        arrays = (one[0].float().cpu().contiguous().numpy() for one in outputs)
        return HeadAnswer(*(np.asarray(one, dtype=np.float32) for one in arrays))
