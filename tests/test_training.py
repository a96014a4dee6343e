"""Training in small: exact resume, refusals, what is written. Two views of 64 x 96, batches of two."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from simulated_truth import add_ground_truth
from worlds import make_world, write_euroc, write_plain

from viflow_anomaly import training as training_module
from viflow_anomaly import training_progress
from viflow_anomaly.checkpoint import load_checkpoint, load_training_state, save_training_state
from viflow_anomaly.config import ModelConfig, MotionWindowConfig, TrainingConfig, ViewConfig
from viflow_anomaly.errors import CheckpointError, ConfigError, DatasetError
from viflow_anomaly.training import TrainingRun, train
from viflow_anomaly.training_data import TrainingData, load_training_data
from viflow_anomaly.training_state import learning_rate

WINDOW = MotionWindowConfig(samples_before=2, samples_between=4)
MODEL = ModelConfig(preset="compact", hypotheses=4, view=ViewConfig(focal_px=80.0), motion_window=WINDOW)
MEASURES = {"epe_px", "predicted_epe_px", "identity_epe_px", "epe_ratio", "predicted_epe_ratio"}
TRAINING = TrainingConfig(steps=6, batch_size=2, warmup_steps=2, checkpoint_every=1, validate_every=3)
STATE = "state.safetensors"


class Killed(BaseException):
    """Stands for a signal: nothing may catch it."""


@pytest.fixture(autouse=True)
def no_tensorboard(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes seconds to load; the test that wants it asks for it."""
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("recordings")
    return [
        write_plain(folder / "plain", make_world(frames=4)),
        write_euroc(folder / "euroc", make_world(frames=4, seed=1, shift_px=3)),
    ]


@pytest.fixture
def measured(tmp_path: Path) -> Path:
    return add_ground_truth(tmp_path / "drone_000001", make_world(frames=3))


def fit(
    data: list[Path],
    out: Path,
    *,
    model: ModelConfig = MODEL,
    training: TrainingConfig = TRAINING,
    **options: Any,
) -> Path:
    return train(data, out, model=model, training=training, **({"progress": False} | options))


def changed(config: TrainingConfig, **changes: object) -> TrainingConfig:
    return config.model_copy(update=changes)


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def logged(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]


