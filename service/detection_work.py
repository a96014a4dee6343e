"""One request in a worker's thread: decode, detect, encode, each under its own clock."""

from __future__ import annotations

from viflow_anomaly.detection import Detection, to_json
from viflow_anomaly_service.detector_pool import Job
from viflow_anomaly_service.pair_work import PairWork
from viflow_anomaly_service.thumbnails import wanted_thumbnail


class DetectionWork(PairWork):
    """What a worker does for ``POST /detect``.

    Attributes:
        detection: what the answer says; None before there is one.
        thumbnail: the picture that is kept beside it; None: there is none.
    """

    detection: Detection | None = None
    thumbnail: bytes | None = None

    def __call__(self, job: Job[bytes]) -> bytes:
        """The detection as UTF-8 JSON.

        Raises:
            Problem: whatever is wrong with the request, with its code and field.
            AbandonedError: between two stages, when the client has gone.
        """
        sent = self._decoded(job)
        with self._judging(sent):
            detector = sent.model.detector.with_config(sent.config)
            self.detection = detection = detector.detect(sent.pair, decode_ms=self._clock.log["decode_ms"])
        self._tell(detection, sent)
        job.require_wanted()
        with self._clock.stage("encode"):
            self.thumbnail = wanted_thumbnail(self._settings, sent.pair.source.image, detection)
            return to_json(detection).encode("utf-8")
