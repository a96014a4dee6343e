"""``viflow-anomaly train``: unsupervised training on recordings."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from viflow_anomaly.cli.options import (
    BUNDLED,
    Assignments,
    ConfigFile,
    Device,
    Resume,
    Seed,
    Steps,
    TrainingThreads,
    in_section,
    settings_from,
    told,
)
from viflow_anomaly.config import FINE_TUNING_DEFAULTS


def train(
    data: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Recordings to train on, any known layout.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where checkpoints, logs and the final weights go.")],
    init: Annotated[
        Path | None,
        typer.Option(
            metavar="default|PATH",
            help="Start from a checkpoint's weights (default: the bundled model's) and take its model settings. Unless "
            f"they are set, {told(FINE_TUNING_DEFAULTS)}.",
        ),
    ] = None,
    validation: Annotated[
        list[Path] | None, typer.Option(metavar="DIR", help="A recording to measure on, never to train on. Repeatable.")
    ] = None,
    steps: Steps = None,
    batch_size: Annotated[int | None, typer.Option(min=1, help="Frame pairs in a step.")] = None,
    seed: Seed = None,
    resume: Resume = False,
    threads: TrainingThreads = None,
    device: Device = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Train a model on recordings without labels: the reconstruction of the source image is the teacher.

    Settings are in the sections `model` and `training` (see `viflow-anomaly config`).

    [bold]Examples[/bold]

      viflow-anomaly train runs/sim/drone_* --validation runs/held-out/drone_900000 --out runs/first --steps 20000

      viflow-anomaly train runs/sim/drone_* --out runs/first --resume

      viflow-anomaly train recordings/monday --init default --out runs/adapted

      viflow-anomaly train V1_01_easy/mav0 --out runs/paper --set model.preset=paper --set model.view.mode=center_crop
    """
    options = {
        "training.steps": steps,
        "training.batch_size": batch_size,
        "training.seed": seed,
        "training.threads": threads,
        "device": device,
    }
    fine_tuning = None if init is None else in_section("training", FINE_TUNING_DEFAULTS)
    settings = settings_from(config, assignments, options, defaults=fine_tuning)
    from viflow_anomaly.checkpoint_record import bundled_checkpoint
    from viflow_anomaly.training import train as train_model

    checkpoint = train_model(
        data,
        out,
        model=settings.model,
        training=settings.training,
        init=bundled_checkpoint() if init == BUNDLED else init,
        validation=validation or [],
        device=settings.device,
        resume=resume,
        progress=sys.stderr.isatty(),
    )
    print(checkpoint)


def register(app: typer.Typer) -> None:
    app.command(no_args_is_help=True)(train)
