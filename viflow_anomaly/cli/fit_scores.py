"""``viflow-anomaly fit-scores``: what the regions of a trained evidence head score, fitted anew."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Final

import typer

from viflow_anomaly.cli.options import (
    Assignments,
    Checkpoint,
    ConfigFile,
    load_detector,
    settings_from,
)
from viflow_anomaly.cli.progress import stderr_progress
from viflow_anomaly.cli.train_evidence import recordings_in

ENOUGH_REGIONS: Final = 100
FEW: Final = f"; note: with fewer than {ENOUGH_REGIONS} that move, or that do not, scores may be far off"


def fit_scores(
    calibration: Annotated[
        list[Path],
        typer.Argument(metavar="DIR...", help="Folders of simulated recordings that the head was not trained on."),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The head with its new scores (.safetensors and .json).")],
    checkpoint: Checkpoint = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Fit the scores of an evidence head anew, so that of regions scored 0.8 about 80 % move by themselves.

    The head (`evidence_head`, or the bundled one) keeps its weights. Of use where the network, the regions or the mix
    of scenes has changed: a score is a share, and holds for recordings like those that it was fitted on.

    [bold]Examples[/bold]

      viflow-anomaly simulate --rig drone --seed 35000 --sequences 50 --frames 7 --out runs/calibration

      viflow-anomaly fit-scores runs/calibration --out rescored.safetensors
    """
    settings = settings_from(config, assignments, {"checkpoint": checkpoint})
    # No head is loaded beside the network: the one whose scores are fitted judges every pair.
    settings = settings.model_copy(update={"detector": settings.detector.model_copy(update={"evidence": "auto"})})
    from viflow_anomaly.evidence_run import refit_scores

    folders = [path for folder in calibration for path in recordings_in(folder)]
    with stderr_progress() as progress:
        task = progress.add_task("calibrating", total=None)
        head = refit_scores(
            load_detector(settings, evidence=False),
            settings.evidence_head,
            folders,
            out,
            report=lambda what, done, total: progress.update(task, description=what, completed=done, total=total),
        )
    counts = json.loads(head.with_suffix(".json").read_text(encoding="utf-8"))["provenance"]["calibrated_on"]
    told = f"fitted on {counts['regions']} regions in {len(folders)} recordings; {counts['moving']} of them move"
    few = min(counts["moving"], counts["regions"] - counts["moving"]) < ENOUGH_REGIONS
    print(f"{told}{FEW if few else ''}", file=sys.stderr)
    print(head)


def register(app: typer.Typer) -> None:
    app.command("fit-scores", no_args_is_help=True)(fit_scores)
