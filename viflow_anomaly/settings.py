"""Layered settings: command line over environment over configuration file over the defaults in the code.

Environment variables start with ``VIFLOW_`` and go down a level at each double underscore
(``VIFLOW_DETECTOR__REGIONS__THRESHOLD_MADS=8``). The file is TOML or JSON with the same names
(``[detector.regions]``). Every layer is checked where it enters, so that an error names the layer at fault, and a
wrong value is refused even where a higher layer would hide it. So is a ``VIFLOW_`` variable that nothing takes.
"""

from __future__ import annotations

import difflib
import json
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field

from viflow_anomaly.config import (
    MAX_THREADS,
    DetectorConfig,
    EvidenceTrainingConfig,
    FrozenConfig,
    ImageLimits,
    ModelConfig,
    NetworkPrecision,
    Precision,
    RigEstimateConfig,
    RuntimeName,
    TrackingConfig,
    TrainingConfig,
    UsablePath,
)
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.simulator.config import SimulatorConfig

ENVIRONMENT_PREFIX = "VIFLOW_"
SERVICE_SETTINGS = (
    "host",
    "port",
    "workers",
    "max_image_bytes",
    "max_image_pixels",
    "max_body_bytes",
    "max_imu_samples",
    "max_concurrent",
    "max_queued",
    "queue_timeout_s",
    "body_timeout_s",
    "request_timeout_s",
    "head_timeout_s",
    "max_connections",
    "key_file",
    "insecure_no_keys",
    "rate_limit_per_s",
    "rate_limit_burst",
    "daily_quota",
    "allowed_origins",
    "shutdown_timeout_s",
    "warm_up",
    "store_url",
    "store_max_age_s",
    "store_max_bytes",
    "thumbnails",
    "thumbnail_max_bytes",
    "max_streams",
    "max_stream_bytes",
    "stream_idle_s",
    "models",
    "model_dir",
    "max_models",
    "max_websockets",
    "max_websocket_bytes",
    "websocket_idle_s",
    "event_start_score",
    "event_start_pairs",
    "event_end_score",
    "event_end_s",
    "event_update_s",
    "event_cooldown_s",
    "event_ring",
    "max_event_readers",
    "event_delivery_attempts",
    "webhook_urls",
    "webhook_secret",
    "mqtt_url",
    "mqtt_prefix",
    "mqtt_discovery_prefix",
    "mqtt_ca_file",
    "live_pairs",
    "live_bytes",
    "dashboard",
    "log_level",
)
"""What the service alone takes and checks. It is built on the library, which cannot ask it; a test compares the two."""
SERVICE_TABLES = ("models",)
"""Those that hold tables whose names are free: ``VIFLOW_MODELS__NIGHT__CHECKPOINT``."""
SERVICE_TABLE = "service"
"""The table of a configuration file that holds them; the other commands pass it over."""
TEST_SETTINGS = ("real_data",)
SERVICE_LINK = re.compile(r"VIFLOW_ANOMALY(_\w+)?_(SERVICE_(HOST|PORT)(_\w+)?|PORT(_\d+_\w+)?)")
"""What Kubernetes puts into the environment of every container beside a service called ``viflow-anomaly``."""

Values = dict[str, Any]


class Settings(FrozenConfig):
    """All that the command line can be told; each command uses its own sections.

    ``threads`` defaults to 1: one pair at a time is fastest that way wherever anything else runs on the machine,
    because idle OpenMP threads of a wider pool spin and take the cores from each other. ``calibration`` is a file of
    ``viflow-anomaly calibrate``; its threshold takes the place of ``detector.regions.motion_score``.
    ``precision`` is the evidence head's, ``network_precision`` the network's.
    """

    checkpoint: UsablePath | None = None
    evidence_head: UsablePath | None = None
    calibration: UsablePath | None = None
    device: str = "cpu"
    threads: int = Field(default=1, ge=1, le=MAX_THREADS)
    runtime: RuntimeName = "auto"
    precision: Precision = "auto"
    network_precision: NetworkPrecision = "auto"
    limits: ImageLimits = ImageLimits()
    detector: DetectorConfig = DetectorConfig()
    tracking: TrackingConfig = TrackingConfig()
    rig_estimate: RigEstimateConfig = RigEstimateConfig()
    model: ModelConfig = ModelConfig()
    training: TrainingConfig = TrainingConfig()
    evidence_training: EvidenceTrainingConfig = EvidenceTrainingConfig()
    simulator: SimulatorConfig = Field(default_factory=lambda: SimulatorConfig.model_validate({}))


def resolve_settings(
    *,
    config_file: Path | None = None,
    environment: Mapping[str, str],
    assignments: Iterable[str] = (),
    options: Mapping[str, Any] | None = None,
    defaults: Mapping[str, Any] | None = None,
) -> Settings:
    """Merge the layers, lowest first, validating after each.

    Args:
        config_file: TOML or JSON, by its suffix.
        environment: usually ``os.environ``.
        assignments: ``section.key=value`` from the command line (``--set``).
        options: dotted key -> value from dedicated command line options; None means "not given".
        defaults: dotted key -> value instead of a default in the code, below every other layer.

    Raises:
        ConfigError: ``config_invalid``, ``config_unreadable``, ``config_format_unknown``, ``assignment_invalid``.
    """
    layers = _layers(config_file, environment, assignments, options, defaults)
    merged: Values = {}
    settings = Settings()
    for where, values in layers:
        if values:
            merged = _merge(merged, values)
            settings = Settings.from_mapping(merged, where=where)
    return settings


