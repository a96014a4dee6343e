"""What all endpoints share: one value, made by ``create_app`` and handed to the modules that add endpoints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from viflow_anomaly_service.admission import AdmissionGate
from viflow_anomaly_service.detector_pool import DetectorPool
from viflow_anomaly_service.events.attach import EventParts
from viflow_anomaly_service.live.pair_memory import PairMemory
from viflow_anomaly_service.metrics import ServiceMetrics
from viflow_anomaly_service.models.table import ModelSet, ModelTable
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.streams.table import StreamTable

if TYPE_CHECKING:
    from viflow_anomaly_service.store.keeper import ResultKeeper


@dataclass(frozen=True)
class ServiceCore:
    """The parts of one application.

    Args:
        settings: as they were resolved.
        metrics: where everything is counted.
        models: the detectors, once they are loaded.
        gate: who may come in.
        pool: who does the work.
        keeper: where detections stay; None: nowhere.
        streams: what is remembered between frames.
        events: what is told of what moves.
        live: the pairs that were judged a moment ago.
    """

    settings: ServiceSettings
    metrics: ServiceMetrics
    models: ModelTable
    gate: AdmissionGate
    pool: DetectorPool
    keeper: ResultKeeper | None
    streams: StreamTable
    events: EventParts
    live: PairMemory

    def require_judging(self) -> ModelSet:
        """The models for a call, if a pair could be judged and kept at all.

        Raises:
            Problem: 503.
        """
        self.gate.require_open()
        try:
            models = self.models.require()
        except Problem:
            self.metrics.shed.labels("not_ready").inc()
            raise
        if self.keeper is not None:
            self.keeper.require_usable()  # before a pair is judged for nothing
        return models
