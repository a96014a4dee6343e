"""Training from a checkpoint: its weights and model, what is refused, resuming, what the result says of it."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from simulated_truth import add_ground_truth
from worlds import REAL_DATA, make_world, write_plain

from viflow_anomaly.checkpoint import load_checkpoint, load_training_state, save_checkpoint
from viflow_anomaly.checkpoint_record import CheckpointRecord, bundled_checkpoint
from viflow_anomaly.cli.main import run
from viflow_anomaly.config import FINE_TUNING_DEFAULTS, ModelConfig, MotionWindowConfig, TrainingConfig, ViewConfig
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import CheckpointError, ConfigError
from viflow_anomaly.model.builder import build_model
from viflow_anomaly.settings import resolve_settings
from viflow_anomaly.training import TrainingRun, train
from viflow_anomaly.training_data import TrainingData, load_training_data
from viflow_anomaly.training_init import read_initial_weights

WINDOW = MotionWindowConfig(samples_before=2, samples_between=4)
MODEL = ModelConfig(preset="compact", hypotheses=4, view=ViewConfig(focal_px=80.0), motion_window=WINDOW)
TRAINING = TrainingConfig(steps=4, batch_size=2, learning_rate=3e-4, warmup_steps=2, checkpoint_every=1)
NOTHING_SET = ModelConfig()


class Killed(BaseException):
    """Stands for a signal: nothing may catch it."""


@pytest.fixture(autouse=True)
def no_tensorboard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_plain(tmp_path_factory.mktemp("recordings") / "monday", make_world(frames=4))


def checkpoint_at(path: Path, *, model: ModelConfig = MODEL, seed: int = 3) -> Path:
    return save_checkpoint(path, build_model(model, seed=seed), model, name="before", version="7")


@pytest.fixture
def init(tmp_path: Path) -> Path:
    return checkpoint_at(tmp_path / "before.safetensors")


def fit(data: Path, out: Path, **options: Any) -> Path:
    return train([data], out, **({"model": NOTHING_SET, "training": TRAINING, "progress": False} | options))


def same_weights(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(value, other[key]) for key, value in one.items())


def weights(path: Path) -> dict[str, torch.Tensor]:
    return load_checkpoint(path).model.state_dict()


def kill_at(monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    whole = TrainingRun.train_step

    def train_step(self: TrainingRun, data: TrainingData) -> tuple[float, torch.Tensor]:
        if self.step == step:
            raise Killed
        return whole(self, data)

    monkeypatch.setattr(TrainingRun, "train_step", train_step)


# --- what it starts from


@pytest.mark.parametrize("seed", [0, 1])
def test_step_0_has_the_checkpoints_weights_bit_for_bit(
    recording: Path, init: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    seen: list[dict[str, torch.Tensor]] = []

    def train_step(self: TrainingRun, data: TrainingData) -> tuple[float, torch.Tensor]:
        del data
        seen.append({key: value.clone() for key, value in self.network.state_dict().items()})
        raise Killed

    monkeypatch.setattr(TrainingRun, "train_step", train_step)
    with pytest.raises(Killed):
        fit(recording, tmp_path / "run", init=init, training=TRAINING.model_copy(update={"seed": seed}))
    assert same_weights(seen[0], weights(init))


def test_the_model_is_the_checkpoints(recording: Path, init: Path, tmp_path: Path) -> None:
    path = fit(recording, tmp_path / "run", init=init)
    assert load_checkpoint(path).record.model == MODEL
    assert not same_weights(weights(path), weights(init))


def test_the_bundled_model_can_be_started_from() -> None:
    initial = read_initial_weights(bundled_checkpoint(), NOTHING_SET)
    assert same_weights(dict(initial.weights), weights(bundled_checkpoint()))
    assert initial.origin["name"] == "viflow-calibrated"


def test_a_fitted_motor_stream_stays_the_checkpoints(recording: Path, tmp_path: Path) -> None:
    mean, deviation = (1.0, 2.0), (3.0, 4.0)
    motor = MODEL.motor.model_copy(update={"mean": mean, "deviation": deviation})
    model = MODEL.model_copy(update={"motion_inputs": "imu+motor", "motor": motor})
    init = checkpoint_at(tmp_path / "motor.safetensors", model=model)
    world = make_world(frames=4)
    data = write_plain(tmp_path / "commanded", world)
    lines = (data / "frames.csv").read_text().splitlines()
    numbered = [f"{line},{k},{k * 10}" for k, line in enumerate(lines[1:])]
    (data / "frames.csv").write_text("\n".join([lines[0] + ",motor_v,motor_w", *numbered]) + "\n")
    record = load_checkpoint(fit(data, tmp_path / "run", init=init)).record
    assert (record.model.motor.mean, record.model.motor.deviation) == (mean, deviation)


def test_training_improves_the_loss_of_its_own_recording_from_there(tmp_path: Path) -> None:
    data = write_plain(tmp_path / "own", make_world(frames=3, shift_px=4))
    other = write_plain(tmp_path / "other", make_world(frames=3, seed=5))
    first = train(
        [other], tmp_path / "first", model=MODEL, training=TRAINING.model_copy(update={"steps": 20}), progress=False
    )
    pairs = load_training_data([data], MODEL, (1,))

    def loss_of(path: Path) -> float:
        run = TrainingRun(model=MODEL, training=TRAINING, device="cpu", weights=weights(path))
        with torch.no_grad():
            batch = pairs.sample(seed=0, step=0, batch_size=8, device="cpu")
            output = run.network(batch.source, batch.motion, batch.interval_s, batch.motor)
            return float(run._loss(output, batch).loss)

    longer = TRAINING.model_copy(update={"steps": 40, "learning_rate": 1e-3, "look_aheads": (1,)})
    after = fit(data, tmp_path / "adapted", init=first, training=longer)
    assert loss_of(after) < 0.97 * loss_of(first)


def test_an_adapted_checkpoint_detects(recording: Path, tmp_path: Path) -> None:
    path = fit(
        recording, tmp_path / "run", init=bundled_checkpoint(), training=TRAINING.model_copy(update={"steps": 1})
    )
    detector = AnomalyDetector.from_checkpoint(path, runtime="torch")
    pair = RecordingPairs(open_recording(recording))[0]
    assert detector.detect(pair).model.sha256 == load_checkpoint(path).record.sha256


def test_an_adapted_checkpoint_can_be_exported(recording: Path, init: Path, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    path = fit(recording, tmp_path / "run", init=init)
    assert run(["export", "--checkpoint", str(path)]) == 0
    assert path.with_suffix(".onnx").exists()


# --- what is refused


@pytest.mark.parametrize(
    ("asked", "field"),
    [
        (ModelConfig(preset="paper"), "model.preset"),
        (ModelConfig(hypotheses=8), "model.hypotheses"),  # though it is the default: it was asked for
        (ModelConfig(view=ViewConfig(focal_px=100.0)), "model.view.focal_px"),
        (ModelConfig(preset="compact", motion_inputs="sffms"), "model.motion_inputs"),
    ],
)
def test_model_settings_that_contradict_the_checkpoint(
    init: Path, tmp_path: Path, asked: ModelConfig, field: str
) -> None:
    with pytest.raises(ConfigError, match=f"{field}: .*but the checkpoint has") as raised:
        fit(tmp_path / "never-read", tmp_path / "run", init=init, model=asked)
    assert (raised.value.code, raised.value.field) == ("init_model_differs", field)
    assert str(init) in raised.value.message
    assert not (tmp_path / "run").exists()


def test_model_settings_that_agree_are_taken(recording: Path, init: Path, tmp_path: Path) -> None:
    asked = ModelConfig(preset="compact", view=ViewConfig(focal_px=80.0))
    assert load_checkpoint(fit(recording, tmp_path / "run", init=init, model=asked)).record.model == MODEL


def test_every_contradiction_is_named(init: Path) -> None:
    asked = ModelConfig(preset="paper", motion_window=MotionWindowConfig(samples_before=2, samples_between=9))
    with pytest.raises(ConfigError) as raised:
        read_initial_weights(init, asked)
    assert "model.motion_window.samples_between: 9, but the checkpoint has 4" in raised.value.message
    assert "model.preset: 'paper', but the checkpoint has 'compact'" in raised.value.message
    assert "samples_before" not in raised.value.message


def _cut(init: Path) -> Path:
    init.write_bytes(init.read_bytes()[:-1])
    return init


def _without_record(init: Path) -> Path:
    init.with_suffix(".json").unlink()
    return init


def _with_other_tensors(init: Path) -> Path:
    """A whole file of another model, with its checksum: the record's configuration does not fit."""
    other = MODEL.model_copy(update={"hypotheses": 8})
    checkpoint_at(init, model=other)
    record = json.loads(init.with_suffix(".json").read_text())
    record["model"]["hypotheses"] = 4
    init.with_suffix(".json").write_text(json.dumps(record))
    return init


