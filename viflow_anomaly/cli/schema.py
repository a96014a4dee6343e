"""``viflow-anomaly schema``: the JSON Schema of a detection."""

from __future__ import annotations

from importlib.resources import files

import typer


def schema() -> None:
    """Print the JSON Schema that every detection (`detect --json`, `batch`, POST /detect) satisfies.

    [bold]Example[/bold]

      viflow-anomaly schema > detection.schema.json
    """
    print(files("viflow_anomaly.schemas").joinpath("detection-1.0.schema.json").read_text(encoding="utf-8"), end="")


def register(app: typer.Typer) -> None:
    app.command()(schema)
