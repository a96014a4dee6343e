"""``viflow-anomaly batch``: a whole recording."""

from __future__ import annotations

import json
import os
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from viflow_anomaly.cli.options import (
    EXIT_SOME_FAILED,
    AsJson,
    Assignments,
    Calibration,
    CameraName,
    Checkpoint,
    ConfigFile,
    Device,
    RecordingFolder,
    Runtime,
    Threads,
    load_detector,
    settings_from,
)
from viflow_anomaly.cli.progress import stderr_progress

if TYPE_CHECKING:
    from viflow_anomaly.batch_job import BatchOptions
    from viflow_anomaly.batch_pairs import PairAnalyzer
    from viflow_anomaly.batch_record import BatchSummary
    from viflow_anomaly.batch_workers import Helpers
    from viflow_anomaly.datasets.recording import Recording
    from viflow_anomaly.settings import Settings

MAX_DEFAULT_JOBS = 8
"""More processes than that only by ``--jobs``: each takes some 300 MB."""


def _how_many(text: str) -> str:
    if text != "all" and not text.isdecimal():
        raise typer.BadParameter(f"expected a number or 'all', found {text!r}")
    return text


def batch(
    directory: RecordingFolder,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Default: DIR-detections", show_default=False)] = None,
    layout: Annotated[
        str | None,
        typer.Option(
            "--format",
            metavar="NAME",
            help="euroc, kitti_raw, kitti_odometry, kitti_odometry_raw or plain; default by content.",
        ),
    ] = None,
    camera: CameraName = None,
    look_ahead: Annotated[int, typer.Option(min=1, max=4, help="Frames from source to target.")] = 1,
    limit: Annotated[int | None, typer.Option(min=1, metavar="N", help="Only the first N pairs.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Do only what an earlier run left out.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the results of an earlier run.")] = False,
    overlays: Annotated[
        str, typer.Option(metavar="N|all", callback=_how_many, help="Pictures to draw, spread over the run.")
    ] = "0",
    track: Annotated[bool, typer.Option("--track/--no-track", help="Number what moves, from pair to pair.")] = True,
    video: Annotated[bool, typer.Option("--video", help="Also write overlay.mp4.")] = False,
    masks: Annotated[bool | None, typer.Option("--masks", help="Add each region's mask (COCO RLE).")] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            min=1, max=256, metavar="N", help="Pairs judged at a time, a process each; default: one for each core."
        ),
    ] = None,
    as_json: AsJson = False,
    checkpoint: Checkpoint = None,
    calibration: Calibration = None,
    threads: Threads = None,
    device: Device = None,
    runtime: Runtime = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> int:
    """Judge every frame pair of a recording: detections.jsonl (a ROI JSON object a line), run.json, pictures.

    Exit code 3 when some pairs failed: run.json names them, the others are done. --json prints run.json. The results do
    not depend on --jobs.

    [bold]Examples[/bold]

      viflow-anomaly batch V1_01_easy/mav0 --overlays 20 --video

      viflow-anomaly batch 2011_09_26/2011_09_26_drive_0005_sync --out runs/kitti-0005 --camera image_02

      viflow-anomaly batch V1_01_easy/mav0 --resume
    """
    if resume and overwrite:
        raise typer.BadParameter("--resume keeps what --overwrite would replace; give one of them")
    options = {"checkpoint": checkpoint, "calibration": calibration, "threads": threads, "device": device}
    settings = settings_from(config, assignments, {**options, "runtime": runtime, "detector.include_masks": masks})
    from viflow_anomaly.batch_job import BatchOptions
    from viflow_anomaly.datasets.registry import open_recording

    recording = open_recording(directory, format=layout, camera=camera, limits=settings.limits)
    batch_options = BatchOptions(
        out_dir=out or default_out_dir(directory),
        look_ahead=look_ahead,
        limit=limit,
        overlays="all" if overlays == "all" else int(overlays),
        video=video,
        tracking=settings.tracking if track else None,
        rig_estimate=settings.rig_estimate,
        resume=resume,
        overwrite=overwrite,
    )
    _require_successive_frames(settings.calibration, look_ahead)
    detector = load_detector(settings)
    recorded = settings.model_dump(mode="json", include={"checkpoint", "device", "threads", "limits"})
    recorded["calibration"] = _recorded_calibration(settings.calibration)
    summary = _run(recording, detector, batch_options, recorded, _helpers(jobs, settings))
    _report(summary, as_json=as_json)
    return EXIT_SOME_FAILED if summary.failures else 0


