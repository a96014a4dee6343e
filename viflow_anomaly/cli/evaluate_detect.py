"""``viflow-anomaly evaluate detect``: how well regions find what moves by itself, beside classical detectors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from viflow_anomaly.cli.options import (
    AsJson,
    Assignments,
    Calibration,
    Checkpoint,
    ConfigFile,
    Device,
    Runtime,
    Threads,
    load_detector,
    settings_from,
)
from viflow_anomaly.cli.progress import stderr_progress
from viflow_anomaly.cli.tables import report_console, rich_table

if TYPE_CHECKING:
    from viflow_anomaly.evaluation.detection_methods import DetectionMethod


def detect(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            metavar="DIR...",
            help="Simulated recordings with ground truth, or KITTI drives with label_motion_derived.csv, one a folder.",
        ),
    ],
    every: Annotated[int, typer.Option(min=1, metavar="N", help="Take every n-th pair of each.")] = 1,
    rivals: Annotated[bool, typer.Option(help="Measure classical detectors in the same run.")] = True,
    as_json: AsJson = False,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write the JSON into this file.")] = None,
    markdown: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the tables in Markdown.")] = None,
    plots: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Draw charts into this folder (PNG and PDF; needs the extra 'plots')."),
    ] = None,
    checkpoint: Checkpoint = None,
    calibration: Calibration = None,
    threads: Threads = None,
    device: Device = None,
    runtime: Runtime = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Measure how well regions find what moves by itself, beside classical detectors.

    A region finds a mover when their boxes overlap by IoU 0.3. Movers that shift by less than 1 px, or show fewer than
    30 pixels, count neither way; of a KITTI drive only frames with labels are judged, and boxes that are not said to
    move or to rest count neither way. Rivals get the thresholds that are best for them on these very frames.

    [bold]Examples[/bold]

      viflow-anomaly evaluate detect runs/held-out/* --out detect.json --markdown detect.md --plots figures

      viflow-anomaly evaluate detect runs/held-out/* --no-rivals --set detector.correction.enabled=false --json
    """
    options = {"checkpoint": checkpoint, "calibration": calibration, "threads": threads, "device": device}
    settings = settings_from(config, assignments, {**options, "runtime": runtime})
    from viflow_anomaly.evaluation.detection_methods import OURS, DetectorMethod, rival_methods
    from viflow_anomaly.evaluation.detection_quality import measure_detection
    from viflow_anomaly.evaluation.detection_report import detection_report
    from viflow_anomaly.evaluation.labelled_pairs import open_labelled

    if plots is not None:
        from viflow_anomaly.evaluation.plot_style import require_matplotlib

        require_matplotlib()
    sequences = [open_labelled(path) for path in recordings]
    detector = load_detector(settings)
    methods: list[DetectionMethod] = [DetectorMethod(OURS, detector), *(rival_methods(detector) if rivals else ())]
    with stderr_progress() as progress:
        task = progress.add_task("pairs", total=None)
        measurement = measure_detection(
            methods,
            sequences,
            every=every,
            on_progress=lambda done, total: progress.update(task, completed=done, total=total),
        )
    report = detection_report(
        measurement, detector.model_info, detector.config.model_dump(mode="json"), options={"every": every}
    )
    _write(report, out, markdown, plots)
    print(_json(report)) if as_json else _print(report)


def _write(report: dict[str, Any], out: Path | None, markdown: Path | None, plots: Path | None) -> None:
    from viflow_anomaly.checkpoint_record import write_atomically
    from viflow_anomaly.evaluation import detection_tables

    for path, text in ((out, _json(report) + "\n"), (markdown, detection_tables.markdown(report))):
        if path is not None:
            write_atomically(path, text.encode())
    if plots is not None:
        from viflow_anomaly.evaluation.detection_plots import draw_detection_figures

        draw_detection_figures(plots, report)


def _json(report: dict[str, Any]) -> str:
    return json.dumps(report, indent=2, ensure_ascii=False, allow_nan=False)


def _print(report: dict[str, Any]) -> None:
    from viflow_anomaly.evaluation.detection_tables import class_tables, notes, report_tables

    console = report_console()
    for table in (*report_tables(report), *class_tables(report)):
        console.print(rich_table(table))
    for line in notes(report):
        console.print(line, markup=False, highlight=False)
