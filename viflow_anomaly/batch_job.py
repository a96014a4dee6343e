"""A recording -> ``detections.jsonl``, ``run.json`` and pictures; the main job of the command line.

A few pairs are in memory at a time. A pair that cannot be judged because its own data is broken is listed in
``run.json`` and the others go on. A killed run resumes where it stopped and ends with the same detections as an
uninterrupted one (``timings_ms`` apart), and so does a run with helpers: pairs are judged side by side, but written
down, tracked and learnt from in order.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

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
from viflow_anomaly.batch_pairs import JudgedPair, PairAnalyzer, PairAnswer, PairJudge, PairTask
from viflow_anomaly.batch_pictures import Pictures
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
from viflow_anomaly.batch_workers import Helpers, answers_in_order
from viflow_anomaly.config import FrozenConfig, RigEstimateConfig, TrackingConfig
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.detection import Detection
from viflow_anomaly.detection_reading import detection_from_json
from viflow_anomaly.drawing import draw_overlay
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.rig_estimate import RigEstimate, TurnObservation, update
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


OnProgress = Callable[[int, int, int], None]
"""Called after every pair with: pairs behind us, pairs in all, failures so far."""


def run_batch(
    recording: Recording,
    detector: PairAnalyzer,
    options: BatchOptions,
    *,
    settings: Mapping[str, Any] | None = None,
    on_progress: OnProgress | None = None,
    helpers: Helpers | None = None,
) -> BatchSummary:
    """Judge every pair of ``recording`` and write the results to ``options.out_dir``.

    Args:
        recording: what to judge.
        detector: with what; its own configuration is recorded in ``run.json``.
        options: where to, which pairs, which pictures.
        settings: other settings of the caller, recorded beside the detector's.
        on_progress: told after every pair.
        helpers: other processes that judge pairs, too; None, or where ``rig_estimate.apply`` makes each pair depend on
            the ones before: this process alone.

    Raises:
        ViflowError: ``batch_helper_died``.
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
        failures: list[PairFailure] = []
        with closing(_answered(job, count, helpers)) as answered:
            for index, failure in enumerate(answered, start=1):
                failures += [failure] if failure else []
                if on_progress:
                    on_progress(index, count, len(failures))
        journal.publish(options.out_dir / DETECTIONS_NAME, partial(tracked_lines, tracker=job.tracker))
        job.pictures.finish([pairs.stamps(index)[0] for index in range(count)])
        wall_time_s = time.monotonic() - started
        summary = summarise(options.out_dir, journal.lines, failures, reused=reused, wall_time_s=wall_time_s)
        rig = job.state.rig.report(options.rig_estimate) if len(job.rig) else None
        outcome = {**describe_outcome(summary), "rig_estimate": rig}
        write_json(options.out_dir / RUN_NAME, {"state": "done", **run, **outcome})
        journal.remove()
    return summary


class _State(NamedTuple):
    """After a pair. ``tracking`` is what pictures show; the journal is tracked as a whole when the run ends."""

    tracking: TrackingState
    rig: RigEstimate


@dataclass
class _Job:
    """The parts of one run, and where it stands."""

    pairs: RecordingPairs
    judge: PairJudge
    journal: Journal
    rig: RigJournal
    pictures: Pictures
    tracker: Tracker | None
    rig_config: RigEstimateConfig
    state: _State

    @classmethod
    def of(
        cls, pairs: RecordingPairs, count: int, detector: PairAnalyzer, options: BatchOptions, journal: Journal
    ) -> Self:
        rig = RigJournal(options.out_dir / RIG_NAME)
        stamps = map(pairs.stamps, range(count))
        complete = all(one in journal.lines and not rig.lacks(one) for one in stamps)
        pictures = Pictures(options.out_dir, count, overlays=options.overlays, video=options.video, complete=complete)
        tracker = Tracker(options.tracking) if options.tracking else None
        judge = PairJudge(pairs, detector, options.rig_estimate)
        state = _State(TrackingState(), RigEstimate.prior(options.rig_estimate))
        return cls(pairs, judge, journal, rig, pictures, tracker, options.rig_estimate, state)

    def is_known(self, stamps: Stamps) -> bool:
        return stamps in self.journal.lines and not self.rig.lacks(stamps)

    def wants(self, index: int) -> bool:
        """Whether the pair must be judged: nobody did, or its picture is missing."""
        stamps = self.pairs.stamps(index)
        return not self.is_known(stamps) or self.pictures.missing(index, stamps[0])


def _answered(job: _Job, count: int, helpers: Helpers | None) -> Generator[PairFailure | None, None, None]:
    """One pair after the other: judged where that is needed, taken over from an earlier run where not."""
    wanted = [index for index in range(count) if job.wants(index)]
    # A task is made when somebody takes it: alone, that is after the pair before it.
    tasks = (
        PairTask(
            index, job.pictures.missing(index, job.pairs.stamps(index)[0]), job.state.rig.applicable(job.rig_config)
        )
        for index in wanted
    )
    alone = helpers is None or (job.rig_config.enabled and job.rig_config.apply)
    with closing(answers_in_order(tasks, len(wanted), job.judge, None if alone else helpers)) as answers:
        pending = iter(wanted)
        following = next(pending, None)
        for index in range(count):
            if index == following:
                yield _take(job, index, next(answers))
                following = next(pending, None)
            else:
                _follow(job, job.pairs.stamps(index))
                yield None


def _take(job: _Job, index: int, answer: PairAnswer) -> PairFailure | None:
    """Draw and write down what was made of a pair."""
    if isinstance(answer, PairFailure):
        return answer
    stamps = job.pairs.stamps(index)
    known = job.is_known(stamps)
    tracking = job.state.tracking
    if job.pictures.any:
        tracking, tracked = _followed(job.tracker, tracking, job.journal.text(stamps) if known else answer.text)
        if answer.parts is not None:
            job.pictures.write(
                index, stamps[0], draw_overlay(answer.parts.source, tracked, residual=answer.parts.residual)
            )
    if known:
        observation = job.rig.observation(stamps)
    else:
        observation = answer.observation
        _write_down(job, stamps, answer)
    job.state = _State(tracking, _learned(job, observation))
    return None


def _write_down(job: _Job, stamps: Stamps, judged: JudgedPair) -> None:
    if judged.knows_turn:
        job.rig.append(stamps, judged.observation)
    job.journal.append(stamps, judged.status, judged.text)


def _follow(job: _Job, stamps: Stamps) -> None:
    """Past a pair that an earlier run judged, and drew where it should."""
    tracking = job.state.tracking
    if job.pictures.any:
        tracking, _ = _followed(job.tracker, tracking, job.journal.text(stamps))
    job.state = _State(tracking, _learned(job, job.rig.observation(stamps)))


def _learned(job: _Job, observation: TurnObservation | None) -> RigEstimate:
    """One step of the rig's estimate, from what is written down."""
    rig = job.state.rig
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
