"""An exported network on OpenVINO's CPU device, compiled once for each size of its input."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import openvino

from viflow_anomaly.config import Precision
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.runtime.exported import Export, foreign

Size = tuple[int, int]
MAX_SIZES = 8
"""Compiled networks kept; one takes a few megabytes and some 100 ms to make."""


def exported_metadata(model: Any) -> dict[str, str]:
    """What an export says of itself, from either of its formats; empty where it says nothing."""
    info = model.get_rt_info()
    if "framework" not in info:
        return {}
    return {str(key): str(value.astype(str)) for key, value in info["framework"].items()}


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
    """Reads an export.

    Args:
        export: of a network.
        shapes: of the inputs that depend on the size (height, width) of what is seen; those that the network has
            not are passed over.
        adapt: changes the network that was read before it is compiled.
        threads: of one prediction.
        precision: "auto" computes in bfloat16 where the CPU has it; "int8" is the export's own, the rest in float32.

    Raises:
        CheckpointError: ``checkpoint_corrupt``.
        ConfigError: ``precision_unavailable`` for bfloat16 on a CPU without it.
    """

    def __init__(
        self,
        export: Export,
        *,
        shapes: Callable[[Size], dict[str, list[int]]],
        adapt: Callable[[Any], None] | None = None,
        threads: int,
        precision: Precision = "f32",
    ) -> None:
        self._core = openvino.Core()
        self._export = export
        try:
            self.metadata = exported_metadata(self._read())
        except RuntimeError as err:
            raise foreign(export, str(err)[-200:]) from err
        self._shapes = shapes
        self._adapt = adapt
        self._threads = threads
        has_bfloat16 = "BF16" in self._core.get_property("CPU", "OPTIMIZATION_CAPABILITIES")
        if precision == "bf16" and not has_bfloat16:
            raise ConfigError(
                "precision: expected a CPU that computes in bfloat16 for 'bf16', found one that does not",
                code="precision_unavailable",
                field="precision",
            )
        self.precision = precision if precision != "auto" else "bf16" if has_bfloat16 else "f32"
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

    def _read(self) -> Any:
        export = self._export
        return self._core.read_model(export.data, *(() if export.weights is None else (export.weights,)))

    def _compile(self, size: Size) -> Any:
        with self._lock:
            compiled = self._compiled.get(size)
            if compiled is None:
                model = self._read()
                if self._adapt is not None:
                    self._adapt(model)
                names = {port.get_any_name() for port in model.inputs}
                model.reshape({name: shape for name, shape in self._shapes(size).items() if name in names})
                compiled = self._core.compile_model(
                    model,
                    "CPU",
                    {
                        "INFERENCE_PRECISION_HINT": "bf16" if self.precision == "bf16" else "f32",
                        "INFERENCE_NUM_THREADS": self._threads,
                        "NUM_STREAMS": 0,  # in the caller's thread: no hand-over, and callers run side by side
                        "ENABLE_CPU_PINNING": False,
                    },
                )
                if len(self._compiled) >= MAX_SIZES:
                    self._compiled.pop(next(iter(self._compiled)))
                self._compiled[size] = compiled
            return compiled
