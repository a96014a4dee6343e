"""A detector without a network: the regions of the frame difference. What it answers is a plain rule of the pair."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from viflow_anomaly.config import DetectorConfig, MotorSource
from viflow_anomaly.detection import (
    AnalyzedRegion,
    Detection,
    ImageSize,
    ModelInfo,
    Reason,
    ResidualSummary,
    rois_from_regions,
)
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.pair_detector import Backend, Execution
from viflow_anomaly.prediction import PredictedFlow
from viflow_anomaly.regions import find_regions
from viflow_anomaly.sensor_data import FramePair


class DifferenceAnalysis(NamedTuple):
    detection: Detection
    residual: Float32Array
    predicted: PredictedFlow | None = None


@dataclass
class DifferenceDetector:
    """``on_pair`` is called with every pair, e.g. to fail or to interrupt; pairs whose source is dark are abstained."""

    config: DetectorConfig = field(default_factory=DetectorConfig)
    model_info: ModelInfo = field(default_factory=lambda: ModelInfo("difference", "1", "ab" * 32))
    on_pair: Callable[[FramePair], None] = lambda pair: None
    seen: list[int] = field(default_factory=list)
    motor_source: MotorSource | None = None
    execution: Execution = field(default_factory=lambda: Execution(Backend("rule", "cpu", "f32"), None))

    def with_config(self, config: DetectorConfig) -> DifferenceDetector:
        return replace(self, config=config)

    def detect(self, pair: FramePair, *, decode_ms: float = 0.0) -> Detection:
        return self.analyze(pair, decode_ms=decode_ms).detection

    def analyze(self, pair: FramePair, *, decode_ms: float = 0.0) -> DifferenceAnalysis:
        self.on_pair(pair)
        self.seen.append(pair.source.timestamp_ns)
        residual = np.abs(pair.source.image.astype(np.float32) - pair.target.image.astype(np.float32))
        height, width = residual.shape
        size = ImageSize(width, height)
        dark = float(pair.source.image.mean()) < 1.0
        found = find_regions(residual, np.ones(residual.shape, dtype=bool), self.config.regions)
        detection = Detection(
            source_timestamp_ns=pair.source.timestamp_ns,
            target_timestamp_ns=pair.target.timestamp_ns,
            image=size,
            status="abstained" if dark else "ok",
            reasons=(Reason("image_dark", "the source image is black"),) if dark else (),
            model=self.model_info,
            rois=() if dark else rois_from_regions(found.regions, size, include_masks=self.config.include_masks),
            region_analyzed=AnalyzedRegion(0, 0, width, height),
            residual=ResidualSummary(float(residual.mean()), float(np.median(residual)), float(residual.max())),
            timings_ms={"decode": decode_ms},
        )
        return DifferenceAnalysis(detection, residual)
