"""What an exported file says of itself, how it is read, and what its inputs are. No backend is imported here."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from viflow_anomaly.checkpoint_record import (
    CheckpointRecord,
    EvidenceRecord,
    ExportSuffix,
    TensorRecord,
    corrupt_checkpoint,
    read_checkpoint_file,
)
from viflow_anomaly.config import ModelConfig
from viflow_anomaly.errors import CheckpointError
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.model_input import ModelInput

NAME_KEY = "viflow.name"
VERSION_KEY = "viflow.version"
WEIGHTS_KEY = "viflow.weights_sha256"
MODEL_KEY = "viflow.model"
FLOW_STRIDE_KEY = "viflow.flow_stride"
HEAD_KEY = "viflow.evidence_head"
REGION_SCORE_KEY = "viflow.region_score"
DETECTOR_KEY = "viflow.detector"
"""The thresholds that the detector has by default."""
PREPROCESSING_KEY = "viflow.preprocessing"
PRECISION_KEY = "viflow.precision"
INPUT_NAMES = ("source", "motion", "interval_s", "motor")
"""The last one where the network has a motor stream."""
FLOW_OUTPUTS = ("flow_px",)
HEAD_INPUTS, HEAD_OUTPUTS = ("photometric", "geometric"), ("logits", "offsets")
SCENE_OUTPUTS = ("flow_px", "inverse_depth", "rotation", "translation")

Feed = dict[str, Float32Array]
"""The inputs of one prediction by name, each with its batch of one."""


def network_feed(model_input: ModelInput) -> Feed:
    """What a network is given of a pair; one without a motor stream gets no ``motor``."""
    window = model_input.window
    feed = {
        "source": model_input.source[None, None] * np.float32(1 / 255),
        "motion": window.values[None].astype(np.float32),
        "interval_s": np.array([window.interval_s], dtype=np.float32),
    }
    if model_input.motor is not None:
        feed["motor"] = model_input.motor[None].astype(np.float32)
    return feed


class Export(NamedTuple):
    """An exported network as it lies on the disk; ``weights`` is the .bin of an .xml."""

    path: Path
    checkpoint: Path
    data: bytes
    weights: bytes | None


def export_path(checkpoint: Path, suffix: ExportSuffix) -> Path:
    """Where a checkpoint's export is looked for: beside it."""
    return checkpoint.with_suffix(suffix)


def weights_path(path: Path) -> Path:
    """The .bin of an .xml."""
    return path.with_suffix(".bin")


def checksum(data: bytes, weights: bytes | None) -> str:
    """sha256 of an export; of two files, one behind the other."""
    return hashlib.sha256(data + (weights or b"")).hexdigest()


def read_export(checkpoint: Path, record: TensorRecord, suffix: ExportSuffix) -> Export:
    """The very file that was made from the checkpoint as it is now: its record names the checksum.

    Raises:
        CheckpointError: ``export_stale``: altered, or older than the checkpoint; ``checkpoint_missing``.
    """
    path = export_path(checkpoint, suffix)
    data = read_checkpoint_file(path)
    weights = read_checkpoint_file(weights_path(path)) if path.suffix == ".xml" else None
    found, expected = checksum(data, weights), record.export_sha256(suffix)
    if found != expected:
        raise _stale(path, checkpoint, record, f"sha256 {expected or 'none'}", found)
    return Export(path, checkpoint, data, weights)


def require_weights(export: Export, metadata: Mapping[str, str], record: TensorRecord) -> None:
    """An export says which tensors it was made of: they must be the checkpoint's.

    Raises:
        CheckpointError: ``checkpoint_corrupt`` for a foreign network; ``export_stale``.
    """
    found = metadata.get(WEIGHTS_KEY)
    if found is None:
        raise foreign(export, f"no {WEIGHTS_KEY} in its metadata")
    if found != record.sha256:
        raise _stale(export.path, export.checkpoint, record, f"of the tensors {record.sha256}", found)


def require_network(export: Export, metadata: Mapping[str, str], record: CheckpointRecord) -> int:
    """The network's flow stride, where the export is of the checkpoint's network.

    Raises:
        CheckpointError: ``checkpoint_corrupt``; as ``require_weights``.
    """
    try:
        same_model = ModelConfig.model_validate_json(metadata[MODEL_KEY]) == record.model
        stride = int(metadata[FLOW_STRIDE_KEY])
    except (LookupError, ValueError) as err:
        raise foreign(export, str(err)[-200:]) from err
    if not same_model:
        expected = f"expected the model configuration of {export.checkpoint.with_suffix('.json')} in it"
        raise corrupt_checkpoint(export.path, expected)
    require_weights(export, metadata, record)
    return stride


def require_head(export: Export, metadata: Mapping[str, str], record: EvidenceRecord) -> None:
    """Nothing, where the export is of the checkpoint's evidence head.

    Raises:
        CheckpointError: ``checkpoint_corrupt``; as ``require_weights``.
    """
    if HEAD_KEY not in metadata:
        raise corrupt_checkpoint(export.path, "expected the export of an evidence head, found another network's")
    require_weights(export, metadata, record)


def foreign(export: Export, found: str) -> CheckpointError:
    """The error of a file that is no export of this package, or none that the backend can read."""
    kind = "OpenVINO" if export.path.suffix == ".xml" else "ONNX"
    return corrupt_checkpoint(export.path, f"expected an {kind} network of this package, found: {found}")


def _stale(path: Path, checkpoint: Path, record: TensorRecord, expected: str, found: str) -> CheckpointError:
    command = export_command(checkpoint, path, of_head=isinstance(record, EvidenceRecord))
    return CheckpointError(
        f"{path}: expected the export that {checkpoint.with_suffix('.json').name} names, {expected}, found {found}: "
        f"altered, or older than the checkpoint; make it anew with {command}",
        code="export_stale",
        field="evidence_head" if isinstance(record, EvidenceRecord) else "checkpoint",
    )


def export_command(checkpoint: Path, path: Path, *, of_head: bool) -> str:
    """What writes ``path``."""
    option = "--evidence-head" if of_head else "--checkpoint"
    more = " --format openvino" if path.suffix == ".xml" else ""
    more += " --int8" if path.name.endswith((".int8.onnx", ".int8.xml")) else ""
    return f"viflow-anomaly export {option} {checkpoint}{more}"
