"""OpenVINO on a CPU: the exported VIFlow network."""

from __future__ import annotations

from typing import Any

import numpy as np

from viflow_anomaly.checkpoint_record import CheckpointRecord
from viflow_anomaly.config import Precision
from viflow_anomaly.model_input import ModelInput
from viflow_anomaly.pair_detector import Backend
from viflow_anomaly.runtime.exported import Export, require_network
from viflow_anomaly.runtime.interface import Hypotheses, Scene
from viflow_anomaly.runtime.openvino_network import OpenvinoNetwork


class OpenvinoRuntime:
    """Runs an export of the network.

    Args:
        export: of the network.
        record: of the checkpoint that it must have been exported from.
        threads: of one prediction.
        precision: "auto" is "f32".

    Raises:
        CheckpointError: as ``OpenvinoNetwork`` and ``require_network``.
        ConfigError: as ``OpenvinoNetwork``.
    """

    def __init__(
        self, export: Export, record: CheckpointRecord, *, threads: int = 1, precision: Precision = "auto"
    ) -> None:
        self._network = OpenvinoNetwork(
            export,
            shapes=lambda size: {"source": [1, 1, *size]},
            threads=threads,
            precision="f32" if precision == "auto" else precision,
        )
        self._stride = require_network(export, self._network.metadata, record)
        self.backend = Backend("openvino", "cpu", self._network.precision)

    def predict(self, model_input: ModelInput) -> Hypotheses:
        """All hypotheses of one pair."""
        height, width = model_input.source.shape
        request, inputs, outputs = self._network.request((height, width))
        np.multiply(model_input.source, np.float32(1 / 255), out=inputs["source"][0, 0])
        window = model_input.window
        given: dict[str, Any] = {"motion": window.values, "interval_s": window.interval_s, "motor": model_input.motor}
        for name in given.keys() & inputs.keys():  # an export drops what its network ignores
            inputs[name][0] = given[name]
        request.infer()
        flow_px = np.ascontiguousarray(outputs["flow_px"][0].transpose(0, 2, 3, 1))
        if "inverse_depth" not in outputs:
            return Hypotheses(flow_px, self._stride, None)
        rotation, translations = (outputs[name][0].astype(np.float64) for name in ("rotation", "translation"))
        return Hypotheses(flow_px, self._stride, Scene(outputs["inverse_depth"][0, 0].copy(), rotation, translations))
