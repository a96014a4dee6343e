"""``viflow-anomaly calibrate``: a threshold for a budget of false alarms, from footage without movers."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from viflow_anomaly.cli.options import (
    AsJson,
    Assignments,
    CameraName,
    Checkpoint,
    ConfigFile,
    Device,
    Runtime,
    Threads,
    load_detector,
    settings_from,
)
from viflow_anomaly.cli.progress import stderr_progress

if TYPE_CHECKING:
    from viflow_anomaly.alarm_calibration import AlarmCalibration


MIN_BUDGET_PER_HOUR = 1e-6
"""One in a century."""


def _budget(value: float) -> float:
    if not MIN_BUDGET_PER_HOUR <= value < math.inf:
        raise typer.BadParameter(f"expected a number above 0, at least {MIN_BUDGET_PER_HOUR:g}, found {value:g}")
    return value


def _confidence(value: float) -> float:
    if not 0 < value < 1:
        raise typer.BadParameter(f"expected a number between 0 and 1, found {value:g}")
    return value


def _block(value: float) -> float:
    if not 0.1 <= value < math.inf:
        raise typer.BadParameter(f"expected at least 0.1 s, found {value:g}")
    return value


def calibrate(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Recordings of your rig in which nothing moves by itself.")
    ],
    false_alarms_per_hour: Annotated[
        float, typer.Option(metavar="N", callback=_budget, help="The budget: regions an hour, over all pairs.")
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", dir_okay=False, help="For --calibration of other commands.")],
    confidence: Annotated[
        float, typer.Option(metavar="P", callback=_confidence, help="With which the budget is promised.")
    ] = 0.95,
    block_seconds: Annotated[
        float, typer.Option(metavar="S", callback=_block, help="Alarms within S seconds may depend on each other.")
    ] = 10.0,
    layout: Annotated[
        str | None, typer.Option("--format", metavar="NAME", help="As for `batch`; default by content.")
    ] = None,
    camera: CameraName = None,
    as_json: AsJson = False,
    checkpoint: Checkpoint = None,
    threads: Threads = None,
    device: Device = None,
    runtime: Runtime = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Choose detector.regions.motion_score so that false alarms stay within a budget on footage to come.

    The footage needs no labels, but nothing in it may move by itself: what does counts as a false alarm. Where it is
    too short for a promise, the answer says so. --json prints the file.

    [bold]Examples[/bold]

      viflow-anomaly calibrate runs/empty-hall-1 runs/empty-hall-2 --false-alarms-per-hour 10 --out hall.json

      viflow-anomaly batch runs/patrol --calibration hall.json
    """
    options = {"checkpoint": checkpoint, "threads": threads, "device": device, "runtime": runtime}
    settings = settings_from(config, assignments, options)
    from viflow_anomaly.alarm_calibration import make_calibration, write_calibration
    from viflow_anomaly.alarm_footage import footage_of, watch_recordings
    from viflow_anomaly.datasets.registry import open_recording

    opened = [open_recording(path, format=layout, camera=camera, limits=settings.limits) for path in recordings]
    detector = load_detector(settings.model_copy(update={"calibration": None}))
    with stderr_progress() as progress:
        task = progress.add_task("pairs", total=None)
        watched = watch_recordings(
            opened,
            detector,
            on_progress=lambda done, total: progress.update(task, completed=done, total=total),
        )
    calibration = make_calibration(
        watched,
        footage_of(watched, block_s=block_seconds),
        model=detector.model_info,
        execution=detector.execution,
        detector=detector.config,
        budget_per_hour=false_alarms_per_hour,
        confidence=confidence,
        block_s=block_seconds,
    )
    write_calibration(out, calibration)
    print(calibration.model_dump_json(indent=2) if as_json else "\n".join(_told(calibration, out)))


def _told(calibration: AlarmCalibration, out: Path) -> list[str]:
    """What people need to know of it, most important first."""
    failed = sum(calibration.failed.values())
    budget, sure = f"{calibration.budget_per_hour:g} an hour", f"{100 * calibration.confidence:g} %"
    lines = [
        f"motion_score {calibration.motion_score:.4f} -> {out}",
        f"footage: {_hours(calibration.hours)}, {calibration.pairs} pairs judged, {calibration.abstained} abstained, "
        f"{failed} failed; {calibration.alarms} of {calibration.regions} regions reach the threshold, "
        f"in clumps of {calibration.clump:.1f}",
    ]
    if calibration.promised:
        lines.append(
            f"promised: at most {calibration.bound_per_hour:.3g} false alarms an hour at {sure}, budget {budget}"
        )
    else:
        lines += [
            f"NOT PROMISED: the footage is too short for {budget} at {sure}; this threshold can be promised "
            f"{calibration.bound_per_hour:.3g} an hour, no threshold less than {calibration.lowest_bound_per_hour:.3g}",
            f"the threshold is a point estimate: {calibration.expected_per_hour:.3g} an hour expected"
            + (
                ", and even that is over the budget"
                if calibration.expected_per_hour > calibration.budget_per_hour
                else ""
            ),
            f"needed for the promise: at least {_hours(calibration.hours_needed)} without an alarm",
        ]
    if calibration.motion_score > 1:
        lines.append("no region can reach this threshold: nothing will be labelled independent_motion")
    return lines


def _hours(hours: float) -> str:
    return f"{hours:.3g} h" if hours >= 0.1 else f"{3600 * hours:.3g} s"


def register(app: typer.Typer) -> None:
    app.command(no_args_is_help=True)(calibrate)
