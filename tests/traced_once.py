"""torch traces a network as ONNX in ten seconds; within a test process the same weights are traced once."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from pydantic import BaseModel
from torch import nn

from viflow_anomaly.runtime import export

Trace = Callable[[nn.Module, Any], Any]


def _once(trace: Trace) -> Trace:
    traced: dict[str, Any] = {}

    def found(network: nn.Module, about: BaseModel) -> Any:
        key = hashlib.sha256(f"{type(network)} {about.model_dump_json()}".encode())
        for name, tensor in network.state_dict().items():
            key.update(name.encode() + tensor.cpu().contiguous().numpy().tobytes())
        if key.hexdigest() not in traced:
            traced[key.hexdigest()] = trace(network, about)
        return copy.deepcopy(traced[key.hexdigest()])

    return found


_TRACES = {name: getattr(export, name) for name in ("trace_network", "trace_head")}


@contextmanager
def traced_once() -> Iterator[None]:
    """What ``export_network`` and ``export_head`` trace is kept, and a copy given to who asks again."""
    with pytest.MonkeyPatch.context() as patch:
        for name, trace in _TRACES.items():
            patch.setattr(export, name, _once(trace))
        yield


@contextmanager
def traced_anew() -> Iterator[None]:
    """As users have it, for tests of tracing itself."""
    with pytest.MonkeyPatch.context() as patch:
        for name, trace in _TRACES.items():
            patch.setattr(export, name, trace)
        yield
