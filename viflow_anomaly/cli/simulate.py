"""``viflow-anomaly simulate``: sequences with exact ground truth."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from viflow_anomaly.cli.options import Assignments, ConfigFile, settings_from
from viflow_anomaly.cli.progress import stderr_progress


class Rig(StrEnum):
    """What carries the camera."""

    DRONE = "drone"
    CAR = "car"


def simulate(
    out: Annotated[Path, typer.Option(metavar="DIR", help="A folder for each sequence is made in here.")],
    rig: Annotated[Rig | None, typer.Option(help="6-DoF flight at 20 Hz, or driving at 10 Hz (default drone).")] = None,
    sequences: Annotated[int | None, typer.Option(min=1, metavar="N", help="How many (default 1).")] = None,
    frames: Annotated[int | None, typer.Option(min=2, metavar="N", help="Per sequence (default 60).")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of the first sequence; the next has seed + 1.")] = None,
    jobs: Annotated[int | None, typer.Option(min=1, metavar="N", help="Processes (default 1).")] = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Render camera + IMU sequences in EuRoC layout, with depth, flow, masks and moving objects as ground truth.

    The same seed gives the same bytes. Needs the `simulate` extra and a GL library (libegl1 or libosmesa6).

    [bold]Examples[/bold]

      viflow-anomaly simulate --rig drone --sequences 4 --out runs/sim

      viflow-anomaly simulate --rig car --frames 100 --seed 7 --out runs/street --set simulator.ground_truth=false
    """
    options = {
        "simulator.rig": None if rig is None else rig.value,
        "simulator.sequences": sequences,
        "simulator.frames": frames,
        "simulator.seed": seed,
        "simulator.jobs": jobs,
    }
    simulator = settings_from(config, assignments, options).simulator
    from viflow_anomaly.simulator.run import simulate as simulate_sequences

    with stderr_progress() as progress:
        task = progress.add_task("sequences", total=simulator.sequences)
        folders = simulate_sequences(
            simulator, out, on_progress=lambda done, total: progress.update(task, completed=done, total=total)
        )
    for folder in folders:
        print(folder)


def register(app: typer.Typer) -> None:
    app.command(no_args_is_help=True)(simulate)
