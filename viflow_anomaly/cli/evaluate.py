"""``viflow-anomaly evaluate``: a model against ground truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from viflow_anomaly.cli.evaluate_flow import flow
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
    from viflow_anomaly.evaluation.flow_report import circumstances

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
        **circumstances(),
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
