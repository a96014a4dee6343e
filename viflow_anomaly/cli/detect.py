"""``viflow-anomaly detect``: one image pair."""

from __future__ import annotations

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
    KeyFile,
    Runtime,
    Threads,
    load_detector,
    settings_from,
)

if TYPE_CHECKING:
    from viflow_anomaly.cli.pair_files import PairFiles
    from viflow_anomaly.detection import Detection
    from viflow_anomaly.geometry import Float32Array
    from viflow_anomaly.sensor_data import FramePair
    from viflow_anomaly.settings import Settings


def detect(
    source: Annotated[Path, typer.Argument(help="The earlier image: PNG or JPEG, gray or colour.")],
    target: Annotated[Path, typer.Argument(help="The later image, of the same size.")],
    imu: Annotated[Path, typer.Option(metavar="FILE", help="imu.json (as POST /detect takes it) or imu.csv.")],
    source_timestamp_ns: Annotated[
        int | None, typer.Option(min=0, metavar="NS", help="Stamp of SOURCE; an imu.json may hold it.")
    ] = None,
    target_timestamp_ns: Annotated[
        int | None, typer.Option(min=0, metavar="NS", help="Stamp of TARGET; an imu.json may hold it.")
    ] = None,
    camera: Annotated[Path | None, typer.Option(metavar="FILE", help="camera.json: intrinsics and mounting.")] = None,
    motor_command: Annotated[
        str | None,
        typer.Option(metavar="X,Y,...", help="Speed or displacement, for a model with a motor input."),
    ] = None,
    overlay: Annotated[Path | None, typer.Option(metavar="PNG", help="Also draw the regions into this file.")] = None,
    masks: Annotated[bool | None, typer.Option("--masks", help="Add each region's mask (COCO RLE).")] = None,
    url: Annotated[
        str | None, typer.Option(metavar="URL", help="Ask the service there, instead of computing here.")
    ] = None,
    key_file: KeyFile = None,
    as_json: AsJson = False,
    checkpoint: Checkpoint = None,
    calibration: Calibration = None,
    threads: Threads = None,
    device: Device = None,
    runtime: Runtime = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Find what moves by itself between two images of a moving camera.

    [bold]Examples[/bold]

      viflow-anomaly detect frame0.png frame1.png --imu imu.json --camera camera.json

      viflow-anomaly detect frame0.png frame1.png --imu imu.csv --json --overlay out.png
      --source-timestamp-ns 1403715273262142976 --target-timestamp-ns 1403715273312143104

      viflow-anomaly detect frame0.png frame1.png --imu imu.json --url http://127.0.0.1:8000 --key-file key.txt
    """
    options = {"checkpoint": checkpoint, "calibration": calibration, "threads": threads, "device": device}
    if url is None:
        _refuse_without_url(key_file)
    else:
        _refuse_with_url({**options, "runtime": runtime, "config": config, "set": assignments})
    settings = settings_from(config, assignments, {**options, "runtime": runtime, "detector.include_masks": masks})
    from viflow_anomaly.cli.pair_files import PairFiles, load_pair
    from viflow_anomaly.detection import to_json

    files = PairFiles(source, target, imu, camera, source_timestamp_ns, target_timestamp_ns, _numbers(motor_command))
    pair, decode_ms = load_pair(files, limits=settings.limits)
    if url is None:
        detection = _computed(pair, settings, decode_ms, overlay)
    else:
        detection = _asked(pair, files, settings, url, key_file)
        _draw(overlay, pair, detection)
    print(to_json(detection)) if as_json else _print_table(detection)


def _computed(pair: FramePair, settings: Settings, decode_ms: float, overlay: Path | None) -> Detection:
    from viflow_anomaly.motor_input import require_supported

    detector = load_detector(settings)
    require_supported(pair, detector.motor_source)
    if overlay is None:
        return detector.detect(pair, decode_ms=decode_ms)
    analysis = detector.analyze(pair, decode_ms=decode_ms)
    _draw(overlay, pair, analysis.detection, residual=analysis.residual)
    return analysis.detection


def _asked(pair: FramePair, files: PairFiles, settings: Settings, url: str, key_file: Path | None) -> Detection:
    from viflow_anomaly.client import Client, EncodedPair, read_api_key

    encoded = EncodedPair.of(pair, files=(files.source.read_bytes(), files.target.read_bytes()))
    with Client(url, api_key=None if key_file is None else read_api_key(key_file)) as client:
        return client.detect(encoded, include_masks=settings.detector.include_masks)


def _draw(overlay: Path | None, pair: FramePair, detection: Detection, residual: Float32Array | None = None) -> None:
    if overlay is None:
        return
    from viflow_anomaly.batch_pictures import write_png
    from viflow_anomaly.drawing import draw_overlay

    write_png(overlay, draw_overlay(pair.source.image, detection, residual=residual))


def _refuse_with_url(options: dict[str, Any]) -> None:
    """What sets up a detector here would change nothing there."""
    given = [f"--{name}" for name, value in options.items() if value]
    if given:
        raise typer.BadParameter(
            f"expected none of the options that set up a detector here, found {', '.join(given)}", param_hint="--url"
        )


def _refuse_without_url(key_file: Path | None) -> None:
    if key_file is not None:
        raise typer.BadParameter("expected --url beside it, found none", param_hint="--key-file")


def _numbers(text: str | None) -> tuple[float, ...] | None:
    try:
        return None if text is None else tuple(float(number) for number in text.split(","))
    except ValueError:
        raise typer.BadParameter(
            f"expected numbers separated by commas, found {text!r}", param_hint="--motor-command"
        ) from None


def _print_table(detection: Detection) -> None:
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Column, Table

    console, sha256 = Console(), detection.model.sha256
    console.print(
        f"[bold]{detection.status}[/bold], {len(detection.rois)} regions, model {detection.model.name} ({sha256[:8]})"
    )
    for reason in detection.reasons:
        console.print(f"  {reason.code}: {escape(reason.message)}", highlight=False)
    if not detection.rois:
        return
    table = Table("id", Column("label", no_wrap=True), "score", "x, y", "w x h", "thick px", "residual", box=SIMPLE)
    for roi in detection.rois:
        box = roi.bbox
        place, size = f"{box.x}, {box.y}", f"{box.width} x {box.height}"
        measures = (f"{roi.thickness_px:.1f}", f"{roi.residual_mean:.1f}")
        table.add_row(str(roi.id), roi.label, f"{roi.score:.2f}", place, size, *measures)
    console.print(table)


def register(app: typer.Typer) -> None:
    app.command(no_args_is_help=True)(detect)
