from __future__ import annotations

import json
from pathlib import Path

import pytest

from viflow_anomaly.errors import ConfigError
from viflow_anomaly.settings import Settings, read_config_file, resolve_settings

THRESHOLD = "detector.regions.threshold_mads"


def threshold(settings: Settings) -> float:
    return settings.detector.regions.threshold_mads


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def toml(tmp_path: Path) -> Path:
    return write(tmp_path / "settings.toml", "threads = 2\n[detector.regions]\nthreshold_mads = 7\nmax_regions = 9\n")


def test_defaults_where_nothing_is_said() -> None:
    assert resolve_settings(environment={}) == Settings()


def test_each_layer_wins_over_the_one_below(toml: Path) -> None:
    environment = {"VIFLOW_DETECTOR__REGIONS__THRESHOLD_MADS": "8"}
    assignments = [f"{THRESHOLD}=9"]
    assert threshold(resolve_settings(environment={})) == 6
    assert threshold(resolve_settings(config_file=toml, environment={})) == 7
    assert threshold(resolve_settings(config_file=toml, environment=environment)) == 8
    assert threshold(resolve_settings(config_file=toml, environment=environment, assignments=assignments)) == 9
    options = {THRESHOLD: 10}
    settings = resolve_settings(config_file=toml, environment=environment, assignments=assignments, options=options)
    assert threshold(settings) == 10
    assert settings.detector.regions.max_regions == 9
    assert settings.threads == 2


def test_an_option_that_was_not_given_hides_nothing(toml: Path) -> None:
    assert threshold(resolve_settings(config_file=toml, environment={}, options={THRESHOLD: None})) == 7


def test_json_file_says_the_same_as_toml(tmp_path: Path, toml: Path) -> None:
    values = {"threads": 2, "detector": {"regions": {"threshold_mads": 7, "max_regions": 9}}}
    path = write(tmp_path / "settings.json", json.dumps(values))
    assert resolve_settings(config_file=path, environment={}) == resolve_settings(config_file=toml, environment={})


def test_resolved_settings_are_a_configuration_file(tmp_path: Path, toml: Path) -> None:
    settings = resolve_settings(config_file=toml, environment={})
    path = write(tmp_path / "again.json", settings.model_dump_json())
    assert resolve_settings(config_file=path, environment={}) == settings


def test_environment_takes_json_values_and_plain_text() -> None:
    settings = resolve_settings(
        environment={
            "VIFLOW_TRAINING__LOOK_AHEADS": "[1, 3]",
            "VIFLOW_MODEL__HYPOTHESES": "4",
            "VIFLOW_DETECTOR__INCLUDE_MASKS": "true",
            "VIFLOW_MODEL__PRESET": "paper",
            "VIFLOW_CHECKPOINT": "runs/first",
        }
    )
    assert settings.training.look_aheads == (1, 3)
    assert settings.model.hypotheses == 4
    assert settings.detector.include_masks is True
    assert settings.model.preset == "paper"
    assert settings.checkpoint == Path("runs/first")


@pytest.mark.parametrize(
    "name",
    [
        "VIFLOW_REAL_DATA",
        "VIFLOW_PORT",
        "VIFLOW_MAX_IMAGE_BYTES",
        "PATH",
        "OTHER_DETECTOR__REGIONS",
        "VIFLOW",
        "VIFLOW_ANOMALY_SERVICE_HOST",
        "VIFLOW_ANOMALY_SERVICE_PORT_HTTP",
        "VIFLOW_ANOMALY_PORT",
        "VIFLOW_ANOMALY_PORT_8000_TCP_ADDR",
        "VIFLOW_ANOMALY_CANARY_SERVICE_HOST",
    ],
)
def test_variables_of_others_are_left_alone(name: str) -> None:
    assert resolve_settings(environment={name: "x"}) == Settings()