def kill_at(monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    whole = TrainingRun.train_step

    def train_step(self: TrainingRun, data: TrainingData) -> tuple[float, torch.Tensor]:
        if self.step == step:
            raise Killed
        return whole(self, data)

    monkeypatch.setattr(TrainingRun, "train_step", train_step)


# --- resume


@pytest.mark.parametrize(("preset", "hypotheses"), [("compact", 1), ("compact", 4), ("calibrated", 4)])
def test_a_killed_and_resumed_run_gives_the_same_bytes(
    recordings: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, preset: str, hypotheses: int
) -> None:
    model = MODEL.model_copy(update={"preset": preset, "hypotheses": hypotheses})
    whole = fit(recordings, tmp_path / "whole", model=model)
    with monkeypatch.context() as patch:
        kill_at(patch, 3)
        with pytest.raises(Killed):
            fit(recordings, tmp_path / "killed", model=model)
    assert not (tmp_path / "killed" / "model.safetensors").exists()
    resumed = fit(recordings, tmp_path / "killed", model=model, resume=True)
    assert digest(resumed) == digest(whole)
    assert digest(tmp_path / "killed" / STATE) == digest(tmp_path / "whole" / STATE)
    assert resumed.with_suffix(".json").read_bytes() == whole.with_suffix(".json").read_bytes()


def test_steps_after_the_last_state_are_taken_again(
    recordings: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training_progress, "LOG_EVERY", 1)
    training = changed(TRAINING, checkpoint_every=2)
    whole = fit(recordings, tmp_path / "whole", training=training)
    with monkeypatch.context() as patch:
        kill_at(patch, 3)
        with pytest.raises(Killed):
            fit(recordings, tmp_path / "killed", training=training)
    with (tmp_path / "killed" / "metrics.jsonl").open("a") as file:
        file.write('{"step": 1, "lo')
    assert digest(fit(recordings, tmp_path / "killed", training=training, resume=True)) == digest(whole)
    assert [row["step"] for row in logged(tmp_path / "killed")] == [1, 2, 3, 4, 5, 6]
    assert logged(tmp_path / "killed") == logged(tmp_path / "whole")


KILLED_BETWEEN_STEPS = """
whole = TrainingRun.train_step
def train_step(self, data):
    if self.step == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return whole(self, data)
TrainingRun.train_step = train_step
"""
KILLED_WHILE_WRITING = """
whole = Path.write_bytes
writes = []
def write_bytes(self, data):
    writes.append(self)
    if len(writes) == 4:
        whole(self, data[: len(data) // 2])
        os.kill(os.getpid(), signal.SIGKILL)
    return whole(self, data)
Path.write_bytes = write_bytes
"""


@pytest.mark.parametrize("how", [KILLED_BETWEEN_STEPS, KILLED_WHILE_WRITING], ids=["between steps", "while writing"])
def test_a_process_that_was_killed_for_good(recordings: list[Path], tmp_path: Path, how: str) -> None:
    code = f"""
import os, signal, sys
from pathlib import Path
sys.modules["torch.utils.tensorboard"] = None
from viflow_anomaly.config import ModelConfig, TrainingConfig
from viflow_anomaly.training import TrainingRun, train
{how}
train(
    [Path(name) for name in {[str(path) for path in recordings]!r}],
    Path({str(tmp_path / "killed")!r}),
    model=ModelConfig.model_validate_json({MODEL.model_dump_json()!r}),
    training=TrainingConfig.model_validate_json({TRAINING.model_dump_json()!r}),
    progress=False,
)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=os.environ)
    assert done.returncode == -signal.SIGKILL, done.stderr
    state = load_training_state(tmp_path / "killed")
    assert state is not None
    assert state[1]["step"] == 3
    resumed = fit(recordings, tmp_path / "killed", resume=True)
    assert digest(resumed) == digest(fit(recordings, tmp_path / "whole"))


def test_a_finished_run_resumes_to_the_same_bytes(recordings: list[Path], tmp_path: Path) -> None:
    first = digest(fit(recordings, tmp_path / "run"))
    assert digest(fit(recordings, tmp_path / "run", resume=True)) == first


def test_resume_without_a_state_starts_anew(recordings: list[Path], tmp_path: Path) -> None:
    resumed = fit(recordings, tmp_path / "a", training=changed(TRAINING, steps=2), resume=True)
    assert digest(resumed) == digest(fit(recordings, tmp_path / "b", training=changed(TRAINING, steps=2)))


@pytest.mark.parametrize("section", ["model", "training"])
def test_resume_with_another_configuration_is_refused(recordings: list[Path], tmp_path: Path, section: str) -> None:
    fit(recordings, tmp_path, training=changed(TRAINING, steps=1))
    model = MODEL.model_copy(update={"hypotheses": 1}) if section == "model" else MODEL
    steps = 2 if section == "training" else 1
    with pytest.raises(ConfigError, match=f"--resume expects the {section}") as raised:
        fit(recordings, tmp_path, model=model, training=changed(TRAINING, steps=steps), resume=True)
    assert (raised.value.code, raised.value.field) == ("resume_config_differs", section)
    assert str(tmp_path) in raised.value.message


def test_resume_with_other_recordings_is_refused(recordings: list[Path], tmp_path: Path) -> None:
    short = changed(TRAINING, steps=1)
    fit(recordings, tmp_path, training=short)
    for data in (recordings[:1], [*recordings, recordings[0]], [recordings[0], tmp_path / "monday"]):
        with pytest.raises(ConfigError, match="--resume expects the recordings") as raised:
            fit(data, tmp_path, training=short, resume=True)
        assert (raised.value.code, raised.value.field) == ("resume_config_differs", "recordings")
    assert "2, found 2: without ['euroc'], with ['monday']" in raised.value.message


def test_resume_with_other_validation_recordings_is_refused(
    recordings: list[Path], measured: Path, tmp_path: Path
) -> None:
    short = changed(TRAINING, steps=1)
    fit(recordings, tmp_path, training=short)
    with pytest.raises(ConfigError, match=r"0, found 1: without \[\], with \['drone_000001'\]") as raised:
        fit(recordings, tmp_path, training=short, validation=[measured], resume=True)
    assert (raised.value.code, raised.value.field) == ("resume_config_differs", "validation")


@pytest.mark.parametrize("key", ["recordings", "validation"])
def test_a_state_that_does_not_know_its_recordings_is_not_gone_on_from(
    recordings: list[Path], tmp_path: Path, key: str
) -> None:
    fit(recordings, tmp_path, training=changed(TRAINING, steps=1))
    state = load_training_state(tmp_path)
    assert state is not None
    tensors, record = state
    del record[key]
    save_training_state(tmp_path, tensors, record)
    with pytest.raises(
        ConfigError, match=f"expects the {key} that the run was started with, which its state does not name"
    ) as raised:
        fit(recordings, tmp_path, training=changed(TRAINING, steps=1), resume=True)
    assert raised.value.code == "resume_config_differs"


def test_the_order_of_the_recordings_does_not_matter(
    recordings: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = fit(recordings, tmp_path / "whole")
    with monkeypatch.context() as patch:
        kill_at(patch, 3)
        with pytest.raises(Killed):
            fit(recordings, tmp_path / "killed")
    assert digest(fit(recordings[::-1], tmp_path / "killed", resume=True)) == digest(whole)


def test_an_existing_run_is_not_overwritten(recordings: list[Path], tmp_path: Path) -> None:
    fit(recordings, tmp_path, training=changed(TRAINING, steps=1))
    before = digest(tmp_path / STATE)
    with pytest.raises(ConfigError, match=f"{tmp_path}.*--resume goes on with it") as raised:
        fit(recordings, tmp_path, training=changed(TRAINING, steps=1))
    assert raised.value.code == "training_exists"
    assert digest(tmp_path / STATE) == before


def _without_a_tensor(tensors: dict[str, torch.Tensor], record: dict[str, Any]) -> None:
    del record
    del tensors["model.context.weight"]


def _without_the_step(tensors: dict[str, torch.Tensor], record: dict[str, Any]) -> None:
    del tensors
    del record["step"]


def _with_a_strange_optimizer_key(tensors: dict[str, torch.Tensor], record: dict[str, Any]) -> None:
    del record
    tensors["optimizer.first.exp_avg"] = torch.zeros(1)


def _with_too_many_parameters(tensors: dict[str, torch.Tensor], record: dict[str, Any]) -> None:
    del record
    tensors["optimizer.9999.exp_avg"] = torch.zeros(1)


@pytest.mark.parametrize(
    "harm", [_without_a_tensor, _without_the_step, _with_a_strange_optimizer_key, _with_too_many_parameters]
)
def test_a_state_with_parts_missing_is_corrupt(
    recordings: list[Path], tmp_path: Path, harm: Callable[[dict[str, torch.Tensor], dict[str, Any]], None]
) -> None:
    fit(recordings, tmp_path, training=changed(TRAINING, steps=1))
    state = load_training_state(tmp_path)
    assert state is not None
    harm(*state)
    save_training_state(tmp_path, *state)
    with pytest.raises(CheckpointError, match=str(tmp_path)) as raised:
        fit(recordings, tmp_path, training=changed(TRAINING, steps=1), resume=True)
    assert raised.value.code == "checkpoint_corrupt"


# --- learning


def test_the_seed_decides_the_weights(recordings: list[Path], tmp_path: Path) -> None:
    short = changed(TRAINING, steps=2)
    torch.manual_seed(1)
    first = digest(fit(recordings, tmp_path / "a", training=short))
    torch.manual_seed(2)
    assert digest(fit(recordings, tmp_path / "b", training=short)) == first
    assert digest(fit(recordings, tmp_path / "c", training=changed(short, seed=1))) != first


def test_the_loss_falls_on_pairs_seen_again_and_again(tmp_path: Path) -> None:
    folder = write_plain(tmp_path / "a", make_world(frames=2))
    training = changed(TRAINING, steps=60, learning_rate=3e-3)
    data = load_training_data([folder], MODEL, (1,))
    run = TrainingRun(model=MODEL, training=training, device="cpu")
    losses, wins = zip(*(run.train_step(data) for _ in range(60)), strict=True)
    # The strip that leaves the image costs what it would had nothing moved, whatever is learnt: most of the rest.
    assert sum(losses[-10:]) < 0.8 * sum(losses[:10])
    assert all(int(win.sum()) == 2 and win.shape == (4,) for win in wins)


def test_bfloat16_gives_finite_weights(recordings: list[Path], tmp_path: Path) -> None:
    path = fit(recordings, tmp_path, training=changed(TRAINING, steps=2, autocast=True))
    assert all(torch.isfinite(value).all() for value in load_checkpoint(path).model.state_dict().values())


def test_learning_rate_warms_up_and_falls() -> None:
    config = TrainingConfig(steps=100, warmup_steps=10, learning_rate=1e-3)
    rates = [learning_rate(config, step) for step in range(100)]
    assert rates[0] == pytest.approx(1e-4)
    assert rates[9] == rates[10] == pytest.approx(1e-3)
    assert rates[10:] == sorted(rates[10:], reverse=True)
    assert learning_rate(config, 100) == pytest.approx(1e-5)
    assert learning_rate(config, 200) == pytest.approx(1e-5)
    assert learning_rate(changed(config, warmup_steps=0), 0) == pytest.approx(1e-3)
    assert learning_rate(changed(config, steps=5), 9) == pytest.approx(1e-3)


# --- refusals


@pytest.mark.parametrize("device", ["cuda", "cuda:7", "abacus"])
def test_a_device_that_is_not_there(tmp_path: Path, device: str) -> None:
    if device == "cuda" and torch.cuda.is_available():
        pytest.skip("this machine has a CUDA device")
    with pytest.raises(ConfigError, match=f"found '{device}'") as raised:
        fit([tmp_path / "never-read"], tmp_path / "out", device=device)
    assert (raised.value.code, raised.value.field) == ("device_unavailable", "device")
    assert not (tmp_path / "out").exists()


def test_validation_without_ground_truth_is_refused_before_anything_is_learnt(
    recordings: list[Path], tmp_path: Path
) -> None:
    with pytest.raises(DatasetError) as raised:
        fit([tmp_path / "never-read"], tmp_path / "out", validation=[recordings[1]])
    assert (raised.value.code, raised.value.field) == ("ground_truth_missing", "validation")
    assert str(recordings[1]) in raised.value.message
    assert not (tmp_path / "out").exists()


def test_a_loss_that_does_not_fit_the_model(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match="expected 'auto' or 'charbonnier' for the preset 'compact', found 'squared'"
    ) as raised:
        fit([tmp_path / "never-read"], tmp_path / "out", training=changed(TRAINING, loss="squared"))
    assert (raised.value.code, raised.value.field) == ("config_invalid", "training.loss")


def test_a_recording_that_does_not_exist(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="absent"):
        fit([tmp_path / "absent"], tmp_path / "out")


# --- what is written


def test_what_a_run_leaves(recordings: list[Path], measured: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    path = fit(recordings, out, validation=[measured])
    assert sorted(file.name for file in out.iterdir()) == [
        "metrics.jsonl",
        "model.json",
        "model.safetensors",
        "state.safetensors",
    ]
    record = load_checkpoint(path).record
    assert (path, record.name, record.model) == (out / "model.safetensors", "viflow-compact", MODEL)
    provenance = record.provenance
    assert provenance["training"] == TRAINING.model_dump(mode="json")
    assert provenance["data"] == {"recordings": 2, "names": ["euroc", "plain"], "pairs": 10, "excluded": {}}
    assert (provenance["device"], provenance["torch_version"]) == ("cpu", torch.__version__)
    metrics = provenance["metrics"]
    assert metrics["groups"] == {"drone": {key: metrics[key] for key in MEASURES}}
    assert metrics["identity_epe_px"] == 2.0


def test_metrics_hold_losses_wins_and_endpoint_errors(
    recordings: list[Path], measured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training_progress, "LOG_EVERY", 4)
    path = fit(recordings, tmp_path / "run", validation=[measured])
    rows = logged(tmp_path / "run")
    assert [(row["step"], set(row) - {"step"}) for row in rows] == [
        (3, MEASURES),
        (4, {"loss", "wins"}),
        (6, {"loss", "wins"}),
        (6, MEASURES),
    ]
    assert len(rows[1]["wins"]) == 4
    assert sum(rows[1]["wins"]) == pytest.approx(1.0, abs=1e-3)
    assert rows[1]["loss"] > 0
    metrics = load_checkpoint(path).record.provenance["metrics"]
    assert rows[3]["epe_px"] == metrics["epe_px"]


def test_validation_changes_no_weight(recordings: list[Path], measured: Path, tmp_path: Path) -> None:
    with_it = fit(recordings, tmp_path / "a", validation=[measured])
    assert digest(with_it) == digest(fit(recordings, tmp_path / "b"))


def test_a_finished_run_is_measured_when_it_is_resumed(recordings: list[Path], measured: Path, tmp_path: Path) -> None:
    fit(recordings, tmp_path / "run", validation=[measured])
    path = fit(recordings, tmp_path / "run", validation=[measured], resume=True)
    assert load_checkpoint(path).record.provenance["metrics"]["identity_epe_px"] == 2.0


def test_an_invisible_run_prints_nothing(
    recordings: list[Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    fit(recordings, tmp_path)
    assert capfd.readouterr() == ("", "")


def test_a_visible_run_shows_loss_wins_and_endpoint_error_on_stderr(
    recordings: list[Path], measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fit(recordings, tmp_path / "run", validation=[measured], progress=True)
    left = capsys.readouterr()
    assert left.out == ""
    shown = " ".join(left.err.split())
    for words in ("reading", "2/2", "training (EPE", "6/6", "loss"):
        assert words in shown


def test_tensorboard_gets_the_same_numbers(
    recordings: list[Path], measured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    pytest.importorskip("tensorboard")
    fit(recordings, tmp_path / "run", validation=[measured])
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator  # noqa: PLC0415

    events = EventAccumulator(str(tmp_path / "run"))
    events.Reload()
    names = {"loss", *MEASURES, *(f"wins/{k}" for k in range(4))}
    assert set(events.Tags()["scalars"]) == names
    (loss,) = [row for row in logged(tmp_path / "run") if "loss" in row]
    (scalar,) = events.Scalars("loss")
    assert (scalar.step, scalar.value) == (6, pytest.approx(loss["loss"]))


def test_the_commit_is_on_record(recordings: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training_module, "source_commit", lambda: "abc123")
    path = fit(recordings, tmp_path, training=changed(TRAINING, steps=1))
    assert load_checkpoint(path).record.provenance["commit"] == "abc123"
