"""What the service can be told: keyword arguments over the environment (``VIFLOW_...``) over the defaults here."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Final, Literal, NamedTuple, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    SecretStr,
    ValidationError,
    model_validator,
)
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict, SettingsError

from viflow_anomaly.config import (
    MAX_THREADS,
    DetectorConfig,
    ImageLimits,
    NetworkPrecision,
    Precision,
    RuntimeName,
    UsablePath,
    describe_validation,
)
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.settings import ENVIRONMENT_PREFIX, SERVICE_SETTINGS, refuse_unknown_variables
from viflow_anomaly_service.models.named import ModelName, NamedModel

MEBIBYTE = 1024 * 1024
MAX_WORKERS: Final = 256
_ORIGIN: Final = re.compile(r"https?://[A-Za-z0-9.-]+(:\d{1,5})?|https?://\[[0-9a-f:]+\](:\d{1,5})?")
_MASKED: Final = re.compile(r"\*+|[a-z0-9+]+://[^/]*:\*+@.*")
_CAMERA: Final = re.compile(
    r"(?P<width>[1-9]\d{1,4})x(?P<height>[1-9]\d{1,4})(@(?P<focal>[1-9]\d{0,5}(\.\d+)?))?", re.ASCII
)


def _usable_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class WarmUpCamera(NamedTuple):
    """The size of a camera's images in pixels and its focal length, None: such images come without a calibration."""

    width: int
    height: int
    focal_px: float | None

    def __str__(self) -> str:
        return f"{self.width}x{self.height}" + ("" if self.focal_px is None else f"@{self.focal_px:g}")


def _cameras(value: Any) -> Any:
    """``"752x480@458,640x480"`` as cameras; anything else as it is."""
    if not isinstance(value, str):
        return value
    found = [_CAMERA.fullmatch(text.strip()) for text in value.split(",") if text.strip()]
    if None in found:
        raise ValueError(f"expected WIDTHxHEIGHT or WIDTHxHEIGHT@FOCAL, such as 752x480@458, found {value!r:.80}")
    return tuple(
        WarmUpCamera(int(one["width"]), int(one["height"]), float(one["focal"]) if one["focal"] else None)
        for one in found
        if one is not None
    )


def _origins(value: Any) -> Any:
    """``"https://a.example,https://b.example"`` as texts, each a scheme and a host; anything else as it is."""
    if not isinstance(value, str):
        return value
    found = [text.strip() for text in value.split(",") if text.strip()]
    for text in found:
        if not _ORIGIN.fullmatch(text):
            raise ValueError(f"expected origins such as https://dashboard.example, found {text!r:.80}")
    return tuple(found)


def _texts(value: Any) -> Any:
    """``"a,b"`` as texts; anything else as it is."""
    return tuple(text.strip() for text in value.split(",") if text.strip()) if isinstance(value, str) else value


ThumbnailChoice = Literal["none", "motion", "all"]
Origins = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_origins)]
Score = Annotated[float, Field(ge=0, le=1)]
EventSeconds = Annotated[float, Field(ge=0, le=86_400)]
Topic = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+(/[A-Za-z0-9_-]+)*$", max_length=100)]


def _shown(value: SecretStr) -> SecretStr:
    """A secret; what `config` shows in its place is none."""
    if _MASKED.fullmatch(value.get_secret_value()):
        raise ValueError("expected the secret itself, found the stars that `config` shows in its place")
    return value


Secret = Annotated[SecretStr, AfterValidator(_shown)]
Secrets = Annotated[tuple[Secret, ...], NoDecode, BeforeValidator(_texts)]
Cameras = Annotated[tuple[WarmUpCamera, ...], NoDecode, BeforeValidator(_cameras)]
_EUROC: Final = (WarmUpCamera(752, 480, None), WarmUpCamera(752, 480, 458.0))


