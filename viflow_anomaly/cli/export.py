"""``viflow-anomaly export``: a checkpoint for other runtimes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from viflow_anomaly.cli.options import Assignments, Checkpoint, ConfigFile, settings_from


def export(
    checkpoint: Checkpoint = None,
    evidence_head: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Export this evidence head instead.", show_default=False)
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where to (default: NAME.onnx beside the checkpoint).")
    ] = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Write a checkpoint's network as ONNX, which OpenVINO runs several times faster on a CPU than torch does.

    The file works for any view whose sides are multiples of 32. Beside its checkpoint it is found by itself: detect,
    batch and serve use it where OpenVINO is installed (--set runtime=torch: not). Needs the extra `export`.

    [bold]Example[/bold]

      viflow-anomaly export --checkpoint runs/first/model.safetensors
    """
    settings = settings_from(config, assignments, {"checkpoint": checkpoint})
    from viflow_anomaly.runtime.export import export_evidence_onnx, export_onnx

    print(export_onnx(settings.checkpoint, out) if evidence_head is None else export_evidence_onnx(evidence_head, out))


def register(app: typer.Typer) -> None:
    app.command()(export)
