"""An exported network with its convolutions in int8, by NNCF; their ranges are those of calibration samples.

Only convolutions: they are nearly all of the work, and what lies between them is geometry. Products of the motion code
and of rotations lose the camera's motion in eight bits (measured: flow off by 6 px in the mean).
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

from viflow_anomaly.errors import MissingDependencyError
from viflow_anomaly.runtime.exported import Feed

CONVOLUTIONS = frozenset({"Convolution", "Conv"})
"""In OpenVINO, in ONNX."""


def quantised_onnx(model: Any, samples: Sequence[Feed]) -> Any:
    """An ONNX model for ONNX Runtime.

    Raises:
        MissingDependencyError: ``nncf_missing``.
    """
    others = {node.op_type for node in model.graph.node} - CONVOLUTIONS
    used = {one.name for one in model.graph.input}
    return _quantised(model, others, [_kept(sample, used) for sample in samples])


def quantised_openvino(model: Any, samples: Sequence[Feed]) -> Any:
    """An OpenVINO model; errors as ``quantised_onnx``."""
    others = {one.get_type_name() for one in model.get_ops()} - CONVOLUTIONS
    used = {one.get_any_name() for one in model.inputs}
    return _quantised(model, others, [_kept(sample, used) for sample in samples])


def _kept(sample: Feed, used: set[str]) -> Feed:
    """An export drops the inputs that its network ignores."""
    return {name: value for name, value in sample.items() if name in used}


def _quantised(model: Any, ignored_types: set[str], samples: Sequence[Feed]) -> Any:
    assert samples
    with _quiet():
        nncf = require_nncf()
        return nncf.quantize(
            model,
            nncf.Dataset(samples),
            subset_size=len(samples),
            ignored_scope=nncf.IgnoredScope(types=sorted(ignored_types), validate=False),
        )


def require_nncf() -> Any:
    """The package, or the error that says how to get it."""
    os.environ.setdefault("NNCF_CI", "1")  # or it reports its use to its makers
    try:
        import nncf  # noqa: PLC0415  # an extra, seconds
    except ImportError as err:
        raise MissingDependencyError(
            "export --int8: expected the package nncf, found it missing: pip install 'viflow-anomaly[int8]'",
            code="nncf_missing",
        ) from err
    return nncf


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """It draws progress bars on stdout and tells of every layer that it leaves out; errors still come through."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
