"""A detector that knows how the camera turned: what it answers of the rig is a plain rule of the pair."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from difference_detector import DifferenceDetector

from viflow_anomaly.correction import Correction, MeasuredTurn
from viflow_anomaly.detection import Detection
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.prediction import PredictedFlow
from viflow_anomaly.sensor_data import Float64Array, FramePair

NOTHING = np.zeros((4, 4, 2), np.float32)


def corrected(turned_rad: Float64Array, *, sigma_rad: float = 1e-3, inlier_share: float = 0.9) -> Correction:
    """A correction that turned by so much."""
    turn = MeasuredTurn(turned_rad, sigma_rad**2 * np.eye(3))
    return Correction(NOTHING, None, inlier_share, 0.0, converged=True, turn=turn)


class TurningAnalysis(NamedTuple):
    detection: Detection
    residual: Float32Array
    predicted: PredictedFlow | None


@dataclass
class TurningDetector(DifferenceDetector):
    """A turn that depends on the stamps and on the gyro as the pair has it; every pair's samples are kept."""

    gyros: list[Float64Array] = field(default_factory=list)

    def analyze(self, pair: FramePair, *, decode_ms: float = 0.0) -> TurningAnalysis:  # type: ignore[override]
        detection, residual, _ = super().analyze(pair, decode_ms=decode_ms)
        self.gyros.append(pair.imu.gyro_rad_s)
        k = pair.source.timestamp_ns // 50_000_000 % 7
        bias = np.array([0.02, -0.01, 0.03]) + 1e-3 * k
        inside = np.searchsorted(pair.imu.timestamps_ns, pair.source.timestamp_ns)
        turned = pair.interval_ns * 1e-9 * (bias + 1e-2 * pair.imu.gyro_rad_s[inside])
        correction = None if k == 3 else corrected(turned)
        return TurningAnalysis(
            detection, residual, PredictedFlow(NOTHING, 4, 0, NOTHING, correction, None, NOTHING[None])
        )
