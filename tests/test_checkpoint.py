from __future__ import annotations

import hashlib
import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import save as save_tensors
from torch import nn

from viflow_anomaly import checkpoint as checkpoint_module
from viflow_anomaly.checkpoint import (
    load_checkpoint,
    load_evidence_head,
    load_training_state,
    save_checkpoint,
    save_training_state,
)
from viflow_anomaly.checkpoint_record import (
    MAX_RECORD_BYTES,
    CheckpointRecord,
    bundled_checkpoint,
    bundled_evidence_head,
    source_commit,
    write_atomically,
)
from viflow_anomaly.config import ModelConfig, MotionWindowConfig
from viflow_anomaly.errors import CheckpointError
from viflow_anomaly.model.builder import build_model

CONFIG = ModelConfig(hypotheses=4, motion_window=MotionWindowConfig(samples_before=2, samples_between=4))


@pytest.fixture(scope="module")
def network() -> nn.Module:
    return build_model(CONFIG, seed=3)


@pytest.fixture
def saved(tmp_path: Path, network: nn.Module) -> Path:
    return save_checkpoint(
        tmp_path / "model.safetensors", network, CONFIG, name="n", version="1", provenance={"pairs": 3}
    )


def change_record(path: Path, **changes: object) -> None:
    record = path.with_suffix(".json")
    record.write_text(json.dumps(json.loads(record.read_text()) | changes))


def refusal(path: Path) -> CheckpointError:
    with pytest.raises(CheckpointError) as raised:
        load_checkpoint(path)
    assert raised.value.field == "checkpoint"
    return raised.value


def test_round_trip(saved: Path, network: nn.Module) -> None:
    loaded = load_checkpoint(saved)
    assert not loaded.model.training
    assert (loaded.record.name, loaded.record.version, loaded.record.model) == ("n", "1", CONFIG)
    assert loaded.record.provenance == {"pairs": 3}
    assert loaded.record.sha256 == hashlib.sha256(saved.read_bytes()).hexdigest()
    wanted = network.state_dict()
    found = loaded.model.state_dict()
    assert wanted.keys() == found.keys()
    assert all(torch.equal(wanted[key], found[key]) for key in wanted)


def test_same_weights_give_the_same_bytes(saved: Path, tmp_path: Path) -> None:
    model = load_checkpoint(saved).model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    again = save_checkpoint(
        tmp_path / "again" / "model.safetensors", model, CONFIG, name="n", version="1", provenance={"pairs": 3}
    )
    assert again.read_bytes() == saved.read_bytes()
    assert again.with_suffix(".json").read_bytes() == saved.with_suffix(".json").read_bytes()
    assert sorted(path.name for path in again.parent.iterdir()) == ["model.json", "model.safetensors"]


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-5])


