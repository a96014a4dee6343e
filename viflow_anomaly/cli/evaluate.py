"""``viflow-anomaly evaluate``: a model against ground truth."""

from __future__ import annotations

import json
import math
import os
import platform
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from viflow_anomaly.cli.options import (
    AsJson,
    Assignments,
    Checkpoint,
    ConfigFile,
    Device,
    Threads,
    settings_from,
)
from viflow_anomaly.cli.progress import stderr_progress

if TYPE_CHECKING:
    from viflow_anomaly.checkpoint_record import CheckpointRecord
    from viflow_anomaly.evaluation.endpoint_error import EndpointErrors


def flow(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Simulated recordings with ground truth, one a folder.")
    ],
    as_json: AsJson = False,
    max_pairs: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Measure N pairs, evenly spread (default: all).")
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write the JSON into this file.")] = None,
    checkpoint: Checkpoint = None,
    threads: Threads = None,
    device: Device = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Measure the endpoint error of the predicted flow, beside that of predicting no motion at all.

    Errors are means over pairs, in pixels of the source image, on the static world: after the correction on the target
    image, as the detector uses it, and as the network predicted it. A sequence belongs to the group
    that its name gives up to the first underscore (`drone_000007`: drone).

    [bold]Examples[/bold]

      viflow-anomaly evaluate flow runs/held-out/*

      viflow-anomaly evaluate flow runs/held-out/* --checkpoint runs/first/model.safetensors --json --out flow.json
    """
    options = {"checkpoint": checkpoint, "threads": threads, "device": device}
    settings = settings_from(config, assignments, options)
    import cv2

    from viflow_anomaly.checkpoint_record import write_atomically
    from viflow_anomaly.evaluation.endpoint_error import measure_endpoint_errors, require_ground_truth
    from viflow_anomaly.runtime.loading import load_runtime

    cv2.setNumThreads(settings.threads)
    runtime, record = load_runtime(
        settings.checkpoint, runtime=settings.runtime, device=settings.device, threads=settings.threads
    )
    require_ground_truth(recordings)
    with stderr_progress() as progress:
        task = progress.add_task("pairs", total=None)
        errors = measure_endpoint_errors(
            runtime,
            record.model,
            recordings,
            correction=settings.detector.correction,
            max_pairs=max_pairs,
            on_progress=lambda done, total: progress.update(task, completed=done, total=total),
        )
    text = json.dumps(_report(errors, record), indent=2, ensure_ascii=False, allow_nan=False)
    if out is not None:
        write_atomically(out, (text + "\n").encode())
    print(text) if as_json else _print_table(errors, record)


SHOWN = ("epe_px", "predicted_epe_px", "identity_epe_px", "epe_ratio", "predicted_epe_ratio")


def _report(errors: EndpointErrors, record: CheckpointRecord) -> dict[str, Any]:
    return {
        "model": {"name": record.name, "version": record.version, "sha256": record.sha256},
        **_circumstances(),
        "all": _measures(errors),
        "groups": {name: _measures(group) for name, group in errors.per_group().items()},
        "sequences": {name: _measures(sequence) for name, sequence in errors.per_sequence().items()},
    }


def _circumstances() -> dict[str, Any]:
    from viflow_anomaly.checkpoint_record import source_commit

    return {
        "commit": source_commit(),
        "machine": {"cpu": _cpu_model(), "cores": os.cpu_count()},
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _measures(errors: EndpointErrors) -> dict[str, float | int | None]:
    """The summary with the number of pairs; a ratio to an identity error of 0 is null."""
    summary = {name: None if math.isnan(value) else value for name, value in errors.summary().items()}
    return {**summary, "pairs": len(errors.pairs)}


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()


def _print_table(errors: EndpointErrors, record: CheckpointRecord) -> None:
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Column, Table

    columns = [
        Column(name, justify="right")
        for name in ("pairs", "EPE px", "predicted px", "identity px", "ratio", "predicted")
    ]
    table = Table(Column("sequence", no_wrap=True), *columns, box=SIMPLE)
    parts = [errors.per_sequence(), errors.per_group(), {"all": errors}]
    for part in parts:
        for name, some in part.items():
            measures = some.summary()
            numbers = (f"{measures[key]:.3f}" for key in SHOWN)
            table.add_row(escape(name), str(len(some.pairs)), *numbers)
        table.add_section()
    console = Console()
    console.print(f"model {escape(record.name)} {escape(record.version)} ({record.sha256[:8]})", highlight=False)
    console.print(table)


DETECTION_COLUMNS = {
    "roi_ap": "ROI AP",
    "best_f1": "F1",
    "recall_at_0.1_false_alarms": "recall @0.1",
    "recall_at_0.01_false_alarms": "@0.01",
    "false_alarms_per_frame": "alarms",
    "pixel_ap": "pixel AP",
}


def detect(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Simulated recordings with ground truth, one a folder.")
    ],
    as_json: AsJson = False,
    every: Annotated[int, typer.Option(min=1, metavar="N", help="Take every n-th pair.")] = 1,
    rivals: Annotated[bool, typer.Option(help="Measure classical detectors in the same run.")] = True,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write the JSON into this file.")] = None,
    checkpoint: Checkpoint = None,
    threads: Threads = None,
    device: Device = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Measure how well regions find what moves by itself, beside classical detectors.

    A region finds a mover when their boxes overlap by IoU 0.3. Movers that shift by less than 1 px, or show fewer than
    30 pixels, count neither way. Rivals get the thresholds that are best for them on these very frames.

    [bold]Examples[/bold]

      viflow-anomaly evaluate detect runs/held-out/*

      viflow-anomaly evaluate detect runs/held-out/* --no-rivals --set detector.correction.enabled=false --json
    """
    settings = settings_from(config, assignments, {"checkpoint": checkpoint, "threads": threads, "device": device})
    from viflow_anomaly.checkpoint_record import write_atomically
    from viflow_anomaly.cli.options import load_detector
    from viflow_anomaly.evaluation.detection_quality import measure_detection

    detector = load_detector(settings)
    with stderr_progress() as progress:
        task = progress.add_task("recordings", total=None)
        table = measure_detection(
            detector,
            recordings,
            every=every,
            rivals=rivals,
            on_progress=lambda done, total: progress.update(task, completed=done, total=total),
        )
    info = detector.model_info
    report = {
        "model": {"name": info.name, "version": info.version, "sha256": info.sha256},
        **_circumstances(),
        "detector": detector.config.model_dump(mode="json"),
        "groups": table,
    }
    text = json.dumps(report, indent=2, ensure_ascii=False, allow_nan=False)
    if out is not None:
        write_atomically(out, (text + "\n").encode())
    print(text) if as_json else _print_detection(table)


def _print_detection(table: dict[str, dict[str, dict[str, Any]]]) -> None:
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Column, Table

    for group, methods in table.items():
        columns = [Column(name, justify="right") for name in DETECTION_COLUMNS.values()]
        first = next(iter(methods.values()))
        title = f"{group}: {first['movers']} movers in {first['frames']} frames"
        shown = Table(Column("method", no_wrap=True), *columns, box=SIMPLE, title=escape(title))
        for method, figures in methods.items():
            values = (figures[name] for name in DETECTION_COLUMNS)
            shown.add_row(method, *("-" if value is None else f"{value:.3f}" for value in values))
        Console().print(shown)


def register(app: typer.Typer) -> None:
    evaluate = typer.Typer(
        name="evaluate",
        no_args_is_help=True,
        help="""Measure a model against ground truth.

    [bold]Examples[/bold]

      viflow-anomaly evaluate flow runs/held-out/*

      viflow-anomaly evaluate detect runs/held-out/*
    """,
    )
    evaluate.command(no_args_is_help=True)(flow)
    evaluate.command(no_args_is_help=True)(detect)
    app.add_typer(evaluate)
