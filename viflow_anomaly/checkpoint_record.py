"""The JSON beside a checkpoint's tensors: configuration, checksum, provenance. Read without torch."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import subprocess
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar, get_args

from pydantic import Field, model_validator

from viflow_anomaly.config import EvidenceHeadConfig, FrozenConfig, ModelConfig, RegionScore
from viflow_anomaly.errors import CheckpointError, ConfigError

FORMAT_VERSION = 1
ExportSuffix = Literal[".onnx", ".int8.onnx", ".xml", ".int8.xml"]
EXPORT_SUFFIXES: tuple[ExportSuffix, ...] = get_args(ExportSuffix)
"""What an export beside NAME.safetensors is called: NAME.onnx, ...; the weights of NAME.xml are in NAME.bin."""
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
BUNDLED_NAME = "viflow-calibrated"
BUNDLED_EVIDENCE_NAME = "viflow-evidence"
MAX_RECORD_BYTES = 4 * 1024 * 1024


class TensorRecord(FrozenConfig):
    """The JSON beside any tensors of ours.

    Attributes:
        format_version: of this layout; another one is refused.
        name, version: of the network.
        sha256: of the tensor file.
        onnx_sha256: of NAME.onnx beside it, None until there is one.
        exports: of its other exports, by suffix; of two files, the .xml and behind it the .bin.
        provenance: commit, training configuration, data, metrics; free-form, for people.
    """

    format_version: Literal[1] = 1
    name: str = Field(min_length=1)
    version: str = Field(min_length=1)
    sha256: Sha256
    onnx_sha256: Sha256 | None = None
    exports: dict[ExportSuffix, Sha256] = Field(default_factory=dict, exclude_if=lambda exports: not exports)
    provenance: dict[str, Any] = Field(default_factory=dict)

    def export_sha256(self, suffix: ExportSuffix) -> str | None:
        """The checksum of one export; None where there is none."""
        return self.onnx_sha256 if suffix == ".onnx" else self.exports.get(suffix)

    def with_export(self, suffix: ExportSuffix, sha256: str) -> Self:
        """The record of a checkpoint that was exported."""
        if suffix == ".onnx":
            return self.model_copy(update={"onnx_sha256": sha256})
        return self.model_copy(update={"exports": {**self.exports, suffix: sha256}})


class CheckpointRecord(TensorRecord):
    """Of a VIFlow network; ``model`` is what the builder needs."""

    model: ModelConfig

    @model_validator(mode="after")
    def _motor_stream_is_fitted(self) -> Self:
        if not self.model.motor_is_fitted:
            raise ValueError(
                f"model.motor: expected the values that a training fits for {self.model.motion_inputs!r}, found none"
            )
        return self


class EvidenceRecord(TensorRecord):
    """Of an evidence head.

    Attributes:
        head: what the builder needs.
        photometric_cues, geometric_cues: their names, in the order that the head was trained on.
        cues_version: of the cues' arithmetic, ``evidence_cues.CUES_VERSION``.
        region_score: how what is found becomes a probability, fitted after the training.
    """

    head: EvidenceHeadConfig
    photometric_cues: tuple[str, ...]
    geometric_cues: tuple[str, ...]
    cues_version: int = 1
    region_score: RegionScore = RegionScore()


Record = TypeVar("Record", bound=TensorRecord)
_KINDS: dict[type[TensorRecord], tuple[str, str]] = {
    CheckpointRecord: ("model", "a network"),
    EvidenceRecord: ("head", "an evidence head"),
}
"""What only this kind's JSON has, and what it is called."""


def bundled_evidence_head() -> Path:
    """The tensor file of the evidence head that ships with the package."""
    return Path(str(resources.files("viflow_anomaly.weights"))) / f"{BUNDLED_EVIDENCE_NAME}.safetensors"


def bundled_checkpoint() -> Path:
    """The tensor file of the model that ships with the package."""
    return Path(str(resources.files("viflow_anomaly.weights"))) / f"{BUNDLED_NAME}.safetensors"


def write_atomically(path: Path, data: bytes) -> None:
    """Write beside ``path`` and rename, so that nobody ever sees half a file.

    Raises:
        OSError: naming ``path`` or its folder: a full disk, a folder that cannot be made or written.
    """
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "expected a file or nothing there, found a directory or a device", str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(data)
        temporary.replace(path)
    except OSError as err:
        raise OSError(err.errno, err.strerror, str(path)) from err
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def write_record(path: Path, record: TensorRecord) -> None:
    """Write the JSON of the checkpoint ``path`` (its tensor file)."""
    write_atomically(path.with_suffix(".json"), (record.model_dump_json(indent=2) + "\n").encode())


