"""What programs need of ``viflow_anomaly.detector.AnomalyDetector``, so that neither they nor their tests load one."""

from __future__ import annotations

from typing import Protocol, Self

from viflow_anomaly.config import DetectorConfig, MotorSource
from viflow_anomaly.detection import Detection, ModelInfo
from viflow_anomaly.sensor_data import FramePair


class DetectorIdentity(Protocol):
    """Which weights, under which configuration, fed with what."""

    @property
    def model_info(self) -> ModelInfo: ...

    @property
    def config(self) -> DetectorConfig: ...

    @property
    def motor_source(self) -> MotorSource | None: ...


class PairDetector(DetectorIdentity, Protocol):
    """Judges one pair; may be called from many threads."""

    def with_config(self, config: DetectorConfig) -> Self: ...

    def detect(self, pair: FramePair, *, decode_ms: float = 0.0) -> Detection: ...
