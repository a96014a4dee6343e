"""``viflow-anomaly config``: the settings as they resolve here and now."""

from __future__ import annotations

import typer

from viflow_anomaly.cli.options import Assignments, ConfigFile, settings_from


def config(config: ConfigFile = None, assignments: Assignments = None) -> None:
    """Print the resolved settings as JSON: command line over environment over file over defaults.

    The output is itself a configuration file. An environment variable goes down a level at each double underscore.

    [bold]Examples[/bold]

      viflow-anomaly config > settings.json

      VIFLOW_DETECTOR__REGIONS__MAX_REGIONS=8 viflow-anomaly config --set detector.include_masks=true
    """
    print(settings_from(config, assignments).model_dump_json(indent=2))


def register(app: typer.Typer) -> None:
    app.command()(config)