def setting_origins(
    *, config_file: Path | None = None, environment: Mapping[str, str], assignments: Iterable[str] = ()
) -> dict[str, str]:
    """Dotted name of every setting that was set -> the layer whose value holds; raises as ``resolve_settings``."""
    origins: dict[str, str] = {}
    for where, values in _layers(config_file, environment, assignments, None, None):
        origins |= dict.fromkeys(_leaves(values), where)
    return origins


def _layers(
    config_file: Path | None,
    environment: Mapping[str, str],
    assignments: Iterable[str],
    options: Mapping[str, Any] | None,
    defaults: Mapping[str, Any] | None,
) -> list[tuple[str, Values]]:
    """Where each comes from and what it sets, lowest first."""
    given = {key: value for key, value in (options or {}).items() if value is not None}
    layers = [("defaults", nested((key.split("."), value) for key, value in (defaults or {}).items()))]
    if config_file is not None:
        values = read_config_file(config_file)
        values.pop(SERVICE_TABLE, None)
        layers.append((str(config_file), values))
    layers.append(("environment", environment_values(environment)))
    layers.append(("--set", assignment_values(assignments)))
    layers.append(("command line", nested((key.split("."), value) for key, value in given.items())))
    return layers


def _leaves(values: Values, above: str = "") -> Iterator[str]:
    for name, value in values.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, f"{above}{name}.")
        else:
            yield above + name


def read_config_file(path: Path) -> Values:
    """The mapping a TOML or JSON file holds.

    Raises:
        ConfigError: ``config_unreadable`` (missing, a directory, not TOML/JSON, not a table),
            ``config_format_unknown``.
    """
    parse = {".toml": tomllib.loads, ".json": json.loads}.get(path.suffix.lower())
    if parse is None:
        raise ConfigError(
            f"{path}: expected a configuration file ending in .toml or .json, found {path.suffix or 'no suffix'}",
            code="config_format_unknown",
        )
    try:
        values = parse(path.read_text(encoding="utf-8"))
    except OSError as err:
        raise ConfigError(
            f"{path}: expected a readable configuration file, found: {err.strerror}", code="config_unreadable"
        ) from err
    except ValueError as err:  # tomllib's, json's and the decoder's errors are all ValueErrors
        raise ConfigError(
            f"{path}: expected a {path.suffix[1:].upper()} document, found: {err}", code="config_unreadable"
        ) from err
    if not isinstance(values, dict):
        raise ConfigError(
            f"{path}: expected a table of settings, found {type(values).__name__}", code="config_unreadable"
        )
    return values


def environment_values(environment: Mapping[str, str]) -> Values:
    """The settings among the environment variables.

    Raises:
        ConfigError: as ``refuse_unknown_variables``.
    """
    refuse_unknown_variables(environment)
    entries = []
    for name, text in sorted(environment.items()):
        path = name.removeprefix(ENVIRONMENT_PREFIX).lower().split("__")
        if name.startswith(ENVIRONMENT_PREFIX) and path[0] in Settings.model_fields:
            entries.append((path, _value(text)))
    return nested(entries)


def refuse_unknown_variables(names: Iterable[str]) -> None:
    """Nothing, where every ``VIFLOW_`` variable among ``names`` is one of the command line's, service's or tests'.

    Raises:
        ConfigError: ``config_invalid`` with the closest known name.
    """
    known = {ENVIRONMENT_PREFIX + name.upper() for name in (*_variables(Settings), *SERVICE_SETTINGS, *TEST_SETTINGS)}
    tables = tuple(f"{ENVIRONMENT_PREFIX}{name.upper()}__" for name in SERVICE_TABLES)
    for name in sorted(names):
        ours = name.startswith(ENVIRONMENT_PREFIX) and not SERVICE_LINK.fullmatch(name)
        within = name.upper().startswith(tables)
        if ours and not within and name.upper() not in known:
            (closest,) = difflib.get_close_matches(name.upper(), sorted(known), n=1, cutoff=0)
            raise ConfigError(
                f"environment: expected a {ENVIRONMENT_PREFIX} variable that viflow-anomaly knows, found {name}; "
                f"the closest known one is {closest}",
                code="config_invalid",
                field=name.removeprefix(ENVIRONMENT_PREFIX).lower().replace("__", "."),
            )


def _variables(section: type[BaseModel], above: str = "") -> Iterator[str]:
    """Names of all settings of a section and the sections in it: ``detector__regions__max_regions``."""
    for name, field in section.model_fields.items():
        yield above + name
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from _variables(field.annotation, f"{above}{name}__")


def assignment_values(assignments: Iterable[str]) -> Values:
    """``["detector.regions.max_regions=8"]`` as a nested mapping; values are JSON where they parse as JSON.

    Raises:
        ConfigError: ``assignment_invalid``.
    """
    entries = []
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        path = key.strip().split(".")
        if not equals or not all(path):
            raise ConfigError(
                f"--set: expected section.key=value, found {assignment!r}", code="assignment_invalid", field=key or None
            )
        entries.append((path, _value(text.strip())))
    return nested(entries)


def nested(entries: Iterable[tuple[list[str], Any]]) -> Values:
    """Paths and values as nested mappings; a later entry wins."""
    values: Values = {}
    for path, value in entries:
        leaf: Any = value
        for step in reversed(path):
            leaf = {step: leaf}
        values = _merge(values, leaf)
    return values


def _merge(lower: Values, upper: Values) -> Values:
    merged = dict(lower)
    for key, value in upper.items():
        below = merged.get(key)
        merged[key] = _merge(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged


def _value(text: str) -> Any:
    """JSON where it is JSON (numbers, booleans, lists), else the text itself."""
    try:
        return json.loads(text)
    except ValueError:
        return text
