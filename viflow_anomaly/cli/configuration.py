"""``viflow-anomaly config``: the settings as they resolve here and now."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

from viflow_anomaly.cli.options import Assignments, ConfigFile, settings_from
from viflow_anomaly.cli.serve import service_table

MASK = "***"
_SECRET_NAME = re.compile(r"(^|_)(password|passwd|secret|token|api_key)$")
_URL_PASSWORD = re.compile(r"(?<=://)([^/\s:@]*):[^\s]*@")
_DSN_PASSWORD = re.compile(r"\b(password)\s*=\s*('[^']*'|\S+)", re.IGNORECASE)


def config(
    origins: Annotated[
        bool, typer.Option("--origins", help="Only what was set: each setting, its value and the layer that set it.")
    ] = False,
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Print the resolved settings as JSON: command line over environment over file over defaults.

    The table "service" holds what `serve` alone takes. Secrets are shown as ***; apart from them the output is itself a
    configuration file. An environment variable goes down a level at each double underscore.

    [bold]Examples[/bold]

      viflow-anomaly config > settings.json

      VIFLOW_DETECTOR__REGIONS__MAX_REGIONS=8 viflow-anomaly config --set detector.include_masks=true --origins
    """
    from viflow_anomaly.settings import SERVICE_SETTINGS, SERVICE_TABLE

    settings = settings_from(config, assignments)
    # By name: the service is built on the library, so no module of the library may import it.
    service = import_module("viflow_anomaly_service.settings").resolve_service_settings(service_table(config))
    values = settings.model_dump(mode="json")
    values[SERVICE_TABLE] = service.model_dump(mode="json", include=set(SERVICE_SETTINGS))
    values = masked(values)
    shown = _with_origins(values, config, assignments) if origins else values
    print(json.dumps(shown, indent=2, ensure_ascii=False))


def masked(value: Any, name: str = "") -> Any:
    """A copy in which secrets, and passwords inside addresses, are stars."""
    if isinstance(value, Mapping):
        return {key: masked(below, key) for key, below in value.items()}
    if isinstance(value, list):
        return [masked(item, name) for item in value]
    if value is not None and _SECRET_NAME.search(name):
        return MASK
    if isinstance(value, str) and value.strip("*") == "" and value:
        return MASK  # a secret of the service's, which hides itself
    if isinstance(value, str):
        return _DSN_PASSWORD.sub(rf"\1={MASK}", _URL_PASSWORD.sub(rf"\1:{MASK}@", value))
    return value


def _with_origins(values: dict[str, Any], config: Path | None, assignments: list[str] | None) -> dict[str, Any]:
    """Dotted name -> value and layer, of what was set anywhere."""
    from viflow_anomaly.settings import ENVIRONMENT_PREFIX, SERVICE_TABLE, setting_origins

    found = setting_origins(config_file=config, environment=os.environ, assignments=assignments or ())
    given = {name.upper() for name in os.environ}
    from_file = service_table(config)
    for name in values[SERVICE_TABLE]:
        variable = ENVIRONMENT_PREFIX + name.upper()
        if any(one == variable or one.startswith(f"{variable}__") for one in given):
            found[f"{SERVICE_TABLE}.{name}"] = "environment"
        elif name in from_file:
            found[f"{SERVICE_TABLE}.{name}"] = str(config)
    return {name: {"value": _value_at(values, name), "from": where} for name, where in sorted(found.items())}


def _value_at(values: dict[str, Any], name: str) -> Any:
    found: Any = values
    for step in name.split("."):
        found = found[step]
    return found


def register(app: typer.Typer) -> None:
    app.command()(config)
