"""``viflow-anomaly serve``: the HTTP service."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from viflow_anomaly.cli.options import (
    Assignments,
    Calibration,
    Checkpoint,
    ConfigFile,
    Device,
    Runtime,
    Threads,
    settings_from,
)
from viflow_anomaly.errors import ConfigError

if TYPE_CHECKING:
    from viflow_anomaly.config import ImageLimits


def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on (default 127.0.0.1).")] = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="Port (default 8000; 0 takes a free one).")] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Processes (default 1), each with its own model and queue.")
    ] = None,
    key_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="API keys: lines of `viflow-anomaly keys new`.")
    ] = None,
    insecure_no_keys: Annotated[
        bool | None,
        typer.Option("--insecure-no-keys", help="Let everybody ask who can reach an address that is not loopback."),
    ] = None,
    checkpoint: Checkpoint = None,
    calibration: Calibration = None,
    threads: Threads = None,
    device: Device = None,
    runtime: Runtime = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Serve POST /detect, streams, a dashboard at /, /healthz, /readyz, /models and /metrics until SIGINT or SIGTERM.

    On loopback no key is needed; where other machines can reach the service it starts with a key file only.

    Limits and queue lengths are environment variables (VIFLOW_MAX_IMAGE_BYTES, ...) or stand in the configuration
    file's table "service"; docs/service.md lists them.

    [bold]Examples[/bold]

      viflow-anomaly keys new --scope detect

      viflow-anomaly serve --host 0.0.0.0 --port 8000 --key-file keys.txt

      viflow-anomaly serve --workers 4 --config service.toml
    """
    options = {"checkpoint": checkpoint, "calibration": calibration, "threads": threads, "device": device}
    settings = settings_from(config, assignments, {**options, "runtime": runtime})
    _refuse_other_limits(settings.limits)
    # By name: the service is built on the library, so no module of the library may import it.
    service_settings = import_module("viflow_anomaly_service.settings")
    server = import_module("viflow_anomaly_service.server")
    server.run(
        service_settings.load_settings(
            service_table(config),
            host=host,
            port=port,
            workers=workers,
            key_file=key_file,
            insecure_no_keys=insecure_no_keys,
            checkpoint=settings.checkpoint,
            evidence_head=settings.evidence_head,
            precision=settings.precision,
            network_precision=settings.network_precision,
            calibration=settings.calibration,
            threads=settings.threads,
            device=settings.device,
            runtime=settings.runtime,
            detector=settings.detector,
        )
    )


def service_table(config: Path | None) -> dict[str, Any]:
    """What the configuration file says to the service alone.

    Raises:
        ConfigError: ``config_invalid``: it is no table.
    """
    from viflow_anomaly.settings import SERVICE_TABLE, read_config_file

    table = {} if config is None else read_config_file(config).get(SERVICE_TABLE, {})
    if not isinstance(table, dict):
        raise ConfigError(
            f"{config}: expected a table [{SERVICE_TABLE}], found {type(table).__name__}",
            code="config_invalid",
            field=SERVICE_TABLE,
        )
    return table


def _refuse_other_limits(limits: ImageLimits) -> None:
    """Limits that were changed would have no effect: the service has its own.

    Raises:
        ConfigError: ``config_invalid`` with the variable that has one.
    """
    for name, field in type(limits).model_fields.items():
        value = getattr(limits, name)
        if value != field.default:
            raise ConfigError(
                f"limits.{name}: expected the default {field.default} (the service has its own limits), found {value}; "
                f"set VIFLOW_MAX_IMAGE_{name.removeprefix('max_').upper()}",
                code="config_invalid",
                field=f"limits.{name}",
            )


def register(app: typer.Typer) -> None:
    app.command()(serve)
