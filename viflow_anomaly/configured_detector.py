"""The detector that settings describe: the one place where their fields become arguments."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import cv2

from viflow_anomaly.alarm_calibration import calibrated
from viflow_anomaly.config import DetectorConfig, NetworkPrecision, Precision, RuntimeName
from viflow_anomaly.detector import AnomalyDetector


class DetectorSettings(Protocol):
    """What the command line's settings and the service's have in common."""

    @property
    def checkpoint(self) -> Path | None: ...

    @property
    def evidence_head(self) -> Path | None: ...

    @property
    def calibration(self) -> Path | None: ...

    @property
    def detector(self) -> DetectorConfig: ...

    @property
    def device(self) -> str: ...

    @property
    def runtime(self) -> RuntimeName: ...

    @property
    def threads(self) -> int: ...

    @property
    def precision(self) -> Precision: ...

    @property
    def network_precision(self) -> NetworkPrecision: ...


def load_configured(settings: DetectorSettings, *, evidence: bool = True) -> AnomalyDetector:
    """The detector, calibrated; sets how many threads OpenCV uses in this process, too.

    Args:
        evidence: False: no evidence head is loaded.

    Raises:
        CheckpointError: a checkpoint that cannot be used.
        ConfigError: as ``AnomalyDetector.from_checkpoint`` and ``alarm_calibration.calibrated``.
    """
    cv2.setNumThreads(settings.threads)
    detector = AnomalyDetector.from_checkpoint(
        settings.checkpoint,
        config=settings.detector,
        device=settings.device,
        runtime=settings.runtime,
        threads=settings.threads,
        evidence_head=settings.evidence_head,
        precision=settings.precision,
        network_precision=settings.network_precision,
        with_evidence=evidence,
    )
    return calibrated(detector, settings.calibration)
