"""OpenVINO on a CPU: the exported network, compiled once for each view size."""

from __future__ import annotations

import hashlib
import threading
from pathlib import Path
from typing import Any

import numpy as np
import openvino

from viflow_anomaly.checkpoint_record import CheckpointRecord, corrupt_checkpoint, read_checkpoint_file
from viflow_anomaly.model_input import ModelInput
from viflow_anomaly.runtime.exported import FLOW_STRIDE_KEY, WEIGHTS_KEY, exported_metadata
from viflow_anomaly.runtime.interface import Hypotheses, Scene

MAX_SIZES = 8
"""Compiled networks kept; one takes a few megabytes and some 100 ms to make."""


class OpenvinoRuntime:
    """Runs ``NAME.onnx``.

    Args:
        path: of the exported network.
        record: of the checkpoint that it must have been exported from.
        threads: of one prediction.

    Raises:
        CheckpointError: ``checkpoint_corrupt``.
    """

    name = "openvino"

    def __init__(self, path: Path, record: CheckpointRecord, *, threads: int = 1) -> None:
        self._threads = threads
        data = read_checkpoint_file(path)
        self._core = openvino.Core()
        try:
            model = self._core.read_model(data)
            metadata = exported_metadata(model)
        except RuntimeError as err:
            raise corrupt_checkpoint(path, f"expected an ONNX network, found: {str(err).strip()[-200:]}") from err
        if metadata.get(WEIGHTS_KEY) != record.sha256:
            found = metadata.get(WEIGHTS_KEY) or f"none (file sha256 {hashlib.sha256(data).hexdigest()[:12]})"
            raise corrupt_checkpoint(path, f"expected an export of the weights {record.sha256}, found {found}")
        self._data = data
        self._stride = int(metadata[FLOW_STRIDE_KEY])
        self._compiled: dict[tuple[int, int], Any] = {}
        self._lock = threading.Lock()
        self._requests = threading.local()

    def predict(self, model_input: ModelInput) -> Hypotheses:
        """All hypotheses of one pair."""
        window = model_input.window
        request = self._request(model_input.source.shape)
        inputs = {
            "source": model_input.source[None, None].astype(np.float32) * np.float32(1 / 255),
            "motion": window.values[None],
            "interval_s": np.array([window.interval_s], dtype=np.float32),
        }
        wanted = [port.get_any_name() for port in request.model_inputs]  # an export drops what its network ignores
        request.infer({name: inputs[name] for name in wanted}, share_inputs=True)
        flow_px = np.ascontiguousarray(request.get_tensor("flow_px").data[0].transpose(0, 2, 3, 1))
        names = request.model_outputs
        if len(names) == 1:
            return Hypotheses(flow_px, self._stride, None)
        inverse_depth = request.get_tensor("inverse_depth").data[0, 0].copy()
        rotation = request.get_tensor("rotation").data[0].astype(np.float64)
        translations_m = request.get_tensor("translation_m").data[0].astype(np.float64)
        return Hypotheses(flow_px, self._stride, Scene(inverse_depth, rotation, translations_m))

    def _request(self, size: tuple[int, ...]) -> Any:
        """An inference request of this thread for views of ``size``: requests hold buffers, so threads share none."""
        compiled = self._compile((size[0], size[1]))
        requests: dict[int, Any] = self._requests.__dict__.setdefault("by_network", {})
        request = requests.get(id(compiled))
        if request is None:
            if len(requests) >= MAX_SIZES:
                requests.clear()
            request = requests[id(compiled)] = compiled.create_infer_request()
        return request

    def _compile(self, size: tuple[int, int]) -> Any:
        with self._lock:
            compiled = self._compiled.get(size)
            if compiled is None:
                model = self._core.read_model(self._data)
                model.reshape({"source": [1, 1, *size]})
                compiled = self._core.compile_model(
                    model,
                    "CPU",
                    {
                        "INFERENCE_PRECISION_HINT": "f32",  # the default is bfloat16 where the CPU has it
                        "INFERENCE_NUM_THREADS": self._threads,
                        "PERFORMANCE_HINT": "LATENCY",
                    },
                )
                if len(self._compiled) >= MAX_SIZES:
                    self._compiled.pop(next(iter(self._compiled)))
                self._compiled[size] = compiled
            return compiled