def _helpers(jobs: int | None, settings: Settings) -> Helpers:
    """The processes beside this one."""
    from viflow_anomaly.batch_workers import Helpers

    return Helpers((jobs or default_jobs(settings)) - 1, partial(load_detector, settings))


def default_jobs(settings: Settings) -> int:
    """One for each core that this process may use and that no thread of another job takes; on a GPU one in all."""
    if settings.device != "cpu":
        return 1
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores // settings.threads, MAX_DEFAULT_JOBS))


def _require_successive_frames(calibration: Path | None, look_ahead: int) -> None:
    """Pairs further apart have other scores than those that a calibration is made of.

    Raises:
        ConfigError: ``calibration_stale``.
    """
    if calibration is not None and look_ahead != 1:
        from viflow_anomaly.alarm_calibration import stale

        raise stale(calibration, "pairs of successive frames (look-ahead 1)", f"look-ahead {look_ahead}")


def _recorded_calibration(path: Path | None) -> dict[str, Any] | None:
    """For ``run.json``: the whole file, and where it lay."""
    if path is None:
        return None
    from viflow_anomaly.alarm_calibration import read_calibration

    return {"path": str(path), **read_calibration(path).model_dump(mode="json")}


def default_out_dir(directory: Path) -> Path:
    """``DIR-detections`` beside DIR, also where DIR is ``.`` or ends in ``..``."""
    whole = directory.resolve() if directory.name in ("", "..") else directory
    return whole.with_name(f"{whole.name}-detections")


def _run(
    recording: Recording, detector: PairAnalyzer, options: BatchOptions, recorded: dict[str, Any], helpers: Helpers
) -> BatchSummary:
    from viflow_anomaly.batch_job import run_batch

    with stderr_progress() as progress:
        task = progress.add_task("pairs", total=None)

        def show(done: int, total: int, failed: int) -> None:
            description = f"pairs ({failed} failed)" if failed else "pairs"
            progress.update(task, completed=done, total=total, description=description)

        try:
            return run_batch(recording, detector, options, on_progress=show, settings=recorded, helpers=helpers)
        except KeyboardInterrupt:
            print(f"interrupted: {_kept(options)}", file=sys.stderr)
            raise
        except OSError as err:
            if not (options.out_dir / "run.json").is_file():
                raise
            raise OSError(err.errno, f"{err.strerror}; {_kept(options)}", err.filename) from err


def _kept(options: BatchOptions) -> str:
    return f"what is done is kept in {options.out_dir}; go on with --resume"


def _report(summary: BatchSummary, *, as_json: bool) -> None:
    if as_json:
        print(json.dumps(json.loads((summary.out_dir / "run.json").read_bytes())))
        return
    print(
        f"{summary.pairs} pairs in {summary.wall_time_s:.1f} s: {summary.ok} ok, {summary.abstained} abstained, "
        f"{summary.failed} failed -> {summary.out_dir}"
    )
    for failure in summary.failures[:5]:
        print(f"failed: {failure.source_timestamp_ns}: {failure.message} [{failure.code}]", file=sys.stderr)
    if summary.failed > 5:
        print(f"failed: and {summary.failed - 5} more, see {summary.out_dir / 'run.json'}", file=sys.stderr)


def register(app: typer.Typer) -> None:
    app.command(no_args_is_help=True)(batch)
