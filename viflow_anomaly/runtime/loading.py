"""A checkpoint on disk becomes a runtime. Backends are imported when they are asked for, not before."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from viflow_anomaly.checkpoint_record import (
    CheckpointRecord,
    EvidenceRecord,
    bundled_checkpoint,
    bundled_evidence_head,
    read_checkpoint,
    read_tensors,
)
from viflow_anomaly.config import Precision, RuntimeName
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.runtime.interface import EvidenceRuntime, Runtime


class LoadedRuntime(NamedTuple):
    """A network ready to run, and where it came from."""

    runtime: Runtime
    record: CheckpointRecord


class LoadedEvidence(NamedTuple):
    """An evidence head ready to run, and where it came from."""

    runtime: EvidenceRuntime
    record: EvidenceRecord


def load_runtime(
    path: Path | None, *, runtime: RuntimeName = "auto", device: str = "cpu", threads: int | None = None
) -> LoadedRuntime:
    """Load a checkpoint (None: the bundled model).

    "auto" takes OpenVINO on a CPU where it is installed and ``NAME.onnx`` lies beside the checkpoint, else torch.

    Args:
        path: a ``.safetensors`` file with its ``.json`` beside it.
        runtime: which backend.
        device: torch device name.
        threads: CPU threads of one prediction; None: torch's own number, one in OpenVINO.

    Raises:
        CheckpointError: as ``load_checkpoint``; ``export_stale`` for an export of other weights than the checkpoint's.
        ConfigError: ``device_unavailable``; ``runtime_unavailable`` for "openvino" that is not installed, has nothing
            exported to run, or was asked for with another device than the CPU.
    """
    path = bundled_checkpoint() if path is None else path
    if not _takes_openvino(path, runtime, device):
        return _torch(path, device, threads)
    from viflow_anomaly.runtime.openvino_runtime import OpenvinoRuntime  # noqa: PLC0415  # an extra, half a second

    _, record = read_checkpoint(path)
    return LoadedRuntime(OpenvinoRuntime(path.with_suffix(".onnx"), record, threads=threads or 1), record)


def load_evidence(
    path: Path | None,
    *,
    runtime: RuntimeName = "auto",
    device: str = "cpu",
    threads: int | None = None,
    precision: Precision = "auto",
) -> LoadedEvidence:
    """Load an evidence head (None: the bundled one); arguments and errors as ``load_runtime``.

    ``precision`` is OpenVINO's; torch computes in float32 on a CPU, with the threads that ``load_runtime`` gave it.
    """
    path = bundled_evidence_head() if path is None else path
    if not _takes_openvino(path, runtime, device):
        return _torch_evidence(path, device)
    from viflow_anomaly.runtime.openvino_evidence import OpenvinoEvidence  # noqa: PLC0415

    _, record = read_tensors(path, EvidenceRecord)
    return LoadedEvidence(
        OpenvinoEvidence(path.with_suffix(".onnx"), record, threads=threads or 1, precision=precision), record
    )


def _takes_openvino(path: Path, runtime: RuntimeName, device: str) -> bool:
    if path.suffix != ".safetensors":
        read_checkpoint(path)  # says what is wrong with the name
    missing = _what_openvino_lacks(path.with_suffix(".onnx"), device)
    if runtime == "openvino" and missing:
        raise ConfigError(f"runtime: {missing}", code="runtime_unavailable", field="runtime")
    return runtime != "torch" and not missing


def _what_openvino_lacks(exported: Path, device: str) -> str | None:
    if device != "cpu":
        return f"expected the device 'cpu' for OpenVINO, found {device!r}"
    if find_spec("openvino") is None:
        return "expected OpenVINO for the runtime 'openvino', found it missing: pip install 'viflow-anomaly[openvino]'"
    if not exported.exists():
        return f"expected {exported} (viflow-anomaly export writes it), found no such file"
    return None


def _torch(path: Path, device: str, threads: int | None) -> LoadedRuntime:
    import torch  # noqa: PLC0415  # a second of start-up

    from viflow_anomaly.batch import require_device  # noqa: PLC0415
    from viflow_anomaly.checkpoint import load_checkpoint  # noqa: PLC0415
    from viflow_anomaly.runtime.torch_runtime import TorchRuntime  # noqa: PLC0415

    if threads is not None:
        torch.set_num_threads(threads)
    require_device(device)
    network, record = load_checkpoint(path)
    return LoadedRuntime(TorchRuntime(network, device=device), record)


def _torch_evidence(path: Path, device: str) -> LoadedEvidence:
    from viflow_anomaly.batch import require_device  # noqa: PLC0415
    from viflow_anomaly.checkpoint import load_evidence_head  # noqa: PLC0415
    from viflow_anomaly.runtime.torch_evidence import TorchEvidence  # noqa: PLC0415

    require_device(device)
    head, record = load_evidence_head(path)
    return LoadedEvidence(TorchEvidence(head, device=device), record)
