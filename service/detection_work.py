"""One request in a worker's thread: decode, detect, encode, each under its own clock."""

from __future__ import annotations

from viflow_anomaly.detection import Detection, to_json
from viflow_anomaly.errors import ViflowError
from viflow_anomaly_service.detection_request import read_pair
from viflow_anomaly_service.detector_pool import Job
from viflow_anomaly_service.metrics import ServiceMetrics
from viflow_anomaly_service.models.table import ModelSet
from viflow_anomaly_service.problems import problem_of_error
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.stage_times import StageClock
from viflow_anomaly_service.thumbnails import wanted_thumbnail


class DetectionWork:
    """What a worker does for ``POST /detect``.

    Args:
        models: those that were there when the request came.
        body: the whole body; let go of once it is decoded.
        content_type: of the body.
        settings: limits.
        metrics: told of the detection.
        clock: of the request.

    Attributes:
        detection: what the answer says; None before there is one.
        thumbnail: the picture that is kept beside it; None: there is none.
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
        self.detection: Detection | None = None
        self.thumbnail: bytes | None = None

    def __call__(self, job: Job[bytes]) -> bytes:
        """The detection as UTF-8 JSON.

        Raises:
            Problem: whatever is wrong with the request, with its code and field.
            AbandonedError: between two stages, when the client has gone.
        """
        self._clock.note("queue", job.waited_s)
        with self._clock.stage("decode"):
            pair, model, config, field_names = read_pair(self._models, self._body, self._content_type, self._settings)
            self._body = b""
        job.require_wanted()
        with self._clock.stage("detect"):
            try:
                detection = model.detector.with_config(config).detect(pair, decode_ms=self._clock.log["decode_ms"])
            except ViflowError as err:
                raise problem_of_error(err, field_names) from err
        self.detection = detection
        self._metrics.observe_detection(detection, model.name)
        self._clock.log |= {"detection": detection.status, "regions": len(detection.rois)}
        job.require_wanted()
        with self._clock.stage("encode"):
            self.thumbnail = wanted_thumbnail(self._settings, pair.source.image, detection)
            return to_json(detection).encode("utf-8")
