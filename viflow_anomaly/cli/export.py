"""``viflow-anomaly export``: a checkpoint for other runtimes."""

from __future__ import annotations

import tempfile
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from viflow_anomaly.cli.options import Assignments, Checkpoint, ConfigFile, settings_from

if TYPE_CHECKING:
    from collections.abc import Sequence

    from viflow_anomaly.runtime.exported import Feed
    from viflow_anomaly.settings import Settings


class Format(StrEnum):
    """As ``runtime.export.ExportFormat``."""

    onnx = "onnx"
    openvino = "openvino"


def export(
    checkpoint: Checkpoint = None,
    evidence_head: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="Export this evidence head instead (--checkpoint: the network that its int8 is calibrated behind).",
            show_default=False,
        ),
    ] = None,
    layout: Annotated[
        Format, typer.Option("--format", help="ONNX, or OpenVINO's .xml with its weights in a .bin.")
    ] = Format.onnx,
    int8: Annotated[
        bool, typer.Option("--int8", help="An evidence head for precision=int8 (needs the extra `int8`).")
    ] = False,
    calibration: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DIR",
            help="Recording whose pairs int8 is calibrated on (default: simulated ones). Repeatable.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where to (default: NAME.onnx, ... beside the checkpoint).")
    ] = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Write a checkpoint's network for OpenVINO and ONNX Runtime, which run it much faster on a CPU than torch does.

    The file works for any view whose sides are multiples of 32. Beside its checkpoint it is found by itself: detect,
    batch and serve use it where OpenVINO or ONNX Runtime is installed (--runtime torch: not). Needs the extra `export`.

    [bold]Examples[/bold]

      viflow-anomaly export --checkpoint runs/first/model.safetensors

      viflow-anomaly export --evidence-head runs/head/evidence.safetensors --format openvino --int8
      --calibration runs/patrol
    """
    if checkpoint is not None and evidence_head is not None and not int8:
        raise typer.BadParameter(
            "--evidence-head exports the head alone, which needs no network but for --int8: expected one of "
            "--checkpoint and --evidence-head, found both"
        )
    if int8 and (evidence_head is None or layout is not Format.openvino):
        raise typer.BadParameter(
            "--int8 is for evidence heads in OpenVINO: expected --evidence-head PATH and --format openvino with it "
            "(elsewhere it costs more than it gains, see docs/runtimes.md)"
        )
    if calibration and not int8:
        raise typer.BadParameter("--calibration is for --int8: expected both, found --calibration alone")
    settings = settings_from(config, assignments, {"checkpoint": checkpoint})
    from viflow_anomaly.runtime.export import export_head, export_network

    if evidence_head is None:
        print(export_network(settings.checkpoint, out, file_format=layout.value))
    else:
        samples = _samples(settings, calibration) if int8 else ()
        print(export_head(evidence_head, out, file_format=layout.value, samples=samples))


def _samples(settings: Settings, calibration: list[Path] | None) -> Sequence[Feed]:
    """Cues of the recordings that were named, or of simulated ones."""
    from viflow_anomaly.cli.options import load_detector
    from viflow_anomaly.errors import MissingDependencyError
    from viflow_anomaly.export_samples import head_samples, simulated_recordings
    from viflow_anomaly.runtime.quantisation import require_nncf

    require_nncf()
    with tempfile.TemporaryDirectory() as folder:
        try:
            recordings = calibration or simulated_recordings(Path(folder))
        except MissingDependencyError as err:
            named = f"{err.message}; or name recordings with --calibration DIR"
            raise MissingDependencyError(named, code=err.code) from err
        without_threshold = settings.model_copy(update={"calibration": None})
        return head_samples(recordings, load_detector(without_threshold, evidence=False), settings.limits)


def register(app: typer.Typer) -> None:
    app.command()(export)
