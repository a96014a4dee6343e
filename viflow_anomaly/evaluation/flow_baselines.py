"""Classical optical flow beside ours: OpenCV's, and what opencv-contrib adds where it is installed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np

from viflow_anomaly.config import MotorSource
from viflow_anomaly.errors import ConfigError, MissingDependencyError
from viflow_anomaly.evaluation.flow_methods import MethodAbout
from viflow_anomaly.evaluation.flow_truth import PairName
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.sensor_data import FramePair, Uint8Array

ComputeFlow = Callable[[Uint8Array, Uint8Array], Any]

# OpenCV's stubs lack most of what is called here; absent parts are looked for by name.
_CV2: Any = cv2


@dataclass(frozen=True)
class BaselineMethod:
    """A method on the two images alone. The identity computes nothing whose time could be taken."""

    about: MethodAbout
    compute: ComputeFlow
    motor_source: MotorSource | None = None
    timed: bool = True

    def flow(self, pair: FramePair, name: PairName) -> Float32Array:
        del name
        return np.asarray(self.compute(pair.source.image, pair.target.image), dtype=np.float32)


class ChosenBaselines(NamedTuple):
    """What will be measured, and the defaults that this build of OpenCV lacks."""

    methods: list[BaselineMethod]
    left_out: list[str]


def identity(source: Uint8Array, target: Uint8Array) -> Float32Array:
    """No motion at all."""
    del target
    return np.zeros((*source.shape, 2), np.float32)


def _dis(preset: int) -> ComputeFlow:
    def compute(source: Uint8Array, target: Uint8Array) -> Any:
        return _CV2.DISOpticalFlow_create(preset).calc(source, target, None)

    return compute


def farneback(source: Uint8Array, target: Uint8Array) -> Any:
    """With the parameters of OpenCV's own class; coarse levels reach as far as the image allows."""
    return _CV2.FarnebackOpticalFlow_create().calc(source, target, None)


def rlof_epic(source: Uint8Array, target: Uint8Array) -> Any:
    """Robust local flow of a grid of points, EPIC interpolation between them; takes colour only."""
    return _CV2.optflow.calcOpticalFlowDenseRLOF(
        _colour(source), _colour(target), None, interp_type=_CV2.optflow.INTERP_EPIC
    )


def simple_flow(source: Uint8Array, target: Uint8Array) -> Any:
    """NaN where it finds a pixel occluded; takes colour only."""
    return _CV2.optflow.createOptFlow_SimpleFlow().calc(_colour(source), _colour(target), None)


def _contrib(factory: str) -> ComputeFlow:
    def compute(source: Uint8Array, target: Uint8Array) -> Any:
        return getattr(_CV2.optflow, factory)().calc(source, target, None)

    return compute


def _colour(gray: Uint8Array) -> Uint8Array:
    return np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), dtype=np.uint8)


class _Baseline(NamedTuple):
    compute: ComputeFlow
    contrib: str | None = None
    """What ``cv2.optflow`` must have for it."""


BASELINES: dict[str, _Baseline] = {
    "identity": _Baseline(identity),
    "dis-ultrafast": _Baseline(_dis(_CV2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)),
    "dis-fast": _Baseline(_dis(_CV2.DISOPTICAL_FLOW_PRESET_FAST)),
    "dis-medium": _Baseline(_dis(_CV2.DISOPTICAL_FLOW_PRESET_MEDIUM)),
    "farneback": _Baseline(farneback),
    "rlof-epic": _Baseline(rlof_epic, "calcOpticalFlowDenseRLOF"),
    "deepflow": _Baseline(_contrib("createOptFlow_DeepFlow"), "createOptFlow_DeepFlow"),
    "pcaflow": _Baseline(_contrib("createOptFlow_PCAFlow"), "createOptFlow_PCAFlow"),
    "simpleflow": _Baseline(simple_flow, "createOptFlow_SimpleFlow"),
    "tv-l1": _Baseline(_contrib("createOptFlow_DualTVL1"), "createOptFlow_DualTVL1"),
}


def choose_baselines(names: Sequence[str] | None = None) -> ChosenBaselines:
    """Methods by name, in the order of ``BASELINES``; None: all that this build of OpenCV has.

    Raises:
        ConfigError: ``method_unknown``.
        MissingDependencyError: ``method_unavailable`` for one that was asked for and needs opencv-contrib.
    """
    wanted = list(BASELINES) if names is None else list(names)
    unknown = [name for name in wanted if name not in BASELINES]
    if unknown:
        raise ConfigError(
            f"methods: expected some of {', '.join(BASELINES)}, found {unknown[0]!r}",
            code="method_unknown",
            field="methods",
        )
    absent = [name for name in wanted if not _available(BASELINES[name])]
    if absent and names is not None:
        raise MissingDependencyError(
            f"methods: {', '.join(absent)}: expected an OpenCV with the optflow module of opencv-contrib, found "
            f"{cv2.__version__} without; opencv-contrib-python-headless takes the place of opencv-python-headless: "
            "pip install --force-reinstall --no-deps opencv-contrib-python-headless (see docs/evaluation.md)",
            code="method_unavailable",
            field="methods",
        )
    details = {"opencv": cv2.__version__}
    methods = [
        BaselineMethod(MethodAbout(name, "baseline", details=details), one.compute, timed=one.compute is not identity)
        for name, one in BASELINES.items()
        if name in wanted and name not in absent
    ]
    return ChosenBaselines(methods, absent)


def _available(baseline: _Baseline) -> bool:
    # The module alone says nothing: a replaced opencv-contrib leaves its empty folder behind.
    return baseline.contrib is None or hasattr(getattr(cv2, "optflow", None), baseline.contrib)
