"""What programs need of ``viflow_anomaly.detector.AnomalyDetector``, so that neither they nor their tests load one."""

from __future__ import annotations

from typing import Literal, NamedTuple, Protocol, Self

from viflow_anomaly.config import DetectorConfig, MotorSource
from viflow_anomaly.detection import Detection, ModelInfo
from viflow_anomaly.sensor_data import FramePair


class Backend(NamedTuple):
    """What one network is computed by, on and in: runtime and device by name; "f32", "bf16" or "int8"."""

    runtime: str
    device: str
    precision: str


class Execution(NamedTuple):
    """How a detector computes; ``evidence`` is None where no evidence head takes part."""

    network: Backend
    evidence: Backend | None

    def as_mapping(self) -> dict[str, dict[str, str] | None]:
        """Plain JSON values."""
        return {"network": self.network._asdict(), "evidence": self.evidence and self.evidence._asdict()}


class LoadedWeights(NamedTuple):
    """One of the networks in a detector: its part there, where it came from, what computes it.

    ``preset`` is the network's structure by name; None: an evidence head, which has one structure.
    """

    role: Literal["network", "evidence_head"]
    name: str
    version: str
    sha256: str
    preset: str | None
    backend: Backend


class DetectorIdentity(Protocol):
    """Which weights, under which configuration, fed with what, computed how."""

    @property
    def model_info(self) -> ModelInfo: ...

    @property
    def config(self) -> DetectorConfig: ...

    @property
    def motor_source(self) -> MotorSource | None: ...

    @property
    def execution(self) -> Execution: ...


class PairDetector(DetectorIdentity, Protocol):
    """Judges one pair; may be called from many threads."""

    def with_config(self, config: DetectorConfig) -> Self: ...

    @property
    def loaded_weights(self) -> tuple[LoadedWeights, ...]: ...

    def detect(self, pair: FramePair, *, decode_ms: float = 0.0) -> Detection: ...
