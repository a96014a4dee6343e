"""A checkpoint as an ONNX file beside it, for OpenVINO, ONNX Runtime and other programs."""

from __future__ import annotations

import contextlib
import hashlib
import io
import logging
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from viflow_anomaly.checkpoint import load_checkpoint, load_evidence_head
from viflow_anomaly.checkpoint_record import (
    EvidenceRecord,
    TensorRecord,
    bundled_checkpoint,
    bundled_evidence_head,
    write_atomically,
    write_record,
)
from viflow_anomaly.config import EVIDENCE_BLOCK_PX, ModelConfig
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.model.layers import COARSEST_STRIDE
from viflow_anomaly.model.outputs import ViflowOutput
from viflow_anomaly.runtime import exported

OPSET = 20


class _Tensors(nn.Module):
    """The network with a flat tuple of outputs, as ONNX wants it."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        output: ViflowOutput = self.network(*inputs)
        return (output.flow_px,) if output.scene is None else (output.flow_px, *output.scene)


def export_onnx(path: Path | None, out: Path | None = None) -> Path:
    """Write ``NAME.onnx`` for any view size whose sides are multiples of 32; weights in float32.

    Beside its checkpoint, the export's checksum is noted in the checkpoint's record.

    Args:
        path: the checkpoint (None: the bundled one).
        out: where to (None: beside the checkpoint, where the detector looks for it).

    Raises:
        CheckpointError: as ``load_checkpoint``.
        ConfigError: ``export_unavailable``: the packages onnx and onnxscript are missing; ``export_name``: ``out`` is
            no .onnx file.
    """
    path = bundled_checkpoint() if path is None else path
    network, record = load_checkpoint(path)
    inputs = _example(record.model)
    metadata = {
        exported.MODEL_KEY: record.model.model_dump_json(),
        exported.FLOW_STRIDE_KEY: str(network(*inputs).stride),
    }
    return _write(path, out, record, metadata, lambda: _traced(network, inputs, fixed=record.model.preset == "paper"))


def export_evidence_onnx(path: Path | None, out: Path | None = None) -> Path:
    """``export_onnx`` of an evidence head (None: the bundled one), for any image size."""
    path = bundled_evidence_head() if path is None else path
    head, record = load_evidence_head(path)
    return _write(
        path, out, record, {exported.HEAD_KEY: record.head.model_dump_json()}, lambda: _traced_head(head, record)
    )


def _write(
    path: Path, out: Path | None, record: TensorRecord, metadata: Mapping[str, str], traced: Callable[[], Any]
) -> Path:
    try:
        import onnx  # noqa: PLC0415  # an extra
        import onnxscript  # noqa: F401, PLC0415
    except ImportError as err:
        raise ConfigError(
            "export: expected the packages onnx and onnxscript, found them missing: "
            "pip install 'viflow-anomaly[export]'",
            code="export_unavailable",
        ) from err
    out = path.with_suffix(".onnx") if out is None else out
    if out.suffix != ".onnx":
        raise ConfigError(
            f"export: expected the name of an .onnx file to write, found {str(out)!r}", code="export_name", field="out"
        )
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "network.onnx"
        traced().save(str(whole))
        model = onnx.load(str(whole))
    named = {exported.NAME_KEY: record.name, exported.VERSION_KEY: record.version, exported.WEIGHTS_KEY: record.sha256}
    _forget_the_machine(model)
    onnx.helper.set_model_props(model, {**named, **metadata})
    data = model.SerializeToString(deterministic=True)
    write_atomically(out, data)
    if out == path.with_suffix(".onnx"):
        write_record(path, record.model_copy(update={"onnx_sha256": hashlib.sha256(data).hexdigest()}))
    return out


def _forget_the_machine(model: Any) -> None:
    """The exporter notes for every node which lines of which files on this machine it came from."""
    graph = model.graph
    for part in (model, graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        del part.metadata_props[:]
        part.doc_string = ""


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """The exporter speaks of its own deprecations and of packages that nobody needs; errors still come through."""
    exporter = logging.getLogger("torch.onnx")
    level = exporter.level
    exporter.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        exporter.setLevel(level)


def _example(model: ModelConfig) -> tuple[torch.Tensor, ...]:
    view = model.view
    side = (view.crop_size, view.crop_size) if view.mode == "center_crop" else (224, 320)
    imu = (torch.zeros(1, model.motion_window.rows, 6), torch.full((1,), 0.05))
    motor = (torch.zeros(1, model.motor_numbers),) if model.motor_numbers else ()
    return torch.rand(1, 1, *side), *imu, *motor


def _traced(network: nn.Module, inputs: tuple[torch.Tensor, ...], *, fixed: bool) -> Any:
    shapes: Any = None
    if not fixed:
        height, width = torch.export.Dim("rows", min=1, max=256), torch.export.Dim("columns", min=1, max=256)
        fixed_ones: tuple[Any, ...] = ({},) * (len(inputs) - 1)
        shapes = (({2: COARSEST_STRIDE * height, 3: COARSEST_STRIDE * width}, *fixed_ones),)  # of *inputs
    scene = network(*inputs).scene is not None
    with _quiet(), torch.no_grad():
        return torch.onnx.export(
            _Tensors(network).eval(),
            inputs,
            dynamo=True,
            opset_version=OPSET,
            input_names=list(exported.INPUT_NAMES[: len(inputs)]),
            output_names=list(exported.SCENE_OUTPUTS if scene else exported.FLOW_OUTPUTS),
            dynamic_shapes=shapes,
            verbose=False,
            external_data=False,
        )


def _traced_head(head: nn.Module, record: EvidenceRecord) -> Any:
    side = COARSEST_STRIDE * 4
    photometric = torch.zeros(1, len(record.photometric_cues), side, 2 * side)
    geometric = torch.zeros(1, len(record.geometric_cues), side // EVIDENCE_BLOCK_PX, 2 * side // EVIDENCE_BLOCK_PX)
    rows, columns = torch.export.Dim("rows", min=1, max=1024), torch.export.Dim("columns", min=1, max=1024)
    step = COARSEST_STRIDE // EVIDENCE_BLOCK_PX
    shapes = (
        {2: COARSEST_STRIDE * rows, 3: COARSEST_STRIDE * columns},
        {2: step * rows, 3: step * columns},
    )
    with _quiet(), torch.no_grad():
        return torch.onnx.export(
            head.eval(),
            (photometric, geometric),
            dynamo=True,
            opset_version=OPSET,
            input_names=list(exported.HEAD_INPUTS),
            output_names=list(exported.HEAD_OUTPUTS),
            dynamic_shapes=shapes,
            verbose=False,
            external_data=False,
        )
