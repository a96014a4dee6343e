"""A recording -> ``detections.jsonl``, ``run.json`` and pictures; the main job of the command line.

One pair is in memory at a time. A pair that cannot be judged because its own data is broken is listed in
``run.json`` and the others go on. A killed run resumes where it stopped and ends with the same detections as an
uninterrupted one (``timings_ms`` apart).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol

from pydantic import Field, NonNegativeInt, PositiveInt

from viflow_anomaly.batch_files import (
    DETECTIONS_NAME,
    JOURNAL_NAME,
    RUN_NAME,
    Journal,
    clear_results,
    read_run,
    reopen_results,
    write_json,
)
from viflow_anomaly.batch_pictures import PairAnalysis, Pictures, overlay_of
from viflow_anomaly.batch_record import (
    BatchSummary,
    PairFailure,
    check_same_run,
    describe_outcome,
    describe_run,
    summarise,
)
from viflow_anomaly.batch_tracking import tracked_lines
from viflow_anomaly.config import DetectorConfig, FrozenConfig, MotorSource, TrackingConfig
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.detection import Detection, ModelInfo, to_json
from viflow_anomaly.detection_reading import detection_from_json
from viflow_anomaly.errors import DatasetError, InvalidInputError, ViflowError
from viflow_anomaly.sensor_data import FramePair
from viflow_anomaly.tracking import Tracker, TrackingState


class BatchOptions(FrozenConfig):
    """Where a batch run writes, which pairs it takes and what it draws.

    ``overlays``: how many pictures, spread evenly over the run, or ``"all"``. ``tracking``: how regions become tracks;
    None: they do not, ``track_id`` stays null.
    """

    out_dir: Path
    look_ahead: int = Field(default=1, ge=1, le=4)
    limit: PositiveInt | None = None
    overlays: NonNegativeInt | Literal["all"] = 0
    video: bool = False
    tracking: TrackingConfig | None = TrackingConfig()
    resume: bool = False
    overwrite: bool = False


class PairDetector(Protocol):
    """What a batch run needs of ``viflow_anomaly.detector.AnomalyDetector``."""

    @property
    def model_info(self) -> ModelInfo: ...

    @property
    def config(self) -> DetectorConfig: ...

    @property
    def motor_source(self) -> MotorSource | None: ...

    def detect(self, pair: FramePair, *, decode_ms: float = 0.0) -> Detection: ...

    def analyze(self, pair: FramePair, *, decode_ms: float = 0.0) -> PairAnalysis: ...


OnProgress = Callable[[int, int, int], None]
"""Called after every pair with: pairs behind us, pairs in all, failures so far."""


def run_batch(
    recording: Recording,
    detector: PairDetector,
    options: BatchOptions,
    *,
    settings: Mapping[str, Any] | None = None,
    on_progress: OnProgress | None = None,
) -> BatchSummary:
    """Judge every pair of ``recording`` and write the results to ``options.out_dir``.

    Args:
        recording: what to judge.
        detector: with what; its own configuration is recorded in ``run.json``.
        options: where to, which pairs, which pictures.
        settings: other settings of the caller, recorded beside the detector's.
        on_progress: told after every pair.

    Raises:
        DatasetError: ``recording_too_short``, ``trajectory_missing`` for a model that wants displacements.
        InvalidInputError: ``output_not_empty``, ``output_in_use``, ``options_contradict``,
            ``resume_config_differs``, ``resume_recording_differs``, ``resume_run_unreadable``.
        OSError: the results cannot be written; what is done stays for a run with ``resume``.
    """
    started = time.monotonic()
    pairs = RecordingPairs(recording, (options.look_ahead,), motor_source=detector.motor_source)
    count = min(len(pairs), options.limit or len(pairs))
    if not count:
        raise DatasetError(
            f"{recording.root}: expected at least {options.look_ahead + 1} frames, found {len(recording)}",
            code="recording_too_short",
        )
    run = describe_run(
        recording, model=detector.model_info, detector=detector.config, options=options, settings=settings or {}
    )
    _prepare(options, run)
    with Journal(options.out_dir / JOURNAL_NAME) as journal:
        _start(options, journal, pairs)
        write_json(options.out_dir / RUN_NAME, {"state": "running", **run})
        reused = len(journal.lines)
        complete = all(pairs.stamps(index) in journal.lines for index in range(count))
        pictures = Pictures(options.out_dir, count, overlays=options.overlays, video=options.video, complete=complete)
        tracker = Tracker(options.tracking) if options.tracking else None
        failures, state = [], TrackingState()
        for index in range(count):
            failure, state = _judge(pairs, index, detector, journal, pictures, tracker, state)
            failures += [failure] if failure else []
            if on_progress:
                on_progress(index + 1, count, len(failures))
        journal.publish(options.out_dir / DETECTIONS_NAME, partial(tracked_lines, tracker=tracker))
        pictures.finish([pairs.stamps(index)[0] for index in range(count)])
        wall_time_s = time.monotonic() - started
        summary = summarise(options.out_dir, journal.lines, failures, reused=reused, wall_time_s=wall_time_s)
        write_json(options.out_dir / RUN_NAME, {"state": "done", **run, **describe_outcome(summary)})
    return summary


def _judge(
    pairs: RecordingPairs,
    index: int,
    detector: PairDetector,
    journal: Journal,
    pictures: Pictures,
    tracker: Tracker | None,
    state: TrackingState,
) -> tuple[PairFailure | None, TrackingState]:
    """Detect, draw and write down one pair, or say why that cannot be done.

    ``state``, before and after the pair, is what pictures show; the journal is tracked as a whole when the run ends.
    """
    stamps = pairs.stamps(index)
    draw = pictures.missing(index, stamps[0])
    known = stamps in journal.lines
    if known and not draw:
        return None, _followed(tracker, state, journal.text(stamps))[0] if pictures.any else state
    try:
        started = time.perf_counter()
        pair = pairs[index]
        decode_ms = (time.perf_counter() - started) * 1e3
        analysis = detector.analyze(pair, decode_ms=decode_ms) if draw else None
        detection = analysis.detection if analysis else detector.detect(pair, decode_ms=decode_ms)
    except ViflowError as err:
        return PairFailure(*stamps, err.code, err.field, err.message), state
    text = to_json(detection)
    if pictures.any:
        state, tracked = _followed(tracker, state, journal.text(stamps) if known else text)
        if analysis is not None:
            pictures.write(index, stamps[0], overlay_of(pair, analysis, tracked))
    if not known:
        journal.append(stamps, detection.status, text)
    return None, state


def _followed(tracker: Tracker | None, state: TrackingState, text: str | bytes) -> tuple[TrackingState, Detection]:
    """One step of tracking, from what is written down: its numbers are rounded."""
    detection = detection_from_json(text)
    return (state, detection) if tracker is None else tracker.update(state, detection)


def _prepare(options: BatchOptions, run: Mapping[str, Any]) -> None:
    """Refuse to mix with what lies in the output directory; make the directory."""
    if options.resume and options.overwrite:
        raise InvalidInputError(
            "expected resume or overwrite, found both", code="options_contradict", field="overwrite"
        )
    out_dir = options.out_dir
    earlier = read_run(out_dir) if options.resume else None
    if earlier is not None:
        check_same_run(earlier, run, out_dir=out_dir)
        reopen_results(out_dir)
    elif not options.overwrite and out_dir.is_dir() and any(out_dir.iterdir()):
        what = "no run.json to resume from" if options.resume else "results or other files"
        raise InvalidInputError(
            f"{out_dir}: expected a new or empty directory, found {what}; "
            "choose another one, or --overwrite, or --resume an earlier run",
            code="output_not_empty",
            field="out",
        )
    out_dir.mkdir(parents=True, exist_ok=True)


def _start(options: BatchOptions, journal: Journal, pairs: RecordingPairs) -> None:
    """Begin anew where asked to; else refuse results of pairs that this recording does not have."""
    if options.overwrite:
        journal.clear()
        clear_results(options.out_dir)
    strangers = journal.lines.keys() - {pairs.stamps(index) for index in range(len(pairs))}
    if strangers:
        raise InvalidInputError(
            f"{options.out_dir}: expected results of {pairs.recording.root}, found {len(strangers)} pairs that are "
            f"not in it, the first at {min(strangers)[0]} ns",
            code="resume_recording_differs",
            field="out",
        )