def _alter(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _pickle(path: Path) -> None:
    torch.save({"weight": torch.zeros(3)}, path)


@pytest.mark.parametrize("harm", [_truncate, _alter, _empty, _pickle])
def test_tensors_that_are_not_those_that_were_saved(saved: Path, harm: Callable[[Path], None]) -> None:
    harm(saved)
    error = refusal(saved)
    assert error.code == "checkpoint_corrupt"
    assert str(saved) in error.message
    assert "expected sha256" in error.message


@pytest.mark.parametrize("harm", [_truncate, _empty, _pickle])
def test_a_matching_checksum_does_not_make_it_tensors(saved: Path, harm: Callable[[Path], None]) -> None:
    harm(saved)
    change_record(saved, sha256=hashlib.sha256(saved.read_bytes()).hexdigest())
    error = refusal(saved)
    assert error.code == "checkpoint_corrupt"
    assert f"{saved}: truncated or altered: expected the tensors of the model" in error.message


def test_tensors_of_another_architecture(saved: Path) -> None:
    change_record(saved, model=CONFIG.model_copy(update={"hypotheses": 8}).model_dump(mode="json"))
    error = refusal(saved)
    assert error.code == "checkpoint_corrupt"
    assert str(saved) in error.message
    assert "size mismatch for velocity_head.weight" in error.message
    assert "\n" not in error.message


def test_a_model_that_cannot_be_built(saved: Path) -> None:
    change_record(saved, model={"preset": "paper"})
    error = refusal(saved)
    assert error.code == "checkpoint_record_invalid"
    assert f"{saved.with_suffix('.json')}: the paper preset needs" in error.message


def test_missing_files_are_named(saved: Path, tmp_path: Path) -> None:
    absent = tmp_path / "absent.safetensors"
    assert refusal(absent).code == "checkpoint_missing"
    assert f"{absent}: expected a readable checkpoint file, found: No such file" in refusal(absent).message
    saved.with_suffix(".json").unlink()
    assert refusal(saved).code == "checkpoint_missing"
    assert str(saved.with_suffix(".json")) in refusal(saved).message


def test_a_directory_is_no_checkpoint(tmp_path: Path) -> None:
    folder = tmp_path / "model.safetensors"
    folder.mkdir()
    assert refusal(folder).code == "checkpoint_missing"
    assert f"{folder}: expected a readable checkpoint file, found: Is a directory" in refusal(folder).message


@pytest.mark.parametrize("suffix", [".pt", ".pth", ".ckpt", ".json", ""])
def test_only_safetensors_are_opened(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"model{suffix}"
    torch.save({"weight": torch.zeros(3)}, path)
    assert refusal(path).code == "checkpoint_not_safetensors"
    assert str(path) in refusal(path).message


@pytest.mark.parametrize("version", [2, 0, "1", [1]])
def test_another_format_version(saved: Path, version: object) -> None:
    change_record(saved, format_version=version)
    error = refusal(saved)
    assert error.code == "checkpoint_version"
    assert f"{saved.with_suffix('.json')}: expected format_version 1, found {version!r}" in error.message


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"colour": "red"}, "colour: there is no such field"),
        ({"model": {"layers": 3}}, "model.layers: there is no such field"),
        ({"sha256": "abc"}, "sha256: String should match"),
        ({"name": ""}, "name: String should have at least 1 character"),
        ({"version": ""}, "version: String should have at least 1 character"),
    ],
)
def test_records_that_say_something_else(saved: Path, changes: dict[str, object], words: str) -> None:
    change_record(saved, **changes)
    error = refusal(saved)
    assert error.code == "checkpoint_record_invalid"
    assert str(saved.with_suffix(".json")) in error.message
    assert words in error.message


@pytest.mark.parametrize(
    "content", [b"", b"{", b"\xff\xfe", b"[" * 200_000, b"[]", b"3", b" " * (MAX_RECORD_BYTES + 1)]
)
def test_records_that_are_no_record(saved: Path, content: bytes) -> None:
    saved.with_suffix(".json").write_bytes(content)
    error = refusal(saved)
    assert error.code == "checkpoint_record_invalid"
    assert str(saved.with_suffix(".json")) in error.message


