from __future__ import annotations

from pathlib import Path

import pytest

from viflow_anomaly.errors import ConfigError
from viflow_anomaly.settings import SERVICE_SETTINGS, Settings
from viflow_anomaly_service.settings import ServiceSettings, load_settings


def test_defaults(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("VIFLOW_HOST", "VIFLOW_PORT", "VIFLOW_THREADS"):
        monkeypatch.delenv(name, raising=False)
    settings = load_settings()
    assert (settings.host, settings.port, settings.threads, settings.checkpoint) == ("127.0.0.1", 8000, 1, None)
    assert settings.workers_at_once >= 1
    assert [str(camera) for camera in settings.warm_up] == ["752x480", "752x480@458"]
    assert (settings.image_limits.max_bytes, settings.image_limits.max_pixels) == (2**24, 2**24)


def test_argument_over_environment_over_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIFLOW_PORT", "9001")
    monkeypatch.setenv("VIFLOW_MAX_IMAGE_PIXELS", "4096")
    monkeypatch.setenv("VIFLOW_DETECTOR__REGIONS__THRESHOLD_MADS", "8.5")
    settings = load_settings(host="0.0.0.0", port=None)  # noqa: S104 - nothing listens
    assert (settings.host, settings.port) == ("0.0.0.0", 9001)  # noqa: S104
    assert settings.image_limits.max_pixels == 4096
    assert settings.detector.regions.threshold_mads == 8.5
    assert settings.detector.regions.max_regions == 64
    assert load_settings(port=9002).port == 9002


@pytest.mark.parametrize(
    ("name", "value", "place"),
    [
        ("VIFLOW_PORT", "http", "port"),
        ("VIFLOW_PORT", "65536", "port"),
        ("VIFLOW_THREADS", "0", "threads"),
        ("VIFLOW_MAX_BODY_BYTES", "-1", "max_body_bytes"),
        ("VIFLOW_QUEUE_TIMEOUT_S", "inf", "queue_timeout_s"),
        ("VIFLOW_LOG_LEVEL", "loud", "log_level"),
        ("VIFLOW_WORKERS", "0", "workers"),
        ("VIFLOW_EVENT_START_SCORE", "1.1", "event_start_score"),
        ("VIFLOW_EVENT_START_PAIRS", "0", "event_start_pairs"),
        ("VIFLOW_EVENT_END_S", "-1", "event_end_s"),
        ("VIFLOW_EVENT_COOLDOWN_S", "inf", "event_cooldown_s"),
        ("VIFLOW_MQTT_PREFIX", "a/#", "mqtt_prefix"),
        ("VIFLOW_MQTT_DISCOVERY_PREFIX", "/a", "mqtt_discovery_prefix"),
        ("VIFLOW_WARM_UP", "752", "warm_up"),
        ("VIFLOW_WARM_UP", "752x480,0x1", "warm_up"),
        ("VIFLOW_WARM_UP", "752x480@0", "warm_up"),
        ("VIFLOW_WARM_UP", "752x480@", "warm_up"),
        ("VIFLOW_DETECTOR__REGIONS__THRESHOLD", "1", "detector.regions.threshold"),
    ],
)
def test_a_wrong_variable_is_named(monkeypatch: pytest.MonkeyPatch, name: str, value: str, place: str) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(ConfigError) as caught:
        load_settings()
    assert (caught.value.code, caught.value.field) == ("config_invalid", place)


def test_a_calibration_is_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    assert load_settings().calibration is None
    monkeypatch.setenv("VIFLOW_CALIBRATION", "hall.json")
    assert load_settings().calibration == Path("hall.json")


def test_the_library_knows_the_names_that_only_the_service_takes() -> None:
    assert set(SERVICE_SETTINGS) == set(ServiceSettings.model_fields) - set(Settings.model_fields)


def test_an_unknown_variable_is_refused_with_the_closest_known_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIFLOW_MAX_CONCURENT", "2")
    with pytest.raises(ConfigError, match=r"found VIFLOW_MAX_CONCURENT; .* is VIFLOW_MAX_CONCURRENT$") as caught:
        load_settings()
    assert (caught.value.code, caught.value.field) == ("config_invalid", "max_concurent")


@pytest.mark.parametrize("name", ["VIFLOW_TRAINING__STEPS", "VIFLOW_REAL_DATA", "VIFLOW_ANOMALY_SERVICE_HOST"])
def test_variables_of_others_are_left_alone(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    before = load_settings()
    monkeypatch.setenv(name, "7")
    assert load_settings() == before


@pytest.mark.parametrize("name", ["VIFLOW_LIMITS__MAX_BYTES", "VIFLOW_LIMITS"])
def test_limits_of_the_command_line_are_refused(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv(name, "1000")
    with pytest.raises(
        ConfigError, match=f"VIFLOW_MAX_IMAGE_BYTES and VIFLOW_MAX_IMAGE_PIXELS, found {name}"
    ) as caught:
        load_settings()
    assert (caught.value.code, caught.value.field) == ("config_invalid", "limits")


def test_an_unknown_setting_is_refused() -> None:
    with pytest.raises(ConfigError, match="colour"):
        load_settings(colour="red")


def test_an_unreadable_section_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIFLOW_DETECTOR", "{")
    with pytest.raises(ConfigError) as caught:
        load_settings()
    assert caught.value.code == "config_invalid"
    assert "detector" in str(caught.value)


def test_cores_are_shared_out_among_the_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("viflow_anomaly_service.settings._usable_cores", lambda: 8)
    assert [ServiceSettings(workers=count).workers_at_once for count in (1, 2, 3, 16)] == [8, 4, 3, 1]
    assert ServiceSettings(workers=2, max_concurrent=5).workers_at_once == 5


def test_secrets_of_sinks_are_shown_nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIFLOW_WEBHOOK_URLS", "https://a.example/token1, https://b.example/token2")
    monkeypatch.setenv("VIFLOW_WEBHOOK_SECRET", "token3")
    monkeypatch.setenv("VIFLOW_MQTT_URL", "mqtt://user:token4@c.example")
    settings = load_settings()
    assert [one.get_secret_value() for one in settings.webhook_urls][1] == "https://b.example/token2"
    assert "token" not in settings.model_dump_json()
    assert "token" not in repr(settings)


def test_cameras_to_warm_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIFLOW_WARM_UP", "640x480, 1242x375@721.5")
    assert load_settings().warm_up == ((640, 480, None), (1242, 375, 721.5))
    monkeypatch.setenv("VIFLOW_WARM_UP", "")
    assert load_settings().warm_up == ()


def test_argument_over_environment_over_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIFLOW_MAX_QUEUED", "7")
    file_values = {"max_queued": 5, "queue_timeout_s": 2.5, "port": 9001, "warm_up": "64x64"}
    settings = load_settings(file_values, port=9002)
    assert (settings.max_queued, settings.queue_timeout_s, settings.port) == (7, 2.5, 9002)
    assert settings.warm_up == ((64, 64, None),)


@pytest.mark.parametrize("name", ["max_queue", "detector", "checkpoint"])
def test_the_table_of_the_file_holds_what_the_service_alone_takes(name: str) -> None:
    with pytest.raises(ConfigError, match=r"configuration file, \[service\]") as caught:
        load_settings({name: 1})
    assert (caught.value.code, caught.value.field) == ("config_invalid", f"service.{name}")


def test_a_wrong_value_of_the_file_is_refused_where_the_environment_hides_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIFLOW_MAX_QUEUED", "7")
    with pytest.raises(ConfigError, match=r"configuration file, \[service\].*max_queued"):
        load_settings({"max_queued": -1})


@pytest.mark.parametrize("name", ["store_url", "webhook_secret", "mqtt_url"])
@pytest.mark.parametrize("stars", ["***", "**********", "mqtt://user:***@broker:1883"])
def test_what_config_shows_in_place_of_a_secret_is_none(name: str, stars: str) -> None:
    with pytest.raises(ConfigError, match=f"{name}: .*expected the secret itself") as caught:
        load_settings({name: stars})
    assert caught.value.code == "config_invalid"
