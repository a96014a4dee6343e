"""The evidence head in PyTorch, on any of its devices."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.runtime.interface import HeadAnswer


class TorchEvidence:
    """A head in evaluation mode, moved to ``device``."""

    def __init__(self, network: nn.Module, *, device: str = "cpu") -> None:
        self._device = device
        self._network: nn.Module = network.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def judge(self, photometric: Float32Array, geometric: Float32Array) -> HeadAnswer:
        cuda = torch.device(self._device).type == "cuda"
        with torch.inference_mode(), torch.autocast("cuda", dtype=torch.bfloat16, enabled=cuda):
            cues = (torch.from_numpy(one)[None].to(self._device) for one in (photometric, geometric))
            outputs = self._network(*(one.contiguous(memory_format=torch.channels_last) for one in cues))
        arrays = (one[0].float().cpu().contiguous().numpy() for one in outputs)
        return HeadAnswer(*(np.asarray(one, dtype=np.float32) for one in arrays))
