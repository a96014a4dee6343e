"""``viflow-anomaly evaluate flow``: endpoint errors and runtimes of networks and other methods, in one run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from viflow_anomaly.cli.options import AsJson, Assignments, ConfigFile, Device, Threads, settings_from
from viflow_anomaly.cli.progress import stderr_progress
from viflow_anomaly.cli.tables import rich_table

if TYPE_CHECKING:
    from viflow_anomaly.evaluation.flow_methods import FlowMethod, NetworkMethod
    from viflow_anomaly.evaluation.flow_run import FlowMeasurement
    from viflow_anomaly.evaluation.flow_truth import FlowTruth, RecordingTruth
    from viflow_anomaly.evaluation.sceneflow_truth import SceneFlowTruth
    from viflow_anomaly.settings import Settings

DEFAULT, NONE = "default", "none"


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
    settings = settings_from(config, assignments, {"threads": threads, "device": device})
    import cv2

    from viflow_anomaly.evaluation.flow_report import flow_report
    from viflow_anomaly.evaluation.flow_run import measure_flow_methods

    if plots is not None:
        from viflow_anomaly.evaluation.plot_style import require_matplotlib

        require_matplotlib()
    _require_places(out, markdown, latex, plots)
    cv2.setNumThreads(settings.threads)
    named = _checkpoints(checkpoint, settings)
    whole = _truths(recordings, _numbers(look_aheads), ground_truth, movers)
    truths: Sequence[FlowTruth] = _test_parts(whole, named, settings) if test_part else whole
    baselines, left_out = _baselines(methods)
    networks = _networks(named, settings)
    chosen = [*baselines, *_result_files(results or [], truths, max_pairs), *networks]
    _require_distinct(chosen)
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
    options: dict[str, Any] = {"look_aheads": _numbers(look_aheads), "max_pairs": max_pairs, "crop_px": crop}
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


def _require_places(*places: Path | None) -> None:
    """Find out before the measurement that a result could not be written, or would be written over another."""
    from viflow_anomaly.errors import ConfigError

    *files, plots = places
    given = [path.resolve() for path in places if path is not None]
    for path in [path for path in files if path is not None and path.is_dir()]:
        raise ConfigError(f"{path}: expected the name of a file to write, found a directory", code="output_unusable")
    if plots is not None and plots.exists() and not plots.is_dir():
        raise ConfigError(f"{plots}: expected a directory for pictures, found a file", code="output_unusable")
    if len(set(given)) < len(given):
        raise ConfigError(f"expected places of their own for each result, found {given}", code="output_unusable")


def _numbers(text: str) -> list[int]:
    """Raises: InvalidInputError: ``look_ahead_out_of_range``."""
    from viflow_anomaly.datasets.pairing import pair_indices
    from viflow_anomaly.errors import InvalidInputError

    try:
        numbers = sorted({int(part) for part in text.split(",")})
    except ValueError as err:
        raise InvalidInputError(
            f"look_aheads: expected numbers between 1 and 4, comma-separated, found {text!r}",
            code="look_ahead_out_of_range",
            field="look_aheads",
        ) from err
    pair_indices(0, numbers)
    return numbers


def _checkpoints(texts: Sequence[str] | None, settings: Settings) -> list[tuple[str | None, Path | None]]:
    """(name, path) of each; no path is the bundled model."""
    if texts is None:
        return [(None, settings.checkpoint)]
    if list(texts) == [NONE]:
        return []
    pairs = [_named(text) for text in texts]
    return [(name, Path(path)) for name, path in pairs]


def _named(text: str) -> tuple[str | None, str]:
    """NAME=VALUE, or VALUE alone; a path may hold an equals sign behind a slash."""
    name, equals, value = text.partition("=")
    return (name, value) if equals and name and "/" not in name else (None, text)


def _truths(
    recordings: Sequence[Path], look_aheads: Sequence[int], ground_truth: Path | None, movers: bool
) -> Sequence[RecordingTruth | SceneFlowTruth]:
    from viflow_anomaly.errors import ConfigError
    from viflow_anomaly.evaluation.flow_truth import RecordingTruth
    from viflow_anomaly.evaluation.sceneflow_truth import is_scene_flow, open_scene_flow

    if ground_truth is not None and len(recordings) != 1:
        raise ConfigError(
            f"--ground-truth: expected one recording with it, found {len(recordings)}",
            code="ground_truth_ambiguous",
            field="ground_truth",
        )
    truths: list[RecordingTruth | SceneFlowTruth] = []
    for path in recordings:
        if is_scene_flow(path):
            if ground_truth is not None or tuple(look_aheads) != (1,):
                raise ConfigError(
                    f"{path}: expected neither --ground-truth nor --look-aheads with KITTI scene flow, whose pairs and "
                    f"flow are its own, found {ground_truth or list(look_aheads)}",
                    code="scene_flow_options",
                    field="look_aheads" if ground_truth is None else "ground_truth",
                )
            truths += open_scene_flow(path, movers=movers)
        else:
            truths.append(RecordingTruth(path, look_aheads, ground_truth=ground_truth, movers=movers))
    names = [truth.sequence for truth in truths]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigError(
            f"recordings: expected folders of different names, by which they are told apart, found {twice[0]!r} twice",
            code="sequence_names",
            field="recordings",
        )
    return truths


def _test_parts(
    truths: Sequence[RecordingTruth | SceneFlowTruth],
    named: Sequence[tuple[str | None, Path | None]],
    settings: Settings,
) -> Sequence[FlowTruth]:
    """What the split keeps for the test; every checkpoint must have been trained with that very split."""
    from viflow_anomaly.checkpoint_record import bundled_checkpoint, read_checkpoint
    from viflow_anomaly.errors import ConfigError
    from viflow_anomaly.evaluation.flow_truth import RecordingTruth, TestPart

    split = settings.training.split
    if split.rule == "none":
        raise ConfigError(
            "--test-part: expected the split that the training had (--set training.split.rule=blocks), found none",
            code="split_rule_unknown",
            field="training.split.rule",
        )
    if not all(isinstance(truth, RecordingTruth) for truth in truths):
        raise ConfigError(
            "--test-part: expected recordings, found KITTI scene flow, which is a test of its own",
            code="scene_flow_options",
            field="training.split",
        )
    for _, path in named:
        checkpoint = path or bundled_checkpoint()
        trained = read_checkpoint(checkpoint)[1].provenance.get("training", {}).get("split")
        if trained != split.model_dump(mode="json"):
            raise ConfigError(
                f"--test-part: expected the split that {checkpoint} was trained with, {trained}, "
                f"found {split.model_dump(mode='json')}",
                code="split_differs",
                field="training.split",
            )
    return [TestPart(truth, split) if isinstance(truth, RecordingTruth) else truth for truth in truths]


def _baselines(text: str) -> tuple[list[FlowMethod], list[str]]:
    from viflow_anomaly.evaluation.flow_baselines import choose_baselines

    if text == NONE:
        return [], []
    chosen = choose_baselines(None if text == DEFAULT else [part.strip() for part in text.split(",")])
    return list(chosen.methods), chosen.left_out


def _result_files(texts: Sequence[str], truths: Sequence[FlowTruth], max_pairs: int | None) -> list[FlowMethod]:
    from viflow_anomaly.errors import ConfigError
    from viflow_anomaly.evaluation.flow_results import ResultFiles
    from viflow_anomaly.evaluation.flow_truth import spread

    names = [truth.name(index) for truth, index in spread(truths, max_pairs)]
    methods: list[FlowMethod] = []
    for text in texts:
        name, folder = _named(text)
        if name is None:
            raise ConfigError(f"--results: expected NAME=DIR, found {text!r}", code="results_unnamed", field="results")
        methods.append(ResultFiles(name, Path(folder), names))
    return methods


def _networks(named: Sequence[tuple[str | None, Path | None]], settings: Settings) -> list[NetworkMethod]:
    from viflow_anomaly.evaluation.flow_methods import network_methods
    from viflow_anomaly.runtime.loading import load_runtime

    methods = []
    for name, path in named:
        runtime, record = load_runtime(path, runtime=settings.runtime, device=settings.device, threads=settings.threads)
        methods += network_methods(name or record.name, runtime, record, settings.detector.correction)
    return methods


def _require_distinct(methods: Sequence[FlowMethod]) -> None:
    from viflow_anomaly.errors import ConfigError

    names = [method.about.name for method in methods]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice or not names:
        found = f"{twice[0]!r} twice" if twice else "none"
        raise ConfigError(
            f"methods: expected something to measure under names that differ (--checkpoint NAME=PATH), found {found}",
            code="method_names",
            field="checkpoint",
        )


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
    from rich.console import Console

    from viflow_anomaly.evaluation.flow_tables import notes, paper_table, report_tables

    console = Console()
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