class ServiceSettings(BaseSettings):
    """Settings of one service process; ``VIFLOW_PORT=9000`` or ``VIFLOW_DETECTOR__REGIONS__MAX_REGIONS=8``.

    Build it with :func:`load_settings`, whose error names the variable at fault.
    """

    model_config = SettingsConfigDict(
        env_prefix="VIFLOW_", env_nested_delimiter="__", frozen=True, extra="forbid", allow_inf_nan=False
    )

    checkpoint: UsablePath | None = Field(default=None, description="model to load; the bundled one when not given")
    evidence_head: UsablePath | None = Field(default=None, description="head to load; the bundled one when not given")
    precision: Precision = Field(
        default="auto", description="of the evidence head: f32, bf16, int8, or auto: bf16 where OpenVINO can"
    )
    network_precision: NetworkPrecision = Field(default="auto", description="of the network: f32 (auto on a CPU), bf16")
    calibration: UsablePath | None = Field(default=None, description="file of `viflow-anomaly calibrate`")
    device: str = "cpu"
    runtime: RuntimeName = Field(
        default="auto", description="openvino, onnxruntime, torch, or auto: the first that can run"
    )
    detector: DetectorConfig = DetectorConfig()
    host: str = "127.0.0.1"
    port: int = Field(default=8000, ge=0, le=65535, description="0 takes a free one, named in the log")
    max_image_bytes: PositiveInt = 16 * MEBIBYTE
    max_image_pixels: PositiveInt = 16 * MEBIBYTE
    max_body_bytes: PositiveInt = 48 * MEBIBYTE
    max_imu_samples: PositiveInt = 20_000
    threads: int = Field(default=1, ge=1, le=MAX_THREADS, description="threads of one detection")
    workers: int = Field(default=1, ge=1, le=MAX_WORKERS, description="processes, each with its own model and limits")
    max_concurrent: PositiveInt | None = Field(
        default=None, description="detections running at once in a process; not given: the cores over the processes"
    )
    max_queued: NonNegativeInt = Field(default=32, description="requests that may wait or upload beside them")
    queue_timeout_s: PositiveFloat = Field(default=10.0, description="longest wait for a turn")
    body_timeout_s: PositiveFloat = Field(default=30.0, description="longest upload")
    request_timeout_s: PositiveFloat = Field(default=120.0, description="longest request, from head to last byte")
    head_timeout_s: PositiveFloat = Field(default=10.0, description="longest wait for a request's head")
    max_connections: PositiveInt = Field(default=1024, description="open connections of a process")
    key_file: UsablePath | None = Field(default=None, description="API keys, lines of `viflow-anomaly keys new`")
    insecure_no_keys: bool = Field(default=False, description="everybody who reaches the service may ask")
    rate_limit_per_s: PositiveFloat | None = Field(default=None, description="requests a second of one key")
    rate_limit_burst: PositiveInt = Field(default=20, description="requests of one key at once")
    daily_quota: PositiveInt | None = Field(default=None, description="detections a day of one key")
    allowed_origins: Origins = Field(default=(), description="sites whose pages may ask (CORS)")
    shutdown_timeout_s: PositiveInt = Field(default=20, description="time for running requests after SIGTERM")
    warm_up: Cameras = Field(default=_EUROC, description="WIDTHxHEIGHT[@FOCAL] of what is judged before it is ready")
    store_url: Secret | None = Field(
        default=None, description="where detections stay: a path or sqlite:////path, or postgresql://...; none: nowhere"
    )
    store_max_age_s: PositiveFloat | None = Field(default=None, description="older detections are deleted")
    store_max_bytes: PositiveInt = Field(default=8 * 1024 * MEBIBYTE, description="of detections that stay")
    thumbnails: ThumbnailChoice = Field(
        default="motion", description="kept beside detections: none, motion (where something moves), all"
    )
    thumbnail_max_bytes: PositiveInt = Field(default=256 * MEBIBYTE, description="of all thumbnails that stay")
    max_streams: PositiveInt = Field(default=64, description="streams at once")
    max_stream_bytes: PositiveInt = Field(default=256 * MEBIBYTE, description="what all streams remember together")
    stream_idle_s: PositiveFloat = Field(default=60.0, description="after which a stream is forgotten")
    models: dict[ModelName, NamedModel] = Field(
        default_factory=dict, description="further models by name, each what differs from the settings above"
    )
    model_dir: UsablePath | None = Field(default=None, description="folder whose models may be loaded by request")
    max_models: PositiveInt = Field(default=4, description="models in memory, the default included")
    max_websockets: PositiveInt = Field(default=32, description="open WebSockets")
    max_websocket_bytes: PositiveInt = Field(default=4 * MEBIBYTE, description="of one message of a WebSocket")
    websocket_idle_s: PositiveFloat = Field(default=60.0, description="after which a silent WebSocket is closed")
    event_start_score: Score = Field(default=0.5, description="of a track, from which on it begins an event")
    event_start_pairs: int = Field(default=3, ge=1, le=1000, description="judged pairs in a row with that score")
    event_end_score: Score = Field(default=0.3, description="below which, or unseen, a track ends its event")
    event_end_s: EventSeconds = Field(default=2.0, description="for so long, in camera time")
    event_update_s: EventSeconds = Field(default=1.0, description="at least between two messages of one event")
    event_cooldown_s: EventSeconds = Field(default=2.0, description="after an end none begins in the stream")
    event_ring: int = Field(default=1024, ge=1, le=100_000, description="events kept in memory without a store")
    max_event_readers: PositiveInt = Field(default=64, description="connections to /events/live at once")
    event_delivery_attempts: int = Field(default=15, ge=1, le=1000, description="then an event is a dead letter")
    webhook_urls: Secrets = Field(default=(), description="who is posted every event: https://a.example/hook,...")
    webhook_secret: Secret | None = Field(default=None, description="signs what is posted")
    mqtt_url: Secret | None = Field(default=None, description="broker: mqtt:// or mqtts://user:password@host:port")
    mqtt_prefix: Topic = Field(default="viflow", description="ahead of all topics of this service, and of no other")
    mqtt_discovery_prefix: Topic = Field(default="homeassistant", description="where Home Assistant looks")
    mqtt_ca_file: UsablePath | None = Field(default=None, description="whom mqtts:// trusts; not given: as the system")
    live_pairs: NonNegativeInt = Field(default=120, description="recent pairs of a stream to look at; 0: none")
    live_bytes: PositiveInt = Field(default=256 * MEBIBYTE, description="of all recent pairs together")
    dashboard: bool = Field(default=True, description="the page at /")
    log_level: Literal["debug", "info", "warning", "error"] = "info"

    @model_validator(mode="after")
    def _models_fit(self) -> Self:
        if 1 + len(self.models) > self.max_models:
            raise ValueError(f"max_models: expected at least {1 + len(self.models)}, found {self.max_models}")
        return self

    @property
    def workers_at_once(self) -> int:
        """Detections that run at once in one process."""
        return self.max_concurrent or -(-_usable_cores() // self.workers)

    @property
    def image_limits(self) -> ImageLimits:
        return ImageLimits(max_bytes=self.max_image_bytes, max_pixels=self.max_image_pixels)

    @property
    def max_json_values(self) -> int:
        """Commas and opening brackets a JSON text may hold: nine for each IMU sample, and the rest of a request."""
        return 10 * self.max_imu_samples + 4096


def load_settings(file_values: Mapping[str, Any] | None = None, **overrides: Any) -> ServiceSettings:
    """Settings from the environment, over ``file_values``, with ``overrides`` (those that are not None) on top.

    Args:
        file_values: the table ``[service]`` of a configuration file: settings that the service alone takes.

    Raises:
        ConfigError: ``config_invalid`` with the setting at fault, or with a variable that nothing takes.
    """
    _refuse_other_limits(os.environ)
    return resolve_service_settings(file_values, **overrides)


def resolve_service_settings(file_values: Mapping[str, Any] | None = None, **overrides: Any) -> ServiceSettings:
    """As ``load_settings``, for a command that serves nothing: the other commands' limits may be set."""
    refuse_unknown_variables(os.environ)
    given = {name: value for name, value in overrides.items() if value is not None}
    settings = _validated(given, "service settings")
    if file_values:
        settings = _validated({**_checked_file_values(file_values), **given}, "service settings")
    return settings


def _checked_file_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """Those that no variable of the environment overrides; checked all the same, so that an error names the file."""
    for name in values:
        if name not in SERVICE_SETTINGS:
            raise ConfigError(
                f"configuration file, [service]: expected {', '.join(SERVICE_SETTINGS)}, found {name!r:.80}",
                code="config_invalid",
                field=f"service.{name}"[:80],
            )
    _validated(values, "configuration file, [service]")
    return _not_given(values, ENVIRONMENT_PREFIX, {name.upper() for name in os.environ})


def _not_given(values: Mapping[str, Any], prefix: str, given: set[str]) -> dict[str, Any]:
    """Those below ``prefix`` that no variable gives, tables within without the members that one gives."""
    left = {name: value for name, value in values.items() if prefix + name.upper() not in given}
    return {
        name: _not_given(value, f"{prefix}{name.upper()}__", given) if isinstance(value, Mapping) else value
        for name, value in left.items()
    }


def _validated(values: Mapping[str, Any], where: str) -> ServiceSettings:
    try:
        return ServiceSettings(**values)
    except ValidationError as err:
        place = ".".join(str(step) for step in err.errors()[0]["loc"])
        raise ConfigError(f"{where}: {describe_validation(err)}", code="config_invalid", field=place or None) from err
    except SettingsError as err:  # a section that is not JSON
        raise ConfigError(f"{where}: {err}", code="config_invalid") from err


def _refuse_other_limits(names: Iterable[str]) -> None:
    """The command line's limits, which a reader of the environment would take for the service's."""
    for name in sorted(names):
        if name.upper().startswith("VIFLOW_LIMITS"):
            raise ConfigError(
                "environment: expected the limits of the service, VIFLOW_MAX_IMAGE_BYTES and VIFLOW_MAX_IMAGE_PIXELS, "
                f"found {name}, which limits the other commands only",
                code="config_invalid",
                field="limits",
            )
