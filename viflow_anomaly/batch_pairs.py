"""What a batch run makes of one pair. Task and answer are plain values, so that another process may do it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from viflow_anomaly.batch_pictures import PairAnalysis
from viflow_anomaly.batch_record import PairFailure
from viflow_anomaly.config import RigEstimateConfig
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.detection import to_json
from viflow_anomaly.errors import ViflowError
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.pair_detector import DetectorIdentity
from viflow_anomaly.rig_estimate import TurnObservation, corrected_pair, observe
from viflow_anomaly.sensor_data import Float64Array, FramePair, Uint8Array


class PairAnalyzer(DetectorIdentity, Protocol):
    """What a batch run needs of ``viflow_anomaly.detector.AnomalyDetector``."""

    def analyze(self, pair: FramePair, *, decode_ms: float = 0.0) -> PairAnalysis: ...


@dataclass(frozen=True, eq=False)
class PairTask:
    """Which pair, whether its picture is wanted, and [7] what it is corrected by (``RigEstimate.applicable``)."""

    index: int
    draw: bool
    applied: Float64Array


class PictureParts(NamedTuple):
    """What a picture shows below the boxes: the source image [H, W] and, where there is one, its residual [H, W]."""

    source: Uint8Array
    residual: Float32Array | None


class JudgedPair(NamedTuple):
    """A detection, ready to be written down.

    Attributes:
        status: ``ok`` or ``abstained``.
        text: its JSON.
        knows_turn: the detector tells how the camera turned, so that no ``observation`` is a finding, too.
        observation: what the pair says of the rig.
        parts: where its picture was wanted.
    """

    status: str
    text: str
    knows_turn: bool
    observation: TurnObservation | None
    parts: PictureParts | None


PairAnswer = JudgedPair | PairFailure


class PairJudge:
    """Reads and judges pairs of one recording. It keeps nothing, so that pairs may come in any order."""

    def __init__(self, pairs: RecordingPairs, detector: PairAnalyzer, rig: RigEstimateConfig) -> None:
        self.pairs = pairs
        self.rig = rig
        self._detector = detector

    def __call__(self, task: PairTask) -> PairAnswer:
        """The detection of a pair, or why its own data cannot give one."""
        try:
            started = time.perf_counter()
            pair = corrected_pair(self.pairs[task.index], task.applied)
            decode_ms = (time.perf_counter() - started) * 1e3
            analysis = self._detector.analyze(pair, decode_ms=decode_ms)
        except ViflowError as err:
            return PairFailure(*self.pairs.stamps(task.index), err.code, err.field, err.message)
        knows_turn = self.rig.enabled and analysis.predicted is not None
        observation = None
        if knows_turn and analysis.predicted is not None:
            observation = observe(pair, analysis.predicted.correction, self.rig, task.applied)
        parts = PictureParts(pair.source.image, analysis.residual) if task.draw else None
        return JudgedPair(analysis.detection.status, to_json(analysis.detection), knows_turn, observation, parts)
