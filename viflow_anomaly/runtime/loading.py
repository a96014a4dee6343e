"""A checkpoint on disk becomes a runtime. Backends are imported when they are asked for, not before."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from viflow_anomaly.checkpoint_record import CheckpointRecord, bundled_checkpoint, read_checkpoint
from viflow_anomaly.config import RuntimeName
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.runtime.interface import Runtime


class LoadedRuntime(NamedTuple):
    """A network ready to run, and where it came from."""

    runtime: Runtime
    record: CheckpointRecord


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
    if path.suffix != ".safetensors":
        read_checkpoint(path)  # says what is wrong with the name
    exported = path.with_suffix(".onnx")
    missing = _what_openvino_lacks(exported, device)
    if runtime == "openvino" and missing:
        raise ConfigError(f"runtime: {missing}", code="runtime_unavailable", field="runtime")
    if runtime == "torch" or missing:
        return _torch(path, device, threads)
    from viflow_anomaly.runtime.openvino_runtime import OpenvinoRuntime  # noqa: PLC0415  # an extra, half a second

    _, record = read_checkpoint(path)
    return LoadedRuntime(OpenvinoRuntime(exported, record, threads=threads or 1), record)


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
