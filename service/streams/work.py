"""One call of a stream in a worker's thread: decode, judge what can be judged, encode. Changes nothing by itself."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol, cast

from pydantic import ValidationError

from viflow_anomaly.datasets.camera_json import camera_from_mapping
from viflow_anomaly.detection import Detection, to_json
from viflow_anomaly.errors import ViflowError
from viflow_anomaly.pair_detector import PairDetector
from viflow_anomaly.prediction import PredictedFlow
from viflow_anomaly.sensor_data import FramePair
from viflow_anomaly.stream import DetectionStream, Judged, StreamConfig, StreamState, StreamStep
from viflow_anomaly_service.detector_pool import Job
from viflow_anomaly_service.metrics import ServiceMetrics, Stage
from viflow_anomaly_service.problems import Problem, problem_of_error, problem_of_validation
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.stage_times import StageTime
from viflow_anomaly_service.streams.request import StreamInput, read_input
from viflow_anomaly_service.streams.schemas import StreamSetup
from viflow_anomaly_service.thumbnails import wanted_thumbnail


@dataclass(frozen=True)
class JudgedCall:
    """What a call came to.

    Attributes:
        received: the call itself.
        setup, stream: of the stream from now on.
        step: the state behind it, detections and faults.
        bodies: the detections' JSON.
        thumbnails: the pictures that are kept beside them.
    """

    received: StreamInput
    setup: StreamSetup
    stream: DetectionStream
    step: StreamStep
    bodies: list[str]
    thumbnails: list[bytes | None]


class _Analyzing(Protocol):
    def analyze(self, pair: FramePair, *, decode_ms: float = 0.0) -> Judged: ...


@dataclass(frozen=True)
class _DetectionOnly:
    detection: Detection
    predicted: PredictedFlow | None = None


@dataclass(frozen=True)
class StreamJudge:
    """A detector as a stream asks for it; one that cannot say how the camera turned says its detection only."""

    detector: PairDetector

    def analyze(self, pair: FramePair, *, decode_ms: float = 0.0) -> Judged:
        if hasattr(self.detector, "analyze"):
            return cast(_Analyzing, self.detector).analyze(pair, decode_ms=decode_ms)
        return _DetectionOnly(self.detector.detect(pair, decode_ms=decode_ms))


class StreamWork:
    """What a worker does for one call.

    Args:
        detector: shared by all threads.
        body: the whole body; let go of once it is decoded.
        content_type: of the body.
        known: setup and stream, where an earlier call has begun it.
        state: where the stream stands.
        settings: limits.
        metrics: told of every stage and of the detections.

    Attributes:
        log: what the request's log line says of it.
        stages: those that are over.
    """

    def __init__(
        self,
        detector: PairDetector,
        body: bytes,
        content_type: str,
        *,
        known: tuple[StreamSetup, DetectionStream] | None,
        state: StreamState,
        settings: ServiceSettings,
        metrics: ServiceMetrics,
    ) -> None:
        self._detector = detector
        self._body = body
        self._content_type = content_type
        self._known = known
        self._state = state
        self._settings = settings
        self._metrics = metrics
        self.log: dict[str, Any] = {}
        self.stages: list[StageTime] = []

    def __call__(self, job: Job[JudgedCall]) -> JudgedCall:
        """The call judged.

        Raises:
            Problem: whatever is wrong with it; the stream then stays where it is.
            AbandonedError: between two stages, when the client has gone.
        """
        self._note("queue", job.waited_s)
        with self._stage("decode"):
            received = read_input(self._body, self._content_type, self._settings)
            self._body = b""
            setup, stream = self._stream_of(received)
        job.require_wanted()
        with self._stage("detect"):
            step = feed(stream, self._state, received)
        job.require_wanted()
        with self._stage("encode"):
            bodies = [to_json(detection) for detection in step.detections]
            thumbnails = self._thumbnails(received, step)
        for detection in step.detections:
            self._metrics.observe_detection(detection)
        self.log |= {"pairs": len(bodies), "faults": len(step.faults)}
        return JudgedCall(received, setup, stream, step, bodies, thumbnails)

    def _thumbnails(self, received: StreamInput, step: StreamStep) -> list[bytes | None]:
        frames = (*self._state.frames, *(() if received.frame is None else (received.frame,)))
        images = {frame.timestamp_ns: frame.image for frame in frames}
        return [wanted_thumbnail(self._settings, images[one.source_timestamp_ns], one) for one in step.detections]

    def _stream_of(self, received: StreamInput) -> tuple[StreamSetup, DetectionStream]:
        said = received.setup
        if self._known is None:
            return said, new_stream(self._detector, received, self._settings)
        setup, stream = self._known
        for name in ("camera", "options"):
            wanted, found = getattr(setup, name), getattr(said, name)
            if found is not None and found != wanted:
                place = received.field_names.get(name, name)
                detail = f"{place}: expected none, or the one that the stream was begun with, found another one"
                raise Problem(409, code="stream_setup_changed", detail=detail, field=place)
        return setup, stream

    @contextmanager
    def _stage(self, stage: Stage) -> Iterator[None]:
        started = time.perf_counter()
        try:
            yield
        finally:
            self._note(stage, time.perf_counter() - started)

    def _note(self, stage: Stage, seconds: float) -> None:
        self._metrics.observe_stage(stage, seconds)
        self.log[f"{stage}_ms"] = round(seconds * 1e3, 3)
        self.stages.append(StageTime.until_now(stage, seconds))


def new_stream(detector: PairDetector, received: StreamInput, settings: ServiceSettings) -> DetectionStream:
    """A stream as the call that begins it wants it.

    Raises:
        Problem: 422 for a camera or options that cannot be used.
    """
    setup, names = received.setup, received.field_names
    try:
        camera = None if setup.camera is None else camera_from_mapping(setup.camera, field="camera")
    except ViflowError as err:
        raise problem_of_error(err, names) from err
    if setup.options is not None:
        try:
            detector = detector.with_config(setup.options.applied_to(detector.config))
        except ValidationError as err:
            raise problem_of_validation(err, f"{names.get('options', 'options')}.regions") from err
        except ViflowError as err:
            raise problem_of_error(err, names) from err
    config = StreamConfig(max_imu_samples=max(settings.max_imu_samples, 2))
    return DetectionStream(StreamJudge(detector), camera=camera, config=config)


def feed(stream: DetectionStream, state: StreamState, received: StreamInput) -> StreamStep:
    """First the samples, then the frame, which may be what they were waited with."""
    detections: list[Detection] = []
    faults = []
    if received.imu is not None:
        step = stream.add_imu(state, received.imu)
        state, detections, faults = step.state, [*step.detections], [*step.faults]
    if received.frame is not None:
        step = stream.add_frame(state, received.frame)
        state, detections, faults = step.state, [*detections, *step.detections], [*faults, *step.faults]
    return StreamStep(state, tuple(detections), tuple(faults))
