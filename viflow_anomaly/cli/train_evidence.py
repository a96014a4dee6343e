"""``viflow-anomaly train-evidence``: supervised training of the evidence head on simulated recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from viflow_anomaly.cli.options import (
    BUNDLED,
    Assignments,
    Checkpoint,
    ConfigFile,
    Device,
    Resume,
    Seed,
    Steps,
    TrainingThreads,
    in_section,
    load_detector,
    settings_from,
    told,
)
from viflow_anomaly.cli.progress import stderr_progress
from viflow_anomaly.config import EVIDENCE_FINE_TUNING_DEFAULTS
from viflow_anomaly.errors import DatasetError


def train_evidence(
    data: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Simulated recordings with ground truth to train on.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where cues, state and the finished head go.")],
    calibration: Annotated[
        list[Path],
        typer.Option(metavar="DIR", help="A folder of recordings to fit the scores on, never to train on. Repeatable."),
    ],
    init: Annotated[
        Path | None,
        typer.Option(
            metavar="default|PATH",
            help="Start from a head's weights (the word default: the bundled one's) and take its structure. Unless "
            f"they are set, {told(EVIDENCE_FINE_TUNING_DEFAULTS)}.",
        ),
    ] = None,
    steps: Steps = None,
    seed: Seed = None,
    resume: Resume = False,
    threads: TrainingThreads = None,
    checkpoint: Checkpoint = None,
    device: Device = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Train the head that tells motion from model error, for the network whose flow it is to judge.

    It learns from simulated recordings (`viflow-anomaly simulate`), whose masks say what moves, and sees geometric cues
    only. --calibration names folders of further recordings, a folder each. Settings are in the section
    `evidence_training` (see `viflow-anomaly config`).

    [bold]Examples[/bold]

      viflow-anomaly train-evidence runs/sim/* --calibration runs/calibration --out runs/head --steps 15000

      viflow-anomaly batch V1_01_easy --set evidence_head=runs/head/evidence.safetensors
    """
    options = {
        "evidence_training.steps": steps,
        "evidence_training.seed": seed,
        "evidence_training.threads": threads,
        "checkpoint": checkpoint,
        "device": device,
    }
    fine_tuning = None if init is None else in_section("evidence_training", EVIDENCE_FINE_TUNING_DEFAULTS)
    settings = settings_from(config, assignments, options, defaults=fine_tuning)
    # There is no head yet, and the one that comes judges every pair.
    settings = settings.model_copy(update={"detector": settings.detector.model_copy(update={"evidence": "auto"})})
    from viflow_anomaly.checkpoint_record import bundled_evidence_head
    from viflow_anomaly.evidence_run import train_evidence as train_head

    folders = [path for folder in calibration for path in recordings_in(folder)]
    with stderr_progress() as progress:
        task = progress.add_task("reading", total=None)
        head = train_head(
            data,
            out,
            calibration=folders,
            detector=load_detector(settings, evidence=False),
            training=settings.evidence_training,
            init=bundled_evidence_head() if init == BUNDLED else init,
            device=settings.device,
            resume=resume,
            report=lambda what, done, total: progress.update(task, description=what, completed=done, total=total),
        )
    print(head)


def recordings_in(folder: Path) -> list[Path]:
    """Its sub-folders by name; hidden ones, such as a simulation that is still being written, are none. A simulated
    recording is one by itself, not a folder of some.

    Raises:
        DatasetError: ``directory_missing``.
    """
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing there"
        raise DatasetError(
            f"{folder}: expected a folder of recordings, found {found}",
            code="directory_missing",
            field="calibration",
        )
    if (folder / "mav0").is_dir():
        return [folder]
    return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))


def register(app: typer.Typer) -> None:
    app.command("train-evidence", no_args_is_help=True)(train_evidence)
