"""OpenVINO on a CPU: the exported VIFlow network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from viflow_anomaly.checkpoint_record import CheckpointRecord, corrupt_checkpoint
from viflow_anomaly.config import ModelConfig
from viflow_anomaly.model_input import ModelInput
from viflow_anomaly.runtime.exported import FLOW_STRIDE_KEY, MODEL_KEY
from viflow_anomaly.runtime.interface import Hypotheses, Scene
from viflow_anomaly.runtime.openvino_network import OpenvinoNetwork


class OpenvinoRuntime:
    """Runs ``NAME.onnx``.

    Args:
        path: of the exported network.
        record: of the checkpoint that it must have been exported from.
        threads: of one prediction.

    Raises:
        CheckpointError: as ``OpenvinoNetwork``.
    """

    name = "openvino"

    def __init__(self, path: Path, record: CheckpointRecord, *, threads: int = 1) -> None:
        self._network = OpenvinoNetwork(path, record, shapes=lambda size: {"source": [1, 1, *size]}, threads=threads)
        try:
            same_model = ModelConfig.model_validate_json(self._network.metadata[MODEL_KEY]) == record.model
            self._stride = int(self._network.metadata[FLOW_STRIDE_KEY])
        except (LookupError, ValueError) as err:
            raise corrupt_checkpoint(
                path, f"expected an ONNX network of this package, found: {str(err)[-200:]}"
            ) from err
        if not same_model:
            raise corrupt_checkpoint(path, f"expected the model configuration of {path.with_suffix('.json')} in it")

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
