"""ONNX Runtime: the exported VIFlow network."""

from __future__ import annotations

import numpy as np

from viflow_anomaly.checkpoint_record import CheckpointRecord
from viflow_anomaly.model_input import ModelInput
from viflow_anomaly.pair_detector import Backend
from viflow_anomaly.runtime.exported import Export, network_feed, require_network
from viflow_anomaly.runtime.interface import Hypotheses, Scene
from viflow_anomaly.runtime.onnxruntime_network import OnnxruntimeNetwork


class OnnxruntimeRuntime:
    """Runs ``NAME.onnx`` or ``NAME.int8.onnx``.

    Args:
        export: of the network.
        record: of the checkpoint that it must have been exported from.
        device, threads: as ``OnnxruntimeNetwork``.
        precision: that of the export.

    Raises:
        CheckpointError: as ``require_network`` and ``OnnxruntimeNetwork``.
        ConfigError: ``device_unavailable``.
    """

    def __init__(
        self, export: Export, record: CheckpointRecord, *, device: str = "cpu", threads: int = 1, precision: str = "f32"
    ) -> None:
        self._network = OnnxruntimeNetwork(export, device=device, threads=threads)
        self._stride = require_network(export, self._network.metadata, record)
        self.backend = Backend("onnxruntime", device, precision)

    def predict(self, model_input: ModelInput) -> Hypotheses:
        """All hypotheses of one pair."""
        outputs = self._network.run(network_feed(model_input))
        flow_px = np.ascontiguousarray(outputs["flow_px"][0].transpose(0, 2, 3, 1))
        if "inverse_depth" not in outputs:
            return Hypotheses(flow_px, self._stride, None)
        rotation, translations = (outputs[name][0].astype(np.float64) for name in ("rotation", "translation"))
        return Hypotheses(flow_px, self._stride, Scene(outputs["inverse_depth"][0, 0], rotation, translations))
