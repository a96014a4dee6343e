"""``viflow-anomaly evaluate flow``: endpoint errors and runtimes of networks and other methods, in one run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from viflow_anomaly.cli.flow_inputs import (
    DEFAULT,
    baselines_of,
    named_checkpoints,
    networks_of,
    numbers_of,
    open_truths,
    require_distinct,
    require_places,
    result_files,
    test_parts,
)
from viflow_anomaly.cli.options import AsJson, Assignments, ConfigFile, Device, Runtime, Threads, settings_from
from viflow_anomaly.cli.progress import stderr_progress
from viflow_anomaly.cli.tables import report_console, rich_table

if TYPE_CHECKING:
    from viflow_anomaly.evaluation.flow_methods import FlowMethod
    from viflow_anomaly.evaluation.flow_run import FlowMeasurement
    from viflow_anomaly.evaluation.flow_truth import FlowTruth


def flow(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Recordings with ground truth, or KITTI scene flow 2015.")
    ],
    checkpoint: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME=]PATH",
            help="Weights to measure, repeatable (default: the bundled model; none: no network).",
            show_default=False,
        ),
    ] = None,
    methods: Annotated[
        str,
        typer.Option(
            metavar="LIST",
            help="Baselines, comma-separated: identity, dis-ultrafast, dis-fast, dis-medium, farneback, and from "
            "opencv-contrib rlof-epic, deepflow, pcaflow, simpleflow, tv-l1. 'default': all that are there; 'none'.",
        ),
    ] = DEFAULT,
    results: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=DIR",
            help="Another method's result files, DIR/<sequence>/<source_timestamp_ns>.flo, .png (KITTI) or .npy. "
            "Repeatable.",
        ),
    ] = None,
    ground_truth: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="The folder that holds groundtruth0, for one recording (default: its own)."),
    ] = None,
    movers: Annotated[
        bool,
        typer.Option(help="Count pixels of moving things, too: the truth there is what a resting thing would show."),
    ] = True,
    look_aheads: Annotated[
        str, typer.Option(metavar="LIST", help="Frames between source and target, comma-separated, 1 to 4.")
    ] = "1",
    max_pairs: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Measure N pairs, evenly spread (default: all).")
    ] = None,
    test_part: Annotated[
        bool,
        typer.Option("--test-part", help="Measure only the pairs that training.split keeps for the test (--set)."),
    ] = False,
    crop: Annotated[
        int | None,
        typer.Option(min=1, metavar="PX", help="Measure the middle PX x PX pixels only (the paper: 224)."),
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, metavar="N", help="Timed runs of each method on each pair.")] = 1,
    as_json: AsJson = False,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write the JSON into this file.")] = None,
    markdown: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the tables in Markdown.")] = None,
    latex: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the tables in LaTeX (booktabs).")] = None,
    plots: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Draw pictures into this folder (PNG and PDF; needs the extra 'plots')."),
    ] = None,
    threads: Threads = None,
    device: Device = None,
    runtime: Runtime = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Measure endpoint error and runtime of networks beside other methods, on the same pairs in one run.

    Each checkpoint gives two rows: the flow as it was predicted (the paper's method), and after the correction on the
    target image (+correction) unless detector.correction.enabled=false. Errors are over all pixels with ground truth,
    in pixels of the source image, by sequence, by group (a sequence's name up to its first underscore) and in total.

    [bold]Examples[/bold]

      viflow-anomaly evaluate flow runs/held-out/*

      viflow-anomaly evaluate flow runs/held-out/* --checkpoint k1=runs/k1/model.safetensors --checkpoint
      k8=runs/k8/model.safetensors --out flow.json --markdown flow.md --latex flow.tex --plots figures

      viflow-anomaly evaluate flow runs/held-out/* --methods identity,dis-medium --results FlowNet2=results/flownet2
    """
    settings = settings_from(config, assignments, {"threads": threads, "device": device, "runtime": runtime})
    import cv2

    from viflow_anomaly.evaluation.flow_report import flow_report
    from viflow_anomaly.evaluation.flow_run import measure_flow_methods

    if plots is not None:
        from viflow_anomaly.evaluation.plot_style import require_matplotlib

        require_matplotlib()
    require_places(out, markdown, latex, plots)
    cv2.setNumThreads(settings.threads)
    named = named_checkpoints(checkpoint, settings)
    whole = open_truths(recordings, numbers_of(look_aheads), ground_truth, movers)
    truths: Sequence[FlowTruth] = test_parts(whole, named, settings) if test_part else whole
    baselines, left_out = baselines_of(methods)
    networks = networks_of(named, settings)
    chosen = [*baselines, *result_files(results or [], truths, max_pairs), *networks]
    require_distinct(chosen)
    with stderr_progress() as progress:
        task = progress.add_task("pairs", total=None)
        measurement = measure_flow_methods(
            chosen,
            truths,
            max_pairs=max_pairs,
            crop_px=crop,
            repeats=repeats,
            on_progress=lambda done, total: progress.update(task, completed=done, total=total),
        )
    options: dict[str, Any] = {"look_aheads": numbers_of(look_aheads), "max_pairs": max_pairs, "crop_px": crop}
    options |= {
        "movers": movers,
        "test_part": settings.training.split.model_dump(mode="json") if test_part else None,
        "repeats": repeats,
        "correction": settings.detector.correction.model_dump(mode="json"),
    }
    report = flow_report(measurement, threads=settings.threads, left_out=left_out, options=options)
    _write(report, out, markdown, latex)
    print(_json(report)) if as_json else _print(report)
    if plots is not None:
        _draw(plots, measurement, chosen, truths, max_pairs, {name: path for name, path in named if path is not None})


def _write(report: dict[str, Any], out: Path | None, markdown: Path | None, latex: Path | None) -> None:
    from viflow_anomaly.checkpoint_record import write_atomically
    from viflow_anomaly.evaluation import flow_tables

    texts = {out: _json(report) + "\n", markdown: flow_tables.markdown(report), latex: flow_tables.latex(report)}
    for path, text in texts.items():
        if path is not None:
            write_atomically(path, text.encode())


def _json(report: dict[str, Any]) -> str:
    return json.dumps(report, indent=2, ensure_ascii=False, allow_nan=False)


def _print(report: dict[str, Any]) -> None:
    from viflow_anomaly.evaluation.flow_tables import notes, paper_table, report_tables

    console = report_console()
    for table in report_tables(report):
        console.print(rich_table(table))
    for line in notes(report):
        console.print(line, markup=False, highlight=False)
    console.print(rich_table(paper_table(report)))


def _draw(
    folder: Path,
    measurement: FlowMeasurement,
    methods: Sequence[FlowMethod],
    truths: Sequence[FlowTruth],
    max_pairs: int | None,
    checkpoints: dict[str | None, Path],
) -> None:
    from viflow_anomaly.evaluation.flow_figures import draw_flow_figures

    logs = {name or path.parent.name: path.with_name("metrics.jsonl") for name, path in checkpoints.items()}
    draw_flow_figures(folder, measurement, methods, truths, max_pairs=max_pairs, training_logs=logs)
