"""ONNX Runtime: the exported evidence head."""

from __future__ import annotations

import numpy as np

from viflow_anomaly.checkpoint_record import EvidenceRecord
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.pair_detector import Backend
from viflow_anomaly.runtime.exported import Export, require_head
from viflow_anomaly.runtime.interface import HeadAnswer
from viflow_anomaly.runtime.onnxruntime_network import OnnxruntimeNetwork


class OnnxruntimeEvidence:
    """Runs the head's ``NAME.onnx`` or ``NAME.int8.onnx``; arguments and errors as ``OnnxruntimeRuntime``."""

    def __init__(
        self, export: Export, record: EvidenceRecord, *, device: str = "cpu", threads: int = 1, precision: str = "f32"
    ) -> None:
        self._network = OnnxruntimeNetwork(export, device=device, threads=threads)
        require_head(export, self._network.metadata, record)
        self.backend = Backend("onnxruntime", device, precision)

    def judge(self, photometric: Float32Array, geometric: Float32Array) -> HeadAnswer:
        outputs = self._network.run({"photometric": photometric[None], "geometric": geometric[None]})
        return HeadAnswer(*(np.asarray(outputs[name][0], dtype=np.float32) for name in HeadAnswer._fields))