def test_a_failing_write_leaves_what_was_there(
    saved: Path, network: nn.Module, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {path.name: path.read_bytes() for path in saved.parent.iterdir()}

    def full(self: Path, data: bytes) -> int:
        with self.open("wb") as file:
            file.write(data[: len(data) // 2])
        raise OSError(28, "No space left on device", str(self))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        save_checkpoint(saved, network, CONFIG, name="other", version="2")
    assert {path.name: path.read_bytes() for path in saved.parent.iterdir()} == before


def test_a_failing_rename_leaves_no_temporary_file(tmp_path: Path) -> None:
    (tmp_path / "taken").mkdir()
    with pytest.raises(OSError, match="taken"):
        write_atomically(tmp_path / "taken", b"data")
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_the_record_needs_no_provenance() -> None:
    record = CheckpointRecord(name="n", version="1", sha256="0" * 64, model=CONFIG)
    assert (record.provenance, record.format_version) == ({}, 1)


def test_no_path_means_the_bundled_model(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert (bundled_checkpoint().parent.name, bundled_checkpoint().suffix) == ("weights", ".safetensors")
    monkeypatch.setattr(checkpoint_module, "bundled_checkpoint", lambda: saved)
    assert load_checkpoint().record.name == "n"


# --- the state of a running training


def test_state_round_trip(tmp_path: Path) -> None:
    tensors = {"b": torch.arange(6).reshape(2, 3).T, "a": torch.tensor(2.5), "c": torch.zeros(0)}
    record = {"step": 7, "model": {"hypotheses": 4}, "name": "ü"}
    save_training_state(tmp_path / "run", tensors, record)
    first = (tmp_path / "run" / "state.safetensors").read_bytes()
    loaded = load_training_state(tmp_path / "run")
    assert loaded is not None
    assert loaded[1] == record
    assert loaded[0].keys() == tensors.keys()
    assert all(torch.equal(loaded[0][key], tensors[key]) for key in tensors)
    save_training_state(tmp_path / "run", *loaded)
    assert (tmp_path / "run" / "state.safetensors").read_bytes() == first


def test_no_state(tmp_path: Path) -> None:
    assert load_training_state(tmp_path) is None


def _without_record(path: Path) -> None:
    path.write_bytes(save_tensors({"a": torch.zeros(1)}, metadata={"other": "{}"}))


def _without_metadata(path: Path) -> None:
    path.write_bytes(save_tensors({"a": torch.zeros(1)}))


def _record_not_json(path: Path) -> None:
    path.write_bytes(save_tensors({"a": torch.zeros(1)}, metadata={"record": "{"}))


@pytest.mark.parametrize("harm", [_truncate, _empty, _pickle, _without_record, _without_metadata, _record_not_json])
def test_corrupt_state(tmp_path: Path, harm: Callable[[Path], None]) -> None:
    save_training_state(tmp_path, {"a": torch.zeros(3)}, {"step": 1})
    path = tmp_path / "state.safetensors"
    harm(path)
    with pytest.raises(CheckpointError) as raised:
        load_training_state(tmp_path)
    assert raised.value.code == "checkpoint_corrupt"
    assert str(path) in raised.value.message


# --- where the code came from


def test_source_commit_is_gits(monkeypatch: pytest.MonkeyPatch) -> None:
    def answer(*_: object, **__: object) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess([], 0, stdout="abc123\n")

    monkeypatch.setattr(subprocess, "run", answer)
    assert source_commit() == "abc123"


@pytest.mark.parametrize(
    "failure",
    [FileNotFoundError(2, "git"), subprocess.CalledProcessError(128, "git"), subprocess.TimeoutExpired("git", 5)],
)
def test_without_git_there_is_no_commit(monkeypatch: pytest.MonkeyPatch, failure: Exception) -> None:
    def fail(*_: object, **__: object) -> None:
        raise failure

    monkeypatch.setattr(subprocess, "run", fail)
    assert source_commit() is None


def test_nothing_but_a_file_is_written_over(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="expected a file or nothing there"):
        write_atomically(tmp_path / "folder", b"x")
    with pytest.raises(OSError, match="expected a file or nothing there"):
        write_atomically(Path("/dev/null"), b"x")


def test_what_cannot_be_written_is_told_by_its_own_name(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OSError, match="File exists") as caught:
        write_atomically(tmp_path / "file" / "picture.png", b"x")
    assert caught.value.filename == str(tmp_path / "file")
    path = tmp_path / ("n" * 250 + ".png")  # short enough, but not with what is added while it is written
    with pytest.raises(OSError, match="too long") as caught:
        write_atomically(path, b"x")
    assert caught.value.filename == str(path)
    assert [one.name for one in tmp_path.iterdir()] == ["file"]


def test_a_head_in_a_networks_place_and_the_reverse_are_called_by_name() -> None:
    for load, path, said, field in (
        (load_checkpoint, bundled_evidence_head(), "expected a network, found an evidence head", "checkpoint"),
        (load_evidence_head, bundled_checkpoint(), "expected an evidence head, found a network", "evidence_head"),
    ):
        with pytest.raises(CheckpointError) as raised:
            load(path)
        assert (raised.value.code, raised.value.field) == ("checkpoint_of_other_kind", field)
        assert raised.value.message == f"{said}: {path}"