def read_checkpoint(path: Path) -> tuple[bytes, CheckpointRecord]:
    """``read_tensors`` of a VIFlow network."""
    return read_tensors(path, CheckpointRecord)


def read_tensors(path: Path, kind: type[Record]) -> tuple[bytes, Record]:
    """The tensor file's bytes and its record; the checksum is compared, nothing is executed.

    Raises:
        CheckpointError: ``checkpoint_missing``, ``checkpoint_not_safetensors`` (a pickle, or anything else),
            ``checkpoint_record_invalid``, ``checkpoint_version``, ``checkpoint_corrupt`` (truncated or altered),
            ``checkpoint_of_other_kind`` (a head in a network's place, or the reverse).
    """
    if path.suffix != ".safetensors":
        raise CheckpointError(
            f"{path}: expected a .safetensors file with its .json beside it; pickled checkpoints (.pt, .pth, .ckpt) "
            "can run code and are not read",
            code="checkpoint_not_safetensors",
            field="checkpoint",
        )
    data = read_checkpoint_file(path)
    record = _read_record(path, kind)
    found = hashlib.sha256(data).hexdigest()
    if found != record.sha256:
        raise corrupt_checkpoint(path, f"expected sha256 {record.sha256}, found {found} over {len(data)} bytes")
    return data, record


def read_checkpoint_file(path: Path) -> bytes:
    """The bytes of one file of a checkpoint; ``checkpoint_missing`` where there are none."""
    try:
        return path.read_bytes()
    except OSError as err:
        raise CheckpointError(
            f"{path}: expected a readable checkpoint file, found: {err.strerror}",
            code="checkpoint_missing",
            field="checkpoint",
        ) from err


def _read_record(path: Path, kind: type[Record]) -> Record:
    record_path = path.with_suffix(".json")
    if not record_path.exists():
        raise CheckpointError(
            f"{path}: expected a checkpoint of this package, tensors with {record_path} beside them, "
            "found no such file (others, pickles among them, are not read)",
            code="checkpoint_missing",
            field="checkpoint",
        )
    data = read_checkpoint_file(record_path)
    if len(data) > MAX_RECORD_BYTES:
        raise invalid_record(record_path, f"expected at most {MAX_RECORD_BYTES} bytes, found {len(data)}")
    try:
        values = json.loads(data)
    except (ValueError, RecursionError) as err:
        raise invalid_record(record_path, f"expected JSON, found: {err}") from err
    version = values.get("format_version") if isinstance(values, dict) else None
    if version is not None and version != FORMAT_VERSION:
        raise CheckpointError(
            f"{record_path}: expected format_version {FORMAT_VERSION}, found {version!r}",
            code="checkpoint_version",
            field="checkpoint",
        )
    _require_kind(path, values, kind)
    try:
        return kind.from_mapping(values, where=str(record_path))
    except ConfigError as err:
        raise CheckpointError(err.message, code="checkpoint_record_invalid", field="checkpoint") from err


def _require_kind(path: Path, values: Any, kind: type[TensorRecord]) -> None:
    own, wanted = _KINDS[kind]
    if not isinstance(values, dict) or own in values:
        return
    for only_there, found in _KINDS.values():
        if only_there in values:
            raise CheckpointError(
                f"expected {wanted}, found {found}: {path}",
                code="checkpoint_of_other_kind",
                field="checkpoint" if kind is CheckpointRecord else "evidence_head",
            )


def invalid_record(record_path: Path, problem: str) -> CheckpointError:
    """The error of a record that does not say what it must."""
    return CheckpointError(f"{record_path}: {problem}", code="checkpoint_record_invalid", field="checkpoint")


def corrupt_checkpoint(path: Path, problem: str) -> CheckpointError:
    """The error of a file that is not what its record says."""
    return CheckpointError(f"{path}: truncated or altered: {problem}", code="checkpoint_corrupt", field="checkpoint")


def source_commit() -> str | None:
    """The commit of the source tree this package runs from, or None (an installed wheel)."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True)  # noqa: S603
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip()
