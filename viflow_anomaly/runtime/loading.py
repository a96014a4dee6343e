"""A checkpoint on disk becomes a runtime. Backends are imported when they are asked for, not before."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from viflow_anomaly.checkpoint_record import (
    CheckpointRecord,
    EvidenceRecord,
    ExportSuffix,
    bundled_checkpoint,
    bundled_evidence_head,
    read_checkpoint,
    read_tensors,
)
from viflow_anomaly.config import Precision, RuntimeName
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.runtime.exported import export_command, export_path, read_export
from viflow_anomaly.runtime.interface import EvidenceRuntime, Runtime


class LoadedRuntime(NamedTuple):
    """A network ready to run, and where it came from."""

    runtime: Runtime
    record: CheckpointRecord


class LoadedEvidence(NamedTuple):
    """An evidence head ready to run, and where it came from."""

    runtime: EvidenceRuntime
    record: EvidenceRecord


class _Wish(NamedTuple):
    """What a network is to be run by, and how."""

    runtime: RuntimeName
    device: str
    threads: int | None
    precision: Precision
    of_head: bool


def load_runtime(
    path: Path | None,
    *,
    runtime: RuntimeName = "auto",
    device: str = "cpu",
    threads: int | None = None,
    precision: Precision = "auto",
) -> LoadedRuntime:
    """Load a checkpoint (None: the bundled model).

    "auto" takes, on a CPU, OpenVINO or else ONNX Runtime where it is installed and an export lies beside the
    checkpoint, else torch.

    Args:
        path: a ``.safetensors`` file with its ``.json`` beside it.
        runtime: which backend.
        device: "cpu" or a torch device name; ONNX Runtime knows "cuda" and "cuda:N", too.
        threads: CPU threads of one prediction; None: torch's own number, one elsewhere.
        precision: "auto" is float32 on a CPU; torch on CUDA takes bfloat16.

    Raises:
        CheckpointError: as ``load_checkpoint``; ``export_stale`` for an export of other weights than the checkpoint's.
        ConfigError: ``device_unavailable``; ``runtime_unavailable`` for one that is not installed, has nothing exported
            to run, or does not know the device; ``precision_unavailable``.
    """
    path = bundled_checkpoint() if path is None else path
    wish = _Wish(runtime, device, threads, precision, of_head=False)
    chosen = _choose(path, wish)
    if chosen == "torch":
        return _torch(path, wish)
    _, record = read_checkpoint(path)
    if chosen == "openvino":
        from viflow_anomaly.runtime.openvino_runtime import OpenvinoRuntime  # noqa: PLC0415  # half a second

        export = read_export(path, record, _openvinos(path, precision))
        return LoadedRuntime(OpenvinoRuntime(export, record, threads=threads or 1, precision=precision), record)
    from viflow_anomaly.runtime.onnxruntime_runtime import OnnxruntimeRuntime  # noqa: PLC0415

    export = read_export(path, record, _onnx(precision))
    name = "int8" if precision == "int8" else "f32"
    return LoadedRuntime(
        OnnxruntimeRuntime(export, record, device=device, threads=threads or 1, precision=name), record
    )


def load_evidence(
    path: Path | None,
    *,
    runtime: RuntimeName = "auto",
    device: str = "cpu",
    threads: int | None = None,
    precision: Precision = "auto",
) -> LoadedEvidence:
    """Load an evidence head (None: the bundled one); arguments and errors as ``load_runtime``.

    "auto" is bfloat16 in OpenVINO where the CPU computes in it. torch takes the threads that ``load_runtime`` gave it.
    """
    path = bundled_evidence_head() if path is None else path
    wish = _Wish(runtime, device, threads, precision, of_head=True)
    chosen = _choose(path, wish)
    if chosen == "torch":
        return _torch_evidence(path, wish)
    _, record = read_tensors(path, EvidenceRecord)
    if chosen == "openvino":
        from viflow_anomaly.runtime.openvino_evidence import OpenvinoEvidence  # noqa: PLC0415

        export = read_export(path, record, _openvinos(path, precision))
        return LoadedEvidence(OpenvinoEvidence(export, record, threads=threads or 1, precision=precision), record)
    from viflow_anomaly.runtime.onnxruntime_evidence import OnnxruntimeEvidence  # noqa: PLC0415

    export = read_export(path, record, _onnx(precision))
    name = "int8" if precision == "int8" else "f32"
    return LoadedEvidence(
        OnnxruntimeEvidence(export, record, device=device, threads=threads or 1, precision=name), record
    )


def _choose(path: Path, wish: _Wish) -> RuntimeName:
    if path.suffix != ".safetensors":
        read_checkpoint(path)  # says what is wrong with the name
    if wish.runtime != "auto":
        problem = _problem(wish.runtime, path, wish)
        if problem is not None:
            raise problem
        return wish.runtime
    if wish.device != "cpu":
        return _choose(path, wish._replace(runtime="torch"))
    problems: dict[RuntimeName, ConfigError | None] = {}
    for name in _BY_SPEED:  # one after the other: asking a runtime imports it
        problems[name] = _problem(name, path, wish)
        if problems[name] is None:
            return name
    installed = [name for name in _BY_SPEED if name == "torch" or find_spec(name) is not None]
    told = problems[installed[0]]
    assert told is not None
    raise told


_BY_SPEED: tuple[RuntimeName, ...] = ("openvino", "onnxruntime", "torch")


def _problem(runtime: RuntimeName, path: Path, wish: _Wish) -> ConfigError | None:
    """Why a runtime cannot do as it is asked; None: nothing is known against it."""
    if runtime == "torch":
        return _no_precision("torch", wish, "f32", "bf16")
    return _not_installed(runtime, wish) or _nothing_to_run(runtime, path, wish)


def _import_problem(runtime: RuntimeName) -> str | None:
    """Why an installed package cannot be imported (a library of the system is missing, say); None: it can."""
    try:
        import_module(runtime)
    except Exception as err:  # whatever a foreign package raises when it loads
        return f"{type(err).__name__}: {err}"
    return None


def _not_installed(runtime: RuntimeName, wish: _Wish) -> ConfigError | None:
    """Or it knows neither the device nor the precision."""
    package = {"openvino": "OpenVINO", "onnxruntime": "ONNX Runtime"}[runtime]
    if find_spec(runtime) is not None and (problem := _import_problem(runtime)) is not None:
        return _missing(f"expected {package} for the runtime {runtime!r}, found that it cannot be loaded: {problem}")
    if find_spec(runtime) is None:
        return _missing(
            f"expected {package} for the runtime {runtime!r}, found it missing: pip install 'viflow-anomaly[{runtime}]'"
        )
    if runtime == "openvino" and wish.device != "cpu":
        return _missing(f"expected the device 'cpu' for OpenVINO, found {wish.device!r}")
    if runtime == "onnxruntime" and wish.precision == "bf16":
        return _no_precision("onnxruntime", wish, "f32")
    return None


def _nothing_to_run(runtime: RuntimeName, path: Path, wish: _Wish) -> ConfigError | None:
    suffix = _openvinos(path, wish.precision) if runtime == "openvino" else _onnx(wish.precision)
    export = export_path(path, suffix)
    if not export.exists():
        if suffix == ".int8.onnx":  # which the command line does not write
            return _no_precision("onnxruntime", wish, "f32")
        command = export_command(path, export, of_head=wish.of_head)
        return _missing(f"expected {export} ({command} writes it), found no such file")
    return None


def _missing(problem: str) -> ConfigError:
    return ConfigError(f"runtime: {problem}", code="runtime_unavailable", field="runtime")


def _no_precision(runtime: str, wish: _Wish, *known: str) -> ConfigError | None:
    if wish.precision in ("auto", *known):
        return None
    return ConfigError(
        f"precision: expected one of the runtime {runtime!r}, {', '.join(known)} or auto, found {wish.precision!r}",
        code="precision_unavailable",
        field="precision",
    )


def _openvinos(path: Path, precision: Precision) -> ExportSuffix:
    """OpenVINO takes either format, but for int8: it computes NAME.int8.onnx otherwise than ONNX Runtime does."""
    if precision == "int8":
        return ".int8.xml"
    only_xml = export_path(path, ".xml").exists() and not export_path(path, ".onnx").exists()
    return ".xml" if only_xml else ".onnx"


def _onnx(precision: Precision) -> ExportSuffix:
    return ".int8.onnx" if precision == "int8" else ".onnx"


def _torch(path: Path, wish: _Wish) -> LoadedRuntime:
    import torch  # noqa: PLC0415  # a second of start-up

    from viflow_anomaly.batch import require_device  # noqa: PLC0415
    from viflow_anomaly.checkpoint import load_checkpoint  # noqa: PLC0415
    from viflow_anomaly.runtime.torch_runtime import TorchRuntime  # noqa: PLC0415

    if wish.threads is not None:
        torch.set_num_threads(wish.threads)
    require_device(wish.device)
    network, record = load_checkpoint(path)
    return LoadedRuntime(TorchRuntime(network, device=wish.device, precision=wish.precision), record)


def _torch_evidence(path: Path, wish: _Wish) -> LoadedEvidence:
    from viflow_anomaly.batch import require_device  # noqa: PLC0415
    from viflow_anomaly.checkpoint import load_evidence_head  # noqa: PLC0415
    from viflow_anomaly.runtime.torch_evidence import TorchEvidence  # noqa: PLC0415

    require_device(wish.device)
    head, record = load_evidence_head(path)
    return LoadedEvidence(TorchEvidence(head, device=wish.device, precision=wish.precision), record)
