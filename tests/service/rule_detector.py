"""A detector without a network: its answer is a plain rule of the pair, so that mixed-up answers would show."""

from __future__ import annotations

import threading
import time
from typing import Self

import numpy as np

from viflow_anomaly.config import DetectorConfig, MotorSource
from viflow_anomaly.detection import (
    AnalyzedRegion,
    Detection,
    ImageSize,
    ModelInfo,
    ResidualSummary,
    rois_from_regions,
)
from viflow_anomaly.pair_detector import Backend, Execution, LoadedWeights
from viflow_anomaly.regions import find_regions
from viflow_anomaly.sensor_data import FramePair

MODEL = ModelInfo(name="rule", version="1", sha256="ab" * 32)


class RuleDetector:
    """The regions of the frame difference; optionally waits for ``may_go``, or raises ``error``."""

    def __init__(
        self,
        *,
        config: DetectorConfig | None = None,
        may_go: threading.Event | None = None,
        error: Exception | None = None,
        calls: list[tuple[FramePair, DetectorConfig]] | None = None,
    ) -> None:
        self.config = config or DetectorConfig()
        self.motor_source: MotorSource | None = None
        self.model_info = MODEL
        self.execution = Execution(Backend("rule", "cpu", "f32"), None)
        self.may_go = may_go
        self.error = error
        self.calls = [] if calls is None else calls

    @property
    def loaded_weights(self) -> tuple[LoadedWeights, ...]:
        network = LoadedWeights("network", MODEL.name, MODEL.version, MODEL.sha256, "rule", self.execution.network)
        return (network,)

    def with_config(self, config: DetectorConfig) -> Self:
        return type(self)(config=config, may_go=self.may_go, error=self.error, calls=self.calls)

    def detect(self, pair: FramePair, *, decode_ms: float = 0.0) -> Detection:
        self.calls.append((pair, self.config))
        if self.may_go is not None:
            self.may_go.wait(20)
        if self.error is not None:
            raise self.error
        started = time.perf_counter()
        residual = np.abs(pair.source.image.astype(np.float32) - pair.target.image.astype(np.float32))
        height, width = residual.shape
        size = ImageSize(width, height)
        found = find_regions(residual, np.ones(residual.shape, dtype=bool), self.config.regions)
        spent_ms = (time.perf_counter() - started) * 1e3
        return Detection(
            source_timestamp_ns=pair.source.timestamp_ns,
            target_timestamp_ns=pair.target.timestamp_ns,
            image=size,
            status="ok",
            reasons=(),
            model=self.model_info,
            rois=rois_from_regions(found.regions, size, include_masks=self.config.include_masks),
            region_analyzed=AnalyzedRegion(0, 0, width, height),
            residual=ResidualSummary(*(float(x) for x in (residual.mean(), np.median(residual), residual.max()))),
            timings_ms={"decode": decode_ms, "regions": spent_ms, "total": decode_ms + spent_ms},
        )