@pytest.mark.parametrize(
    ("name", "closest"),
    [
        ("VIFLOW_THREDS", "VIFLOW_THREADS"),
        ("VIFLOW_PROT", "VIFLOW_PORT"),
        ("VIFLOW_MAX_IMAGE_BYTE", "VIFLOW_MAX_IMAGE_BYTES"),
        ("VIFLOW_DETECTR__REGIONS__MAX_REGIONS", "VIFLOW_DETECTOR__REGIONS__MAX_REGIONS"),
        ("VIFLOW_DETECTOR_REGIONS_MAX_REGIONS", "VIFLOW_DETECTOR__REGIONS__MAX_REGIONS"),
        ("VIFLOW_DETECTOR__REGIONS__MAX_REGION", "VIFLOW_DETECTOR__REGIONS__MAX_REGIONS"),
        ("VIFLOW_PORT__TCP", "VIFLOW_PORT"),
        ("VIFLOW_", "VIFLOW_PORT"),
    ],
)
def test_an_unknown_variable_is_refused_with_the_closest_known_one(name: str, closest: str) -> None:
    with pytest.raises(
        ConfigError, match=f"environment: .* found {name}; the closest known one is {closest}$"
    ) as caught:
        resolve_settings(environment={name: "1", "VIFLOW_THREADS": "2"})
    assert caught.value.code == "config_invalid"
    assert caught.value.field == name.removeprefix("VIFLOW_").lower().replace("__", ".")


def test_a_section_may_be_one_json_variable() -> None:
    settings = resolve_settings(environment={"VIFLOW_DETECTOR__REGIONS": '{"max_regions": 5}'})
    assert settings.detector.regions.max_regions == 5


@pytest.mark.parametrize(
    ("layer", "where"),
    [
        ({"environment": {"VIFLOW_DETECTOR__REGIONS": '{"typo": 1}'}}, "environment"),
        ({"environment": {}, "assignments": ["detector.regions.typo=1"]}, "--set"),
        ({"environment": {}, "options": {"detector.regions.typo": 1}}, "command line"),
    ],
)
def test_an_unknown_key_is_refused_with_its_layer(layer: dict[str, object], where: str) -> None:
    with pytest.raises(ConfigError, match=f"^{where}: detector.regions.typo: there is no such field") as caught:
        resolve_settings(**layer)  # type: ignore[arg-type]
    assert caught.value.code == "config_invalid"
    assert caught.value.field == "detector.regions.typo"


def test_a_wrong_value_is_refused_even_where_a_higher_layer_hides_it(tmp_path: Path) -> None:
    path = write(tmp_path / "settings.toml", "[detector.regions]\nthreshold_mads = -1\n")
    with pytest.raises(ConfigError, match=r"settings.toml: detector.regions.*greater than 0, found -1"):
        resolve_settings(config_file=path, environment={}, assignments=[f"{THRESHOLD}=5"])


@pytest.mark.parametrize("text", ["NaN", "Infinity", '"high"', "null"])
def test_values_that_are_no_finite_number_are_refused(text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        resolve_settings(environment={}, assignments=[f"{THRESHOLD}={text}"])
    assert caught.value.field == THRESHOLD


@pytest.mark.parametrize("assignment", ["detector", "=1", "detector..regions=1", ""])
def test_an_assignment_needs_a_key_and_a_value(assignment: str) -> None:
    with pytest.raises(ConfigError, match=r"--set: expected section.key=value") as caught:
        resolve_settings(environment={}, assignments=[assignment])
    assert caught.value.code == "assignment_invalid"


def test_a_section_cannot_be_replaced_by_a_number() -> None:
    with pytest.raises(ConfigError, match="detector") as caught:
        resolve_settings(environment={}, assignments=["detector=1"])
    assert caught.value.code == "config_invalid"


@pytest.mark.parametrize("name", ["settings.yaml", "settings"])
def test_a_file_of_another_kind_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match=r"ending in \.toml or \.json") as caught:
        read_config_file(write(tmp_path / name, ""))
    assert caught.value.code == "config_format_unknown"


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.toml", b"x ="), ("a.json", b"{"), ("b.toml", b"\xff\xfe"), ("c.json", b"[1]"), ("d.json", b"")],
)
def test_a_file_that_holds_no_table_is_refused(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=f"{name}: expected a ") as caught:
        read_config_file(path)
    assert caught.value.code == "config_unreadable"


def test_a_missing_file_and_a_directory_are_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.toml").mkdir()
    for name, reason in (("missing.toml", "No such file"), ("folder.toml", "Is a directory")):
        with pytest.raises(ConfigError, match=f"{name}: expected a readable .*{reason}") as caught:
            read_config_file(tmp_path / name)
        assert caught.value.code == "config_unreadable"


@pytest.mark.parametrize("path", ["a\0b.safetensors", "a\ud800b.safetensors"])
def test_a_text_that_is_no_path_is_refused(path: str) -> None:
    with pytest.raises(ConfigError, match=r"checkpoint: .*expected a path") as caught:
        resolve_settings(environment={}, options={"checkpoint": path})
    assert caught.value.code == "config_invalid"
