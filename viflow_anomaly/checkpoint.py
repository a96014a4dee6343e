"""Checkpoints are data, never pickles: NAME.safetensors (tensors) beside NAME.json (configuration, checksum)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import nn

from viflow_anomaly.checkpoint_record import (
    EXPORT_SUFFIXES,
    CheckpointRecord,
    EvidenceRecord,
    TensorRecord,
    bundled_checkpoint,
    bundled_evidence_head,
    corrupt_checkpoint,
    invalid_record,
    read_checkpoint,
    read_checkpoint_file,
    read_tensors,
    write_atomically,
    write_record,
)
from viflow_anomaly.config import ModelConfig
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.model.builder import build_model
from viflow_anomaly.model.evidence_builder import build_evidence_head
from viflow_anomaly.model.evidence_head import EvidenceHead


class LoadedCheckpoint(NamedTuple):
    """model: on the CPU, in evaluation mode."""

    model: nn.Module
    record: CheckpointRecord


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
    data = _tensor_bytes(model)
    record = CheckpointRecord(
        name=name,
        version=version,
        sha256=hashlib.sha256(data).hexdigest(),
        model=config,
        provenance=dict(provenance or {}),
    )
    return _write_checkpoint(path, data, record)


def save_evidence_head(path: Path, head: nn.Module, record: EvidenceRecord) -> Path:
    """Write an evidence head: ``path`` (.safetensors) and its JSON; the record's checksum is filled in."""
    data = _tensor_bytes(head)
    sha256 = hashlib.sha256(data).hexdigest()
    return _write_checkpoint(
        path, data, record.model_copy(update={"sha256": sha256, "onnx_sha256": None, "exports": {}})
    )


def _tensor_bytes(network: nn.Module) -> bytes:
    tensors = {key: value.detach().cpu().contiguous() for key, value in sorted(network.state_dict().items())}
    return save_tensors(tensors)


def _write_checkpoint(path: Path, data: bytes, record: TensorRecord) -> Path:
    for suffix in (*EXPORT_SUFFIXES, ".bin", ".int8.bin"):  # exports of what was here before
        path.with_suffix(suffix).unlink(missing_ok=True)
    write_atomically(path, data)
    write_record(path, record)
    return path


class LoadedEvidenceHead(NamedTuple):
    """head: on the CPU, in evaluation mode."""

    head: EvidenceHead
    record: EvidenceRecord


def load_evidence_head(path: Path | None = None) -> LoadedEvidenceHead:
    """Read an evidence head (None: the bundled one); errors as ``load_checkpoint``."""
    path = bundled_evidence_head() if path is None else path
    data, record = read_tensors(path, EvidenceRecord)
    head = build_evidence_head(record.head)
    _load_into(head, data, path, of="head")
    return LoadedEvidenceHead(head.eval(), record)


def load_checkpoint(path: Path | None = None) -> LoadedCheckpoint:
    """Read a checkpoint (None: the bundled one) without executing anything from it.

    Raises:
        CheckpointError: as ``read_checkpoint``; ``checkpoint_corrupt`` also where the tensors are not the model's.
    """
    path = bundled_checkpoint() if path is None else path
    data, record = read_checkpoint(path)
    try:
        model = build_model(record.model)
    except ConfigError as err:
        raise invalid_record(path.with_suffix(".json"), err.message) from err
    _load_into(model, data, path, of="model")
    return LoadedCheckpoint(model.eval(), record)


def _load_into(network: nn.Module, data: bytes, path: Path, *, of: str) -> None:
    try:
        network.load_state_dict(load_tensors(data))
    except (SafetensorError, RuntimeError) as err:
        raise corrupt_checkpoint(
            path, f"expected the tensors of the {of} in its .json, found: {_one_line(err)}"
        ) from err


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
    data = read_checkpoint_file(path)
    try:
        tensors = load_tensors(data)
        header_bytes = int.from_bytes(data[:8], "little")
        record: dict[str, Any] = dict(json.loads(json.loads(data[8 : 8 + header_bytes])["__metadata__"]["record"]))
    except (SafetensorError, ValueError, KeyError, TypeError) as err:
        raise corrupt_checkpoint(
            path, f"expected tensors and the record of a training, found: {_one_line(err)}"
        ) from err
    return tensors, record
