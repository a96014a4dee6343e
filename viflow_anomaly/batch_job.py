"""A recording -> ``detections.jsonl``, ``run.json`` and pictures; the main job of the command line.

One pair is in memory at a time. A pair that cannot be judged because its own data is broken is listed in
``run.json`` and the others go on. A killed run resumes where it stopped and ends with the same detections as an
uninterrupted one (``timings_ms`` apart).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, Self

from pydantic import Field, NonNegativeInt, PositiveInt

from viflow_anomaly.batch_files import (
    DETECTIONS_NAME,
    JOURNAL_NAME,
    RIG_NAME,
    RUN_NAME,
    Journal,
    Stamps,
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
from viflow_anomaly.batch_rig import RigJournal
from viflow_anomaly.batch_tracking import tracked_lines
from viflow_anomaly.config import FrozenConfig, RigEstimateConfig, TrackingConfig
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.detection import Detection, to_json
from viflow_anomaly.detection_reading import detection_from_json
from viflow_anomaly.errors import DatasetError, InvalidInputError, ViflowError
from viflow_anomaly.pair_detector import DetectorIdentity
from viflow_anomaly.rig_estimate import RigEstimate, corrected_pair, observe, update
from viflow_anomaly.sensor_data import FramePair
from viflow_anomaly.tracking import Tracker, TrackingState


class BatchOptions(FrozenConfig):
    """Where a batch run writes, which pairs it takes and what it draws.

    ``overlays``: how many pictures, spread evenly over the run, or ``"all"``. ``tracking``: how regions become tracks;
    None: they do not, ``track_id`` stays null. ``rig_estimate``: what the run learns of the IMU and its mounting.
    """

    out_dir: Path
    look_ahead: int = Field(default=1, ge=1, le=4)
    limit: PositiveInt | None = None
    overlays: NonNegativeInt | Literal["all"] = 0
    video: bool = False
    tracking: TrackingConfig | None = TrackingConfig()
    rig_estimate: RigEstimateConfig = RigEstimateConfig()
    resume: bool = False
    overwrite: bool = False


class PairAnalyzer(DetectorIdentity, Protocol):
    """What a batch run needs of ``viflow_anomaly.detector.AnomalyDetector``."""

    def analyze(self, pair: FramePair, *, decode_ms: float = 0.0) -> PairAnalysis: ...


OnProgress = Callable[[int, int, int], None]
"""Called after every pair with: pairs behind us, pairs in all, failures so far."""


def run_batch(
    recording: Recording,
    detector: PairAnalyzer,
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
        recording,
        model=detector.model_info,
        execution=detector.execution,
        detector=detector.config,
        options=options,
        settings=settings or {},
    )
    _prepare(options, run)
    with Journal(options.out_dir / JOURNAL_NAME) as journal:
        _start(options, journal, pairs)
        write_json(options.out_dir / RUN_NAME, {"state": "running", **run})
        job = _Job.of(pairs, count, detector, options, journal)
        reused = sum(not job.rig.lacks(stamps) for stamps in journal.lines)
        failures, state = [], _State(TrackingState(), RigEstimate.prior(options.rig_estimate))
        for index in range(count):
            failure, state = _judge(job, index, state)
            failures += [failure] if failure else []
            if on_progress:
                on_progress(index + 1, count, len(failures))
        journal.publish(options.out_dir / DETECTIONS_NAME, partial(tracked_lines, tracker=job.tracker))
        job.pictures.finish([pairs.stamps(index)[0] for index in range(count)])
        wall_time_s = time.monotonic() - started
        summary = summarise(options.out_dir, journal.lines, failures, reused=reused, wall_time_s=wall_time_s)
        rig = state.rig.report(options.rig_estimate) if job.rig.observations else None
        outcome = {**describe_outcome(summary), "rig_estimate": rig}
        write_json(options.out_dir / RUN_NAME, {"state": "done", **run, **outcome})
    return summary


class _State(NamedTuple):
    """After a pair. ``tracking`` is what pictures show; the journal is tracked as a whole when the run ends."""

    tracking: TrackingState
    rig: RigEstimate


@dataclass(frozen=True)
class _Job:
    """The parts of one run."""

    pairs: RecordingPairs
    detector: PairAnalyzer
    journal: Journal
    rig: RigJournal
    pictures: Pictures
    tracker: Tracker | None
    rig_config: RigEstimateConfig

    @classmethod
    def of(
        cls, pairs: RecordingPairs, count: int, detector: PairAnalyzer, options: BatchOptions, journal: Journal
    ) -> Self:
        rig = RigJournal(options.out_dir / RIG_NAME)
        stamps = map(pairs.stamps, range(count))
        complete = all(one in journal.lines and not rig.lacks(one) for one in stamps)
        pictures = Pictures(options.out_dir, count, overlays=options.overlays, video=options.video, complete=complete)
        tracker = Tracker(options.tracking) if options.tracking else None
        return cls(pairs, detector, journal, rig, pictures, tracker, options.rig_estimate)

    def is_done(self, stamps: Stamps) -> bool:
        return stamps in self.journal.lines and not self.rig.lacks(stamps)


def _judge(job: _Job, index: int, state: _State) -> tuple[PairFailure | None, _State]:
    """Detect, draw and write down one pair, or say why that cannot be done."""
    stamps, journal, pictures = job.pairs.stamps(index), job.journal, job.pictures
    draw = pictures.missing(index, stamps[0])
    known = job.is_done(stamps)
    if known and not draw:
        followed = _followed(job.tracker, state.tracking, journal.text(stamps))[0] if pictures.any else state.tracking
        return None, _State(followed, _learned(job, state.rig, stamps))
    applied = state.rig.applicable(job.rig_config)
    try:
        started = time.perf_counter()
        pair = corrected_pair(job.pairs[index], applied)
        decode_ms = (time.perf_counter() - started) * 1e3
        analysis = job.detector.analyze(pair, decode_ms=decode_ms)
    except ViflowError as err:
        return PairFailure(*stamps, err.code, err.field, err.message), state
    text, tracking = to_json(analysis.detection), state.tracking
    if pictures.any:
        tracking, tracked = _followed(job.tracker, tracking, journal.text(stamps) if known else text)
        if draw:
            pictures.write(index, stamps[0], overlay_of(pair, analysis, tracked))
    if not known:
        if job.rig_config.enabled and analysis.predicted is not None:
            job.rig.append(stamps, observe(pair, analysis.predicted.correction, job.rig_config, applied))
        journal.append(stamps, analysis.detection.status, text)
    return None, _State(tracking, _learned(job, state.rig, stamps))


def _learned(job: _Job, rig: RigEstimate, stamps: Stamps) -> RigEstimate:
    """One step of the rig's estimate, from what is written down."""
    observation = job.rig.observations.get(stamps)
    return rig if observation is None else update(rig, observation, job.rig_config)


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
