from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from pair_world import Ask, PairFolder

from viflow_anomaly.cli import main as cli_main
from viflow_anomaly.cli.configuration import masked
from viflow_anomaly.cli.progress import stderr_progress
from viflow_anomaly.detection import load_detection_schema
from viflow_anomaly.errors import CheckpointError

COMMANDS = ("detect", "batch", "benchmark", "calibrate", "simulate", "train", "serve", "schema", "config", "keys new")
HEAVY = {"torch", "cv2", "skimage", "mujoco", "fastapi"}


def python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env={**os.environ, **environment}
    )


def test_help_loads_nothing_heavy() -> None:
    asked = [["--help"], ["--version"], ["schema"], *([*command.split(), "--help"] for command in COMMANDS)]
    code = f"""
import sys
from viflow_anomaly.cli.main import run
codes = [run(arguments) for arguments in {asked!r}]
print("loaded:", codes, sorted({HEAVY!r} & set(sys.modules)))
"""
    done = python(code)
    assert done.stdout.splitlines()[-1] == f"loaded: {[0] * len(asked)} []"


def test_settings_load_neither_simulator_nor_images() -> None:
    """What every command pays for."""
    code = """
import sys
import viflow_anomaly.settings
print(sorted({"cv2", "scipy", "skimage", "viflow_anomaly.simulator.run", "viflow_anomaly.datasets"} & set(sys.modules)))
"""
    assert python(code).stdout == "[]\n"


def test_a_threshold_is_applied_without_scipy() -> None:
    code = "import sys, viflow_anomaly.alarm_budget; print('scipy.special' in sys.modules)"
    assert python(code).stdout == "False\n"


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_an_example(ask: Ask, command: str) -> None:
    answer = ask([*command.split(), "--help"])
    assert answer.code == 0
    assert "Example" in answer.out
    assert answer.out.count(f"viflow-anomaly {command}") >= 2


def test_help_names_every_command(ask: Ask) -> None:
    answer = ask(["--help"])
    assert all(f" {command.split()[0]} " in answer.out for command in COMMANDS)
    assert "Exit codes: 0 done" in answer.out


def test_version(ask: Ask) -> None:
    answer = ask(["--version"])
    assert (answer.code, answer.out) == (0, f"viflow-anomaly {version('viflow-anomaly')}\n")


