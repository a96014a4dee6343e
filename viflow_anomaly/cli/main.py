"""Entry point: the commands, and the one place where an error becomes a line on stderr and an exit code.

Exit codes: 0 done, 2 bad usage or input, 3 some pairs of a batch failed or a replay left something out, 130
interrupted.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import Annotated

import typer
from typer.exceptions import TyperException

from viflow_anomaly.allocator import keep_freed_memory
from viflow_anomaly.cli import (
    batch,
    benchmark,
    calibrate,
    configuration,
    detect,
    evaluate,
    export,
    fit_scores,
    groundtruth,
    keys,
    replay,
    schema,
    serve,
    simulate,
    train,
    train_evidence,
)
from viflow_anomaly.errors import ViflowError
from viflow_anomaly.idle_threads import keep_idle_threads_from_spinning

EXIT_BAD_INPUT = 2
PROGRAM = "viflow-anomaly"

app = typer.Typer(
    name=PROGRAM,
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Exit codes: 0 done, 2 bad usage or input, 3 some pairs failed, 130 interrupted.",
)
for module in (
    detect,
    batch,
    calibrate,
    simulate,
    train,
    train_evidence,
    fit_scores,
    groundtruth,
    evaluate,
    benchmark,
    export,
    serve,
    replay,
    keys,
    schema,
    configuration,
):
    module.register(app)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"{PROGRAM} {version(PROGRAM)}")
        raise typer.Exit


@app.callback()
def viflow_anomaly(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Finds independent motion in what a moving camera sees, from two frames and the IMU samples around them.

    [bold]Examples[/bold]

      viflow-anomaly detect frame0.png frame1.png --imu imu.json --overlay out.png

      viflow-anomaly batch V1_01_easy/mav0 --overlays 20 --video

      viflow-anomaly simulate --rig drone --out runs/sim && viflow-anomaly train runs/sim/* --out runs/first

      viflow-anomaly serve --port 8000
    """


def run(arguments: Sequence[str]) -> int:
    """Run one command line and return its exit code; a user's mistake is one line on stderr, never a traceback."""
    try:
        code = app(list(arguments), prog_name=PROGRAM, standalone_mode=False)
    except TyperException as err:
        context = getattr(err, "ctx", None)
        hint = f" (try '{context.command_path} --help')" if context else ""
        return _complain((err.format_message() or "expected a command, found none") + hint)
    except ViflowError as err:
        return _complain(f"{err.message} [{err.code}]")
    except RecursionError:
        return _complain("expected settings and files nested a few levels deep, found hundreds")
    except OSError as err:
        place = f"{err.filename}: " if err.filename is not None else ""
        return _complain(f"{place}{err.strerror or err}")
    return code if isinstance(code, int) else 0


def _complain(message: str) -> int:
    print("error: " + " ".join(message.split()), file=sys.stderr)
    return EXIT_BAD_INPUT


def main() -> None:
    """The console script."""
    keep_idle_threads_from_spinning()
    keep_freed_memory()
    sys.exit(run(sys.argv[1:]))
