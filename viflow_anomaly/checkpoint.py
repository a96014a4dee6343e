"""Checkpoints are data, never pickles: NAME.safetensors (tensors) beside NAME.json (configuration, checksum)."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from pydantic import Field
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import nn

from viflow_anomaly.config import FrozenConfig, ModelConfig
from viflow_anomaly.errors import CheckpointError, ConfigError
from viflow_anomaly.model.builder import build_model

FORMAT_VERSION = 1
BUNDLED_NAME = "viflow-compact"
MAX_RECORD_BYTES = 4 * 1024 * 1024


class CheckpointRecord(FrozenConfig):
    """The JSON beside the tensors.

    Attributes:
        format_version: of this layout; another one is refused.
        name, version: of the model.
        sha256: of the tensor file.
        model: what the builder needs.
        provenance: commit, training configuration, data, metrics; free-form, for people.
    """

    format_version: Literal[1] = 1
    name: str = Field(min_length=1)
    version: str = Field(min_length=1)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    model: ModelConfig
    provenance: dict[str, Any] = Field(default_factory=dict)


class LoadedCheckpoint(NamedTuple):
    """model: on the CPU, in evaluation mode."""

    model: nn.Module
    record: CheckpointRecord


def bundled_checkpoint() -> Path:
    """The tensor file of the model that ships with the package."""
    return Path(str(resources.files("viflow_anomaly.weights"))) / f"{BUNDLED_NAME}.safetensors"


def write_atomically(path: Path, data: bytes) -> None:
    """Write beside ``path`` and rename, so that nobody ever sees half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(data)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def save_checkpoint(
    path: Path,
    model: nn.Module,
    config: ModelConfig,
    *,
    name: str,
    version: str,
    provenance: Mapping[str, Any] | None = None,
) -> Path:
    """Write ``path`` (.safetensors) and its JSON; the same weights and record give the same bytes."""
    tensors = {key: value.detach().cpu().contiguous() for key, value in sorted(model.state_dict().items())}
    data = save_tensors(tensors)
    record = CheckpointRecord(
        name=name,
        version=version,
        sha256=hashlib.sha256(data).hexdigest(),
        model=config,
        provenance=dict(provenance or {}),
    )
    write_atomically(path, data)
    write_atomically(path.with_suffix(".json"), (record.model_dump_json(indent=2) + "\n").encode())
    return path


def load_checkpoint(path: Path | None = None) -> LoadedCheckpoint:
    """Read a checkpoint (None: the bundled one) without executing anything from it.

    Raises:
        CheckpointError: ``checkpoint_missing``, ``checkpoint_not_safetensors`` (a pickle, or anything else),
            ``checkpoint_record_invalid``, ``checkpoint_version``, ``checkpoint_corrupt`` (truncated or altered).
    """
    path = bundled_checkpoint() if path is None else path
    if path.suffix != ".safetensors":
        raise CheckpointError(
            f"{path}: expected a .safetensors file with its .json beside it; pickled checkpoints (.pt, .pth, .ckpt) "
            "can run code and are not read",
            code="checkpoint_not_safetensors",
            field="checkpoint",
        )
    data = _read(path)
    record = _read_record(path)
    found = hashlib.sha256(data).hexdigest()
    if found != record.sha256:
        raise _corrupt(path, f"expected sha256 {record.sha256}, found {found} over {len(data)} bytes")
    try:
        model = build_model(record.model)
    except ConfigError as err:
        raise _invalid_record(path.with_suffix(".json"), err.message) from err
    try:
        model.load_state_dict(load_tensors(data))
    except (SafetensorError, RuntimeError) as err:
        raise _corrupt(path, f"expected the tensors of the model in its .json, found: {_one_line(err)}") from err
    return LoadedCheckpoint(model.eval(), record)


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as err:
        raise CheckpointError(
            f"{path}: expected a readable checkpoint file, found: {err.strerror}",
            code="checkpoint_missing",
            field="checkpoint",
        ) from err


def _read_record(path: Path) -> CheckpointRecord:
    record_path = path.with_suffix(".json")
    if not record_path.exists():
        raise CheckpointError(
            f"{path}: expected a checkpoint of this package, tensors with {record_path} beside them, "
            "found no such file (others, pickles among them, are not read)",
            code="checkpoint_missing",
            field="checkpoint",
        )
    data = _read(record_path)
    if len(data) > MAX_RECORD_BYTES:
        raise _invalid_record(record_path, f"expected at most {MAX_RECORD_BYTES} bytes, found {len(data)}")
    try:
        values = json.loads(data)
    except (ValueError, RecursionError) as err:
        raise _invalid_record(record_path, f"expected JSON, found: {err}") from err
    version = values.get("format_version") if isinstance(values, dict) else None
    if version is not None and version != FORMAT_VERSION:
        raise CheckpointError(
            f"{record_path}: expected format_version {FORMAT_VERSION}, found {version!r}",
            code="checkpoint_version",
            field="checkpoint",
        )
    try:
        return CheckpointRecord.from_mapping(values, where=str(record_path))
    except ConfigError as err:
        raise CheckpointError(err.message, code="checkpoint_record_invalid", field="checkpoint") from err


def _invalid_record(record_path: Path, problem: str) -> CheckpointError:
    return CheckpointError(f"{record_path}: {problem}", code="checkpoint_record_invalid", field="checkpoint")


def _corrupt(path: Path, problem: str) -> CheckpointError:
    return CheckpointError(f"{path}: truncated or altered: {problem}", code="checkpoint_corrupt", field="checkpoint")


def _one_line(err: Exception) -> str:
    return " ".join(str(err).split())[:300]


def save_training_state(folder: Path, tensors: Mapping[str, torch.Tensor], record: Mapping[str, Any]) -> None:
    """Write tensors and record of a running training as one file (the record rides in the safetensors metadata)."""
    contiguous = {key: value.detach().cpu().contiguous() for key, value in sorted(tensors.items())}
    data = save_tensors(contiguous, metadata={"record": json.dumps(record, sort_keys=True)})
    write_atomically(folder / "state.safetensors", data)


def load_training_state(folder: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]] | None:
    """What ``save_training_state`` wrote last, or None where nothing was written.

    Raises:
        CheckpointError: ``checkpoint_corrupt``.
    """
    path = folder / "state.safetensors"
    if not path.exists():
        return None
    data = _read(path)
    try:
        tensors = load_tensors(data)
        header_bytes = int.from_bytes(data[:8], "little")
        record: dict[str, Any] = json.loads(json.loads(data[8 : 8 + header_bytes])["__metadata__"]["record"])
    except (SafetensorError, ValueError, KeyError) as err:
        raise _corrupt(path, f"expected tensors and the record of a training, found: {_one_line(err)}") from err
    return tensors, record


def source_commit() -> str | None:
    """The commit of the source tree this package runs from, or None (an installed wheel)."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True)  # noqa: S603
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip()