def test_the_installed_command_answers() -> None:
    command = Path(sys.executable).with_name("viflow-anomaly")
    done = subprocess.run([command, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("viflow-anomaly ")


def test_unknown_command(ask: Ask) -> None:
    assert ask(["bach"]).is_refusal("No such command 'bach'")


def test_schema_is_the_shipped_one(ask: Ask) -> None:
    answer = ask(["schema"])
    assert json.loads(answer.out) == load_detection_schema()


def test_config_prints_what_resolves_here(ask: Ask, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIFLOW_TRAINING__STEPS", "7")
    settings = json.loads(ask(["config", "--set", "model.preset=paper"]).out)
    assert settings["training"]["steps"] == 7
    assert settings["model"]["preset"] == "paper"
    assert settings["simulator"]["rig"] == "drone"


@pytest.mark.parametrize("command", ["config", "serve"])
def test_a_misspelt_variable_is_refused(ask: Ask, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    monkeypatch.setenv("VIFLOW_TRAINING__STEP", "7")
    assert ask([command]).is_refusal("found VIFLOW_TRAINING__STEP; the closest known one is VIFLOW_TRAINING__STEPS")


def test_config_shows_the_service_and_where_values_come_from(
    ask: Ask, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("VIFLOW_PORT", "9001")
    monkeypatch.setenv("VIFLOW_DETECTOR__REGIONS__MAX_REGIONS", "8")
    file = tmp_path / "settings.toml"
    file.write_text("threads = 2\n[detector.regions]\nmax_regions = 3\n[service]\nport = 1\nmax_queued = 5\n")
    arguments = ["config", "--config", str(file), "--set", "threads=3"]
    service = json.loads(ask(arguments).out)["service"]
    assert (service["port"], service["max_queued"], service["host"]) == (9001, 5, "127.0.0.1")
    assert json.loads(ask([*arguments, "--origins"]).out) == {
        "detector.regions.max_regions": {"value": 8, "from": "environment"},
        "service.max_queued": {"value": 5, "from": str(file)},
        "service.port": {"value": 9001, "from": "environment"},
        "threads": {"value": 3, "from": "--set"},
    }


def test_config_takes_the_limits_of_the_other_commands(ask: Ask, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIFLOW_LIMITS__MAX_BYTES", "5000")
    assert json.loads(ask(["config"]).out)["limits"]["max_bytes"] == 5000


def test_what_is_secret_is_masked() -> None:
    assert masked(
        {
            "password": "x",
            "smtp_token": 7,
            "no_password": None,
            "key_file": "keys.txt",
            "database": "postgresql://viflow:gehe:im@db:5432/x",
            "dsn": "host=db password=geheim user=u",
            "plain": "http://me@host/a:b",
            "list": ["mqtt://a:geheim@h", 1],
        }
    ) == {
        "password": "***",
        "smtp_token": "***",
        "no_password": None,
        "key_file": "keys.txt",
        "database": "postgresql://viflow:***@db:5432/x",
        "dsn": "host=db password=*** user=u",
        "plain": "http://me@host/a:b",
        "list": ["mqtt://a:***@h", 1],
    }


def test_config_refuses_unknown_keys(ask: Ask) -> None:
    assert ask(["config", "--set", "model.layers=3"]).is_refusal("--set: model.layers: there is no such field")


# --- errors


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (CheckpointError("a\nbroken  file", code="checkpoint_truncated"), "a broken file [checkpoint_truncated]"),
        (FileNotFoundError(2, "No such file or directory", "x.png"), "x.png: No such file or directory"),
        (PermissionError(13, "Permission denied", "x.png"), "x.png: Permission denied"),
        (OSError(28, "No space left on device"), "No space left on device"),
        (OSError("something else"), "something else"),
    ],
)
def test_errors_become_one_line_and_exit_code_2(
    ask: Ask, pair: PairFolder, monkeypatch: pytest.MonkeyPatch, error: Exception, line: str
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("viflow_anomaly.cli.detect.load_detector", fail)
    answer = ask(pair.arguments())
    assert (answer.code, answer.out, answer.err) == (2, "", f"error: {line}\n")


def test_interrupt_gives_130(ask: Ask, pair: PairFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("viflow_anomaly.cli.detect.load_detector", interrupt)
    answer = ask(pair.arguments())
    assert (answer.code, answer.out, answer.err) == (130, "", "")


def test_a_reader_that_goes_away_is_no_error() -> None:
    command = Path(sys.executable).with_name("viflow-anomaly")
    done = subprocess.run(
        ["bash", "-c", f"{command} schema | true; exit ${{PIPESTATUS[0]}}"], capture_output=True, text=True, check=False
    )
    assert done.stderr == ""


def test_main_keeps_idle_threads_from_spinning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["viflow-anomaly", "--version"])
    names = ("OMP_WAIT_POLICY", "OPENBLAS_NUM_THREADS")
    for before, after in (((None, None), ("PASSIVE", "1")), (("ACTIVE", "2"), ("ACTIVE", "2"))):
        for name, value in zip(names, before, strict=True):
            monkeypatch.setenv(name, value or "")
            if value is None:
                monkeypatch.delenv(name)
        with pytest.raises(SystemExit) as ended:
            cli_main.main()
        assert ended.value.code == 0
        assert tuple(os.environ[name] for name in names) == after


def test_the_console_script_begins_before_numpy_is_imported() -> None:
    asked = "import sys, viflow_anomaly.cli.main, viflow_anomaly_service.server; print('numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_progress_is_silent_where_nobody_watches(capsys: pytest.CaptureFixture[str]) -> None:
    with stderr_progress() as progress:
        progress.update(progress.add_task("pairs", total=2), completed=1)
    assert capsys.readouterr() == ("", "")


# --- commands that hand over to other parts


def stand_in(monkeypatch: pytest.MonkeyPatch, name: str, **functions: Any) -> None:
    """A module of another part, with functions of ours."""
    module = ModuleType(name)
    vars(module).update(functions)
    monkeypatch.setitem(sys.modules, name, module)


def test_simulate_hands_its_settings_over(ask: Ask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def simulate(config: Any, out: Path, *, on_progress: Any) -> list[Path]:
        asked.append(config)
        on_progress(1, 2)
        return [out / "car_000007"]

    monkeypatch.setattr("viflow_anomaly.simulator.run.simulate", simulate)
    what = ["--rig", "car", "--sequences", "2", "--frames", "9", "--seed", "7", "--jobs", "1"]
    answer = ask(["simulate", *what, "--out", str(tmp_path), "--set", "simulator.ground_truth=false"])
    assert (answer.code, answer.out, answer.err) == (0, f"{tmp_path / 'car_000007'}\n", "")
    config = asked[0]
    assert (config.rig, config.sequences, config.frames, config.seed) == ("car", 2, 9, 7)
    assert config.ground_truth is False


def test_simulate_refuses_bad_settings(ask: Ask, tmp_path: Path) -> None:
    assert ask(["simulate", "--rig", "boat", "--out", str(tmp_path)]).is_refusal("Invalid value for '--rig'")
    assert ask(["simulate", "--frames", "1", "--out", str(tmp_path)]).is_refusal("Invalid value for '--frames'")
    answer = ask(["simulate", "--out", str(tmp_path), "--set", "simulator.movers=[3,1]"])
    assert answer.is_refusal("movers: expected 0 <= least <= most <= 8")


def test_train_hands_its_settings_over(ask: Ask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, Any] = {}

    def train(data: list[Path], out: Path, **options: Any) -> Path:
        asked.update(options, data=data)
        return out / "final"

    stand_in(monkeypatch, "viflow_anomaly.training", train=train)
    how = ["--steps", "5", "--batch-size", "2", "--seed", "3", "--threads", "2", "--set", "model.hypotheses=4"]
    answer = ask(["train", "a", "b", "--validation", "c", "--out", str(tmp_path), "--resume", *how])
    assert (answer.code, answer.out) == (0, f"{tmp_path / 'final'}\n")
    assert (asked["data"], asked["validation"]) == ([Path("a"), Path("b")], [Path("c")])
    training = asked["training"]
    assert (training.steps, training.batch_size, training.seed, training.threads) == (5, 2, 3, 2)
    assert asked["model"].hypotheses == 4
    assert (asked["resume"], asked["device"], asked["progress"]) == (True, "cpu", False)


def test_serve_hands_its_settings_over(ask: Ask, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    stand_in(monkeypatch, "viflow_anomaly_service.server", run=asked.append)
    answer = ask(
        ["serve", "--port", "0", "--host", "127.0.0.2", "--threads", "2", "--set", "detector.include_masks=true"]
    )
    assert (answer.code, answer.err) == (0, "")
    settings = asked[0]
    assert (settings.host, settings.port, settings.threads) == ("127.0.0.2", 0, 2)
    assert settings.detector.include_masks is True


@pytest.mark.parametrize(
    ("name", "variable"), [("max_bytes", "VIFLOW_MAX_IMAGE_BYTES"), ("max_pixels", "VIFLOW_MAX_IMAGE_PIXELS")]
)
def test_serve_refuses_limits_that_would_have_no_effect(
    ask: Ask, monkeypatch: pytest.MonkeyPatch, name: str, variable: str
) -> None:
    stand_in(monkeypatch, "viflow_anomaly_service.server", run=lambda settings: None)
    answer = ask(["serve", "--set", f"limits.{name}=5000"])
    assert answer.is_refusal(f"limits.{name}: expected the default")
    assert f"found 5000; set {variable} [config_invalid]" in answer.err


def test_serve_takes_the_printed_configuration(ask: Ask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    stand_in(monkeypatch, "viflow_anomaly_service.server", run=asked.append)
    (tmp_path / "settings.json").write_text(ask(["config", "--set", "threads=3"]).out)
    assert ask(["serve", "--config", str(tmp_path / "settings.json")]).code == 0
    assert asked[0].threads == 3


def test_serve_hands_the_runtime_over(ask: Ask, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    stand_in(monkeypatch, "viflow_anomaly_service.server", run=asked.append)
    assert ask(["serve", "--set", "runtime=torch"]).code == 0
    assert asked[0].runtime == "torch"


def test_serve_hands_the_evidence_head_over(ask: Ask, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    stand_in(monkeypatch, "viflow_anomaly_service.server", run=asked.append)
    assert ask(["serve", "--set", "evidence_head=head.safetensors", "--set", "precision=f32"]).code == 0
    assert (asked[0].evidence_head, asked[0].precision) == (Path("head.safetensors"), "f32")


def test_serve_hands_the_calibration_over(ask: Ask, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    stand_in(monkeypatch, "viflow_anomaly_service.server", run=asked.append)
    assert ask(["serve", "--calibration", "hall.json"]).code == 0
    assert asked[0].calibration == Path("hall.json")


def test_serve_refuses_bad_settings(ask: Ask, monkeypatch: pytest.MonkeyPatch) -> None:
    assert ask(["serve", "--port", "70000"]).is_refusal("Invalid value for '--port'")
    monkeypatch.setenv("VIFLOW_MAX_CONCURRENT", "0")
    assert ask(["serve"]).is_refusal("[config_invalid]")


def test_serve_takes_its_own_table_of_the_file(ask: Ask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    stand_in(monkeypatch, "viflow_anomaly_service.server", run=asked.append)
    file = tmp_path / "service.toml"
    file.write_text('threads = 2\n[service]\nworkers = 3\nmax_queued = 9\nwarm_up = "64x48"\n')
    assert ask(["serve", "--config", str(file), "--workers", "4"]).code == 0
    settings = asked[0]
    assert (settings.threads, settings.workers, settings.max_queued, settings.warm_up) == (2, 4, 9, ((64, 48, None),))
    assert ask(["config", "--config", str(file)]).code == 0
    file.write_text("[service]\nmax_queue = 9\n")
    assert ask(["serve", "--config", str(file)]).is_refusal("configuration file, [service]: expected host")
    file.write_text("service = 9\n")
    assert ask(["serve", "--config", str(file)]).is_refusal("expected a table [service], found int")


# --- keys


def test_keys_new_prints_the_line_and_shows_the_key_once(ask: Ask, tmp_path: Path) -> None:
    from viflow_anomaly_service.api_keys import KeyRing  # noqa: PLC0415

    answer = ask(["keys", "new", "--scope", "detect", "--scope", "read", "--name", "drone7"])
    assert answer.code == 0
    (tmp_path / "keys.txt").write_text(answer.out)
    (shown,) = (word for word in answer.err.split() if word.startswith("vfa_drone7_"))
    assert shown not in answer.out
    found = KeyRing(tmp_path / "keys.txt").find(shown)
    assert found is not None
    assert found.scopes == {"detect", "read"}


def test_keys_new_speaks_json_and_makes_names(ask: Ask) -> None:
    made = [json.loads(ask(["keys", "new", "--scope", "read", "--json"]).out) for _ in range(2)]
    assert made[0]["line"].split()[0] != made[1]["line"].split()[0]
    assert made[0]["key"].startswith(f"vfa_{made[0]['line'].split()[0]}_")


def test_keys_new_refuses_an_unknown_scope(ask: Ask) -> None:
    assert ask(["keys", "new", "--scope", "write"]).is_refusal("expected one or more of detect, read, admin")
    assert ask(["keys", "new", "--scope", "read", "--name", "A B"]).is_refusal("[key_name_invalid]")


def test_serve_hands_keys_over(ask: Ask, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    stand_in(monkeypatch, "viflow_anomaly_service.server", run=asked.append)
    assert ask(["serve", "--key-file", "keys.txt"]).code == 0
    assert ask(["serve", "--insecure-no-keys"]).code == 0
    assert [(settings.key_file, settings.insecure_no_keys) for settings in asked] == [
        (Path("keys.txt"), False),
        (None, True),
    ]


def test_serve_explains_why_it_does_not_start_without_keys(ask: Ask) -> None:
    answer = ask(["serve", "--host", "0.0.0.0", "--port", "0"])  # noqa: S104
    assert answer.is_refusal("viflow-anomaly keys new --scope detect")
