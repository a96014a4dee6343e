"""One call of a stream in a worker's thread: decode, judge what can be judged, encode. Changes nothing by itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

from pydantic import ValidationError

from viflow_anomaly.datasets.camera_json import camera_from_mapping
from viflow_anomaly.detection import Detection, to_json
from viflow_anomaly.errors import ViflowError
from viflow_anomaly.inspection import PairSigns, pair_signs
from viflow_anomaly.pair_detector import PairDetector
from viflow_anomaly.prediction import PredictedFlow
from viflow_anomaly.sensor_data import FramePair
from viflow_anomaly.stream import DetectionStream, Judged, PairJudge, StreamConfig, StreamState, StreamStep
from viflow_anomaly_service.detector_pool import Job
from viflow_anomaly_service.live.pair_memory import JudgedPair
from viflow_anomaly_service.live.pictures import Analyzing
from viflow_anomaly_service.metrics import ServiceMetrics
from viflow_anomaly_service.models.table import LoadedModel, ModelSet
from viflow_anomaly_service.problems import Problem, problem_of_error, problem_of_validation
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.stage_times import StageClock
from viflow_anomaly_service.streams.request import StreamInput
from viflow_anomaly_service.streams.schemas import StreamSetup
from viflow_anomaly_service.thumbnails import wanted_thumbnail

Reading = Callable[[], StreamInput]
"""Of what one call sent; it may take a while, and raises Problem."""


@dataclass(frozen=True)
class BegunStream:
    """What the first call decides: what was said, which model judges, under which configuration, and the stream."""

    setup: StreamSetup
    model: LoadedModel
    detector: PairDetector
    stream: DetectionStream


@dataclass(frozen=True)
class JudgedCall:
    """What a call came to.

    Attributes:
        received: the call itself.
        begun: the stream from now on.
        step: the state behind it, detections and faults.
        bodies: the detections' JSON.
        pairs: what each of them was made from.
        thumbnails: the pictures that are kept beside them.
    """

    received: StreamInput
    begun: BegunStream
    step: StreamStep
    bodies: list[str]
    pairs: list[JudgedPair]
    thumbnails: list[bytes | None]


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
            judged: Judged = cast(Analyzing, self.detector).analyze(pair, decode_ms=decode_ms)
            return judged
        return _DetectionOnly(self.detector.detect(pair, decode_ms=decode_ms))


class ObservedJudge:
    """Notes which pairs a call judged, so that they can be looked at afterwards.

    Attributes:
        seen: pair and signs of each, in order.
    """

    def __init__(self, judge: PairJudge) -> None:
        self._judge = judge
        self.seen: list[tuple[FramePair, PairSigns]] = []

    def analyze(self, pair: FramePair, *, decode_ms: float = 0.0) -> Judged:
        judged = self._judge.analyze(pair, decode_ms=decode_ms)
        self.seen.append((pair, pair_signs(pair, judged.predicted)))
        return judged


class StreamWork:
    """What a worker does for one call.

    Args:
        models: those that were there when the call came; one of them begins a stream.
        read: makes the library's values of what was sent; let go of after that.
        known: what an earlier call has begun.
        state: where the stream stands.
        settings: limits.
        metrics: told of the detections.
        clock: of the call.
    """

    def __init__(
        self,
        models: ModelSet,
        read: Reading,
        *,
        known: BegunStream | None,
        state: StreamState,
        settings: ServiceSettings,
        metrics: ServiceMetrics,
        clock: StageClock,
    ) -> None:
        self._models = models
        self._read: Reading | None = read
        self._known = known
        self._state = state
        self._settings = settings
        self._metrics = metrics
        self._clock = clock

    def __call__(self, job: Job[JudgedCall]) -> JudgedCall:
        """The call judged.

        Raises:
            Problem: whatever is wrong with it; the stream then stays where it is.
            AbandonedError: between two stages, when the client has gone.
        """
        self._clock.note("queue", job.waited_s)
        with self._clock.stage("decode"):
            assert self._read is not None  # noqa: S101 - called once
            received = self._read()
            self._read = None
            begun = self._stream_of(received)
        job.require_wanted()
        with self._clock.stage("detect"):
            observed = ObservedJudge(begun.stream.detector)
            step = feed(replace(begun.stream, detector=observed), self._state, received)
        job.require_wanted()
        with self._clock.stage("encode"):
            bodies = [to_json(detection) for detection in step.detections]
            thumbnails = [
                wanted_thumbnail(self._settings, pair.source.image, detection)
                for (pair, _), detection in zip(observed.seen, step.detections, strict=True)
            ]
        for detection in step.detections:
            self._metrics.observe_detection(detection, begun.model.name)
        self._clock.log |= {"pairs": len(bodies), "faults": len(step.faults)}
        pairs = [
            JudgedPair(pair, begun.model, begun.detector, detection, body, signs)
            for (pair, signs), detection, body in zip(observed.seen, step.detections, bodies, strict=True)
        ]
        return JudgedCall(received, begun, step, bodies, pairs, thumbnails)

    def _stream_of(self, received: StreamInput) -> BegunStream:
        said = received.setup
        if self._known is None:
            return new_stream(self._models, received, self._settings)
        setup = self._known.setup
        for name in ("camera", "options"):
            wanted, found = getattr(setup, name), getattr(said, name)
            if found is not None and found != wanted:
                place = received.field_names.get(name, name)
                detail = f"{place}: expected none, or the one that the stream was begun with, found another one"
                raise Problem(409, code="stream_setup_changed", detail=detail, field=place)
        return self._known


def new_stream(models: ModelSet, received: StreamInput, settings: ServiceSettings) -> BegunStream:
    """A stream as the call that begins it wants it.

    Raises:
        Problem: 422 for a camera, a model or options that cannot be used; 501 ``streams_motor_unsupported``.
    """
    setup, names = received.setup, received.field_names
    options_place = names.get("options", "options")
    model = models.chosen(None if setup.options is None else setup.options.model, f"{options_place}.model")
    detector = model.detector
    if detector.motor_source is not None:
        raise Problem(501, code="streams_motor_unsupported", detail="expected a model without motor input, found one")
    try:
        camera = None if setup.camera is None else camera_from_mapping(setup.camera, field="camera")
    except ViflowError as err:
        raise problem_of_error(err, names) from err
    if setup.options is not None:
        try:
            detector = detector.with_config(setup.options.applied_to(detector.config))
        except ValidationError as err:
            raise problem_of_validation(err, f"{options_place}.regions") from err
        except ViflowError as err:
            raise problem_of_error(err, names) from err
    config = StreamConfig(max_imu_samples=max(settings.max_imu_samples, 2))
    return BegunStream(setup, model, detector, DetectionStream(StreamJudge(detector), camera=camera, config=config))


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
