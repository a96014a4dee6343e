"""The pair of one request in a worker's thread: decoded, judged and told of, whatever is made of it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from viflow_anomaly.config import DetectorConfig
from viflow_anomaly.detection import Detection
from viflow_anomaly.errors import ViflowError
from viflow_anomaly.sensor_data import FramePair
from viflow_anomaly_service.detection_request import read_pair
from viflow_anomaly_service.detector_pool import Job
from viflow_anomaly_service.metrics import ServiceMetrics
from viflow_anomaly_service.models.table import LoadedModel, ModelSet
from viflow_anomaly_service.problems import problem_of_error
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.stage_times import StageClock


class SentPair(NamedTuple):
    """A pair, the model and configuration that are to judge it, and what its request calls the library's fields."""

    pair: FramePair
    model: LoadedModel
    config: DetectorConfig
    field_names: Mapping[str, str]


class PairWork:
    """What is done for every request that brings a pair; a child says what it makes of it.

    Args:
        models: those that were there when the request came, of which it chooses one.
        body: the whole body, as for ``POST /detect``; let go of once it is decoded.
        content_type: of the body.
        settings: limits.
        metrics: told of the detection.
        clock: of the request.
    """

    def __init__(
        self,
        models: ModelSet,
        body: bytes,
        content_type: str,
        *,
        settings: ServiceSettings,
        metrics: ServiceMetrics,
        clock: StageClock,
    ) -> None:
        self._models = models
        self._body = body
        self._content_type = content_type
        self._settings = settings
        self._metrics = metrics
        self._clock = clock

    def _decoded(self, job: Job[Any]) -> SentPair:
        """Raises Problem: whatever is wrong with the request; AbandonedError: the client has gone."""
        self._clock.note("queue", job.waited_s)
        with self._clock.stage("decode"):
            sent = SentPair(*read_pair(self._models, self._body, self._content_type, self._settings))
            self._body = b""
        job.require_wanted()
        return sent

    @contextlib.contextmanager
    def _judging(self, sent: SentPair) -> Iterator[None]:
        """Inside, the library judges; raises Problem for what it finds wrong with the pair."""
        with self._clock.stage("detect"):
            try:
                yield
            except ViflowError as err:
                raise problem_of_error(err, sent.field_names) from err

    def _tell(self, detection: Detection, sent: SentPair) -> None:
        """Metrics and the log."""
        self._metrics.observe_detection(detection, sent.model.name)
        self._clock.log |= {"detection": detection.status, "regions": len(detection.rois)}
