"""``viflow-anomaly keys``: API keys of the HTTP service."""

from __future__ import annotations

import json
import secrets
import sys
from importlib import import_module
from typing import Annotated

import typer

from viflow_anomaly.cli.options import AsJson

keys = typer.Typer(no_args_is_help=True, help="API keys of the HTTP service.")


@keys.callback()
def group() -> None:
    """API keys of the HTTP service: docs/security.md."""


@keys.command()
def new(
    scope: Annotated[list[str], typer.Option(metavar="SCOPE", help="detect, read or admin. Repeatable.")],
    name: Annotated[
        str | None, typer.Option(metavar="NAME", help="Who will use it: a-z, 0-9 and '-'; stands in the log.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make a key: shown once, here; the key file gets its hash.

    Standard output is the line for the key file, so that it can be appended; the key itself goes to standard error.

    [bold]Examples[/bold]

      viflow-anomaly keys new --scope detect --name drone7 >> keys.txt

      viflow-anomaly keys new --scope read --name prometheus --json
    """
    # By name: the service is built on the library, so no module of the library may import it.
    api_keys = import_module("viflow_anomaly_service.api_keys")
    key, line = api_keys.new_key(name or f"key-{secrets.token_hex(3)}", scope)
    if as_json:
        print(json.dumps({"key": key, "line": line}))
        return
    print(f"key (shown this once): {key}\nline for the key file (standard output):", file=sys.stderr, flush=True)
    print(line)


def register(app: typer.Typer) -> None:
    app.add_typer(keys, name="keys")
