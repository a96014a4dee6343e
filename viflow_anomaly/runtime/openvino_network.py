"""An exported network on OpenVINO's CPU device, compiled once for each size of its input."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Self

import openvino

from viflow_anomaly.checkpoint_record import EvidenceRecord, TensorRecord, corrupt_checkpoint, read_checkpoint_file
from viflow_anomaly.config import Precision
from viflow_anomaly.errors import CheckpointError
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.runtime.exported import exported_metadata

Size = tuple[int, int]
MAX_SIZES = 8
"""Compiled networks kept; one takes a few megabytes and some 100 ms to make."""


def _require_fresh(path: Path, data: bytes, record: TensorRecord) -> None:
    """An export must be the very file that was made from its checkpoint as it is now: the record names its checksum."""
    found = hashlib.sha256(data).hexdigest()
    if found != record.onnx_sha256:
        option = "--evidence-head" if isinstance(record, EvidenceRecord) else "--checkpoint"
        raise CheckpointError(
            f"{path}: expected the export that {path.with_suffix('.json').name} names, sha256 {record.onnx_sha256}, "
            f"found {found}: altered, or older than the checkpoint; make it anew with "
            f"viflow-anomaly export {option} {path.with_suffix('.safetensors')}",
            code="export_stale",
            field="checkpoint",
        )


class Request(NamedTuple):
    """One inference request, and views of its own buffers by name."""

    request: Any
    inputs: dict[str, Float32Array]
    outputs: dict[str, Float32Array]

    @classmethod
    def of(cls, compiled: Any) -> Self:
        """A new request; its shapes are fixed, so its buffers stay where they are. Inputs begin as zeros."""
        request = compiled.create_infer_request()
        inputs, outputs = (
            {port.get_any_name(): request.get_tensor(port).data for port in ports}
            for ports in (compiled.inputs, compiled.outputs)
        )
        for values in inputs.values():
            values.fill(0)
        return cls(request, inputs, outputs)


class OpenvinoNetwork:
    """Reads ``NAME.onnx``.

    Args:
        path: of the exported network.
        record: of the checkpoint that it must have been exported from.
        shapes: of the inputs that depend on the size (height, width) of what is seen; those that the network has
            not are passed over.
        adapt: changes the network that was read before it is compiled.
        threads: of one prediction.
        precision: "auto" computes in bfloat16 where the CPU has it.

    Raises:
        CheckpointError: ``export_stale``: altered, or the checkpoint was replaced after it; ``checkpoint_corrupt``.
    """

    def __init__(
        self,
        path: Path,
        record: TensorRecord,
        *,
        shapes: Callable[[Size], dict[str, list[int]]],
        adapt: Callable[[Any], None] | None = None,
        threads: int,
        precision: Precision = "f32",
    ) -> None:
        data = read_checkpoint_file(path)
        _require_fresh(path, data, record)
        self._core = openvino.Core()
        try:
            self.metadata = exported_metadata(self._core.read_model(data))
        except RuntimeError as err:
            raise corrupt_checkpoint(
                path, f"expected an ONNX network of this package, found: {str(err)[-200:]}"
            ) from err
        self._data = data
        self._shapes = shapes
        self._adapt = adapt
        self._threads = threads
        has_bfloat16 = "BF16" in self._core.get_property("CPU", "OPTIMIZATION_CAPABILITIES")
        self._precision = "bf16" if precision == "auto" and has_bfloat16 else "f32"
        self._compiled: dict[Size, Any] = {}
        self._lock = threading.Lock()
        self._requests = threading.local()

    def request(self, size: Size) -> Request:
        """This thread's request for inputs of ``size``: requests hold buffers, so threads share none."""
        requests: dict[Size, Request] = self._requests.__dict__.setdefault("by_size", {})
        request = requests.get(size)
        if request is None:
            if len(requests) >= MAX_SIZES:
                requests.clear()
            request = requests[size] = Request.of(self._compile(size))
        return request

    def _compile(self, size: Size) -> Any:
        with self._lock:
            compiled = self._compiled.get(size)
            if compiled is None:
                model = self._core.read_model(self._data)
                if self._adapt is not None:
                    self._adapt(model)
                names = {port.get_any_name() for port in model.inputs}
                model.reshape({name: shape for name, shape in self._shapes(size).items() if name in names})
                compiled = self._core.compile_model(
                    model,
                    "CPU",
                    {
                        "INFERENCE_PRECISION_HINT": self._precision,
                        "INFERENCE_NUM_THREADS": self._threads,
                        "NUM_STREAMS": 0,  # in the caller's thread: no hand-over, and callers run side by side
                        "ENABLE_CPU_PINNING": False,
                    },
                )
                if len(self._compiled) >= MAX_SIZES:
                    self._compiled.pop(next(iter(self._compiled)))
                self._compiled[size] = compiled
            return compiled