@pytest.mark.parametrize(
    ("harm", "code"),
    [
        (lambda init: init.with_name("absent.safetensors"), "checkpoint_missing"),
        (lambda init: init.with_name("weights.pt"), "checkpoint_not_safetensors"),
        (_without_record, "checkpoint_missing"),
        (_cut, "checkpoint_corrupt"),
        (_with_other_tensors, "checkpoint_corrupt"),
    ],
)
def test_a_checkpoint_that_cannot_be_started_from(init: Path, tmp_path: Path, harm: Any, code: str) -> None:
    with pytest.raises(CheckpointError) as raised:
        fit(tmp_path / "never-read", tmp_path / "run", init=harm(init))
    assert raised.value.code == code
    assert not (tmp_path / "run").exists()


# --- resume


def test_a_killed_and_resumed_run_gives_the_same_bytes(
    recording: Path, init: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = fit(recording, tmp_path / "whole", init=init)
    with monkeypatch.context() as patch:
        kill_at(patch, 2)
        with pytest.raises(Killed):
            fit(recording, tmp_path / "killed", init=init)
    resumed = fit(recording, tmp_path / "killed", init=init, resume=True)
    assert resumed.read_bytes() == whole.read_bytes()
    assert resumed.with_suffix(".json").read_bytes() == whole.with_suffix(".json").read_bytes()


def test_the_state_says_what_it_started_from(recording: Path, init: Path, tmp_path: Path) -> None:
    fit(recording, tmp_path / "run", init=init)
    state = load_training_state(tmp_path / "run")
    assert state is not None
    assert state[1]["init"] == load_checkpoint(init).record.sha256


@pytest.mark.parametrize("now", ["changed", "other", "none"])
def test_resume_from_another_checkpoint_is_refused(recording: Path, init: Path, tmp_path: Path, now: str) -> None:
    fit(recording, tmp_path / "run", init=init)
    before = (tmp_path / "run" / "state.safetensors").read_bytes()
    again = {
        "changed": lambda: checkpoint_at(init, seed=4),
        "other": lambda: checkpoint_at(tmp_path / "other.safetensors", seed=4),
        "none": lambda: None,
    }[now]()
    with pytest.raises(ConfigError, match="--resume expects the init that the run was started with") as raised:
        fit(recording, tmp_path / "run", init=again, resume=True, model=MODEL if again is None else NOTHING_SET)
    assert (raised.value.code, raised.value.field) == ("resume_config_differs", "init")
    assert (tmp_path / "run" / "state.safetensors").read_bytes() == before


def test_a_run_from_fresh_weights_does_not_go_on_from_a_checkpoint(recording: Path, init: Path, tmp_path: Path) -> None:
    fit(recording, tmp_path / "run", model=MODEL)
    with pytest.raises(ConfigError) as raised:
        fit(recording, tmp_path / "run", init=init, resume=True)
    assert (raised.value.code, raised.value.field) == ("resume_config_differs", "init")


def test_a_state_from_before_there_was_an_init_is_gone_on_from(recording: Path, tmp_path: Path) -> None:
    first = fit(recording, tmp_path / "run", model=MODEL).read_bytes()
    state = load_training_state(tmp_path / "run")
    assert state is not None
    assert state[1].pop("init") is None
    assert fit(recording, tmp_path / "run", model=MODEL, resume=True).read_bytes() == first


# --- what it says of itself


def test_the_provenance_names_the_checkpoint(recording: Path, init: Path, tmp_path: Path) -> None:
    record = load_checkpoint(fit(recording, tmp_path / "run", init=init)).record
    sha256 = load_checkpoint(init).record.sha256
    assert record.provenance["init"] == {"name": "before", "version": "7", "sha256": sha256}
    assert "init" not in load_checkpoint(fit(recording, tmp_path / "fresh", model=MODEL)).record.provenance


def test_validation_is_measured_before_the_first_step_too(recording: Path, init: Path, tmp_path: Path) -> None:
    held_out = add_ground_truth(tmp_path / "drone_000001", make_world(frames=3))

    def measured(out: Path) -> list[dict[str, Any]]:
        rows = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
        return [row for row in rows if "epe_px" in row]

    with_it = fit(recording, tmp_path / "run", init=init, validation=[held_out])
    assert [row["step"] for row in measured(tmp_path / "run")] == [0, 4]
    fit(recording, tmp_path / "run", init=init, validation=[held_out], resume=True)
    assert [row["step"] for row in measured(tmp_path / "run")] == [0, 4]
    fit(recording, tmp_path / "fresh", model=MODEL, validation=[held_out])
    assert [row["step"] for row in measured(tmp_path / "fresh")] == [4]
    assert with_it.read_bytes() == fit(recording, tmp_path / "without", init=init).read_bytes()


# --- the command line


def provenance(path: Path) -> dict[str, Any]:
    values = json.loads(path.with_suffix(".json").read_text())
    return CheckpointRecord.from_mapping(values, where=str(path)).provenance


def test_the_command_takes_the_fine_tuning_defaults_where_nothing_is_set(
    recording: Path, init: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["train", str(recording), "--init", str(init), "--out", str(tmp_path / "run"), "--steps", "1"]
    assert run([*arguments, "--batch-size", "2", "--set", "training.warmup_steps=1"]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'run' / 'model.safetensors'}\n"
    training = provenance(tmp_path / "run" / "model.safetensors")["training"]
    assert training["learning_rate"] == FINE_TUNING_DEFAULTS["learning_rate"]
    assert (training["steps"], training["warmup_steps"]) == (1, 1)


def test_default_is_the_bundled_model(recording: Path, tmp_path: Path) -> None:
    arguments = ["train", str(recording), "--init", "default", "--out", str(tmp_path / "run"), "--steps", "1"]
    assert run([*arguments, "--batch-size", "1"]) == 0
    bundled = load_checkpoint().record
    origin = provenance(tmp_path / "run" / "model.safetensors")["init"]
    assert origin == {"name": bundled.name, "version": bundled.version, "sha256": bundled.sha256}


def test_the_command_refuses_a_contradiction(
    recording: Path, init: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["train", str(recording), "--init", str(init), "--out", str(tmp_path / "run")]
    assert run([*arguments, "--set", "model.hypotheses=8"]) == 2
    assert "model.hypotheses: 8, but the checkpoint has 4" in " ".join(capsys.readouterr().err.split())


def test_defaults_are_below_every_other_layer(tmp_path: Path) -> None:
    file = tmp_path / "settings.toml"
    file.write_text("[training]\nwarmup_steps = 7\n")
    settings = resolve_settings(
        config_file=file,
        environment={"VIFLOW_TRAINING__LEARNING_RATE": "0.5"},
        options={"training.steps": None},
        defaults={f"training.{key}": value for key, value in FINE_TUNING_DEFAULTS.items()},
    )
    assert settings.training.warmup_steps == 7
    assert settings.training.learning_rate == 0.5
    assert settings.training.steps == FINE_TUNING_DEFAULTS["steps"]
    assert settings.training.batch_size == TrainingConfig().batch_size


def test_a_real_flight_without_labels_is_adapted_to(tmp_path: Path) -> None:
    flight = REAL_DATA / "euroc" / "V1_01_easy"
    if not flight.is_dir():
        pytest.skip(f"no real data at {flight}; set VIFLOW_REAL_DATA to the folder that holds it")
    short = TRAINING.model_copy(update={"steps": 1, "look_aheads": (1,)})
    record = load_checkpoint(fit(flight, tmp_path / "run", init=bundled_checkpoint(), training=short)).record
    assert record.provenance["data"] == {"recordings": 1, "names": ["V1_01_easy"], "pairs": 59, "excluded": {}}
