"""OpenVINO on a CPU: the exported network, compiled once for each view size."""

from __future__ import annotations

import hashlib
import threading
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import openvino

from viflow_anomaly.checkpoint_record import CheckpointRecord, corrupt_checkpoint, read_checkpoint_file
from viflow_anomaly.config import ModelConfig
from viflow_anomaly.errors import CheckpointError
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.model_input import ModelInput
from viflow_anomaly.runtime.exported import FLOW_STRIDE_KEY, MODEL_KEY, exported_metadata
from viflow_anomaly.runtime.interface import Hypotheses, Scene

MAX_SIZES = 8
"""Compiled networks kept; one takes a few megabytes and some 100 ms to make."""


def _require_fresh(path: Path, data: bytes, record: CheckpointRecord) -> None:
    """An export must be the very file that was made from its checkpoint as it is now: the record names its checksum."""
    found = hashlib.sha256(data).hexdigest()
    if found != record.onnx_sha256:
        raise CheckpointError(
            f"{path}: expected the export that {path.with_suffix('.json').name} names, sha256 {record.onnx_sha256}, "
            f"found {found}: altered, or older than the checkpoint; make it anew with "
            f"viflow-anomaly export --checkpoint {path.with_suffix('.safetensors')}",
            code="export_stale",
            field="checkpoint",
        )


class _Request(NamedTuple):
    """One inference request, and views of its own buffers by name."""

    request: Any
    inputs: dict[str, Float32Array]
    outputs: dict[str, Float32Array]

    @classmethod
    def of(cls, compiled: Any) -> Self:
        """A new request; its shapes are fixed, so its buffers stay where they are."""
        request = compiled.create_infer_request()
        inputs, outputs = (
            {port.get_any_name(): request.get_tensor(port).data for port in ports}
            for ports in (compiled.inputs, compiled.outputs)
        )
        return cls(request, inputs, outputs)


class OpenvinoRuntime:
    """Runs ``NAME.onnx``.

    Args:
        path: of the exported network.
        record: of the checkpoint that it must have been exported from.
        threads: of one prediction.

    Raises:
        CheckpointError: ``export_stale``: altered, or the checkpoint was replaced after it; ``checkpoint_corrupt``.
    """

    name = "openvino"

    def __init__(self, path: Path, record: CheckpointRecord, *, threads: int = 1) -> None:
        self._threads = threads
        data = read_checkpoint_file(path)
        _require_fresh(path, data, record)
        self._core = openvino.Core()
        try:
            metadata = exported_metadata(self._core.read_model(data))
            same_model = ModelConfig.model_validate_json(metadata[MODEL_KEY]) == record.model
        except (RuntimeError, LookupError, ValueError) as err:
            raise corrupt_checkpoint(
                path, f"expected an ONNX network of this package, found: {str(err)[-200:]}"
            ) from err
        if not same_model:
            raise corrupt_checkpoint(path, f"expected the model configuration of {path.with_suffix('.json')} in it")
        self._data = data
        self._stride = int(metadata[FLOW_STRIDE_KEY])
        self._compiled: dict[tuple[int, int], Any] = {}
        self._lock = threading.Lock()
        self._requests = threading.local()

    def predict(self, model_input: ModelInput) -> Hypotheses:
        """All hypotheses of one pair."""
        height, width = model_input.source.shape
        request, inputs, outputs = self._request((height, width))
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

    def _request(self, size: tuple[int, int]) -> _Request:
        """This thread's request for views of ``size``: requests hold buffers, so threads share none."""
        requests: dict[tuple[int, int], _Request] = self._requests.__dict__.setdefault("by_size", {})
        request = requests.get(size)
        if request is None:
            if len(requests) >= MAX_SIZES:
                requests.clear()
            request = requests[size] = _Request.of(self._compile(size))
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
                        "NUM_STREAMS": 0,  # in the caller's thread: no hand-over, and callers run side by side
                        "ENABLE_CPU_PINNING": False,
                    },
                )
                if len(self._compiled) >= MAX_SIZES:
                    self._compiled.pop(next(iter(self._compiled)))
                self._compiled[size] = compiled
            return compiled
