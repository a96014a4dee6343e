"""Networks as ONNX graphs, traced by torch: any size of their input where the preset allows it."""

from __future__ import annotations

import contextlib
import io
import logging
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import nn

from viflow_anomaly.checkpoint_record import EvidenceRecord
from viflow_anomaly.config import EVIDENCE_BLOCK_PX, ModelConfig
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


def flow_stride(network: nn.Module, model: ModelConfig) -> int:
    """View pixels for one cell of the network's flow."""
    return int(network(*_example(model)).stride)


def trace_network(network: nn.Module, model: ModelConfig) -> Any:
    """The ONNX model of a VIFlow network, for any view whose sides are multiples of 32 (preset ``paper``: its crop)."""
    inputs = _example(model)
    shapes: Any = None
    if model.preset != "paper":
        height, width = torch.export.Dim("rows", min=1, max=256), torch.export.Dim("columns", min=1, max=256)
        fixed_ones: tuple[Any, ...] = ({},) * (len(inputs) - 1)
        shapes = (({2: COARSEST_STRIDE * height, 3: COARSEST_STRIDE * width}, *fixed_ones),)  # of *inputs
    scene = network(*inputs).scene is not None
    outputs = exported.SCENE_OUTPUTS if scene else exported.FLOW_OUTPUTS
    return _traced(_Tensors(network), inputs, exported.INPUT_NAMES[: len(inputs)], outputs, shapes)


def trace_head(head: nn.Module, record: EvidenceRecord) -> Any:
    """The ONNX model of an evidence head, for any image whose padded sides are multiples of 32."""
    side = COARSEST_STRIDE * 4
    photometric = torch.zeros(1, len(record.photometric_cues), side, 2 * side)
    geometric = torch.zeros(1, len(record.geometric_cues), side // EVIDENCE_BLOCK_PX, 2 * side // EVIDENCE_BLOCK_PX)
    rows, columns = torch.export.Dim("rows", min=1, max=1024), torch.export.Dim("columns", min=1, max=1024)
    step = COARSEST_STRIDE // EVIDENCE_BLOCK_PX
    shapes = (
        {2: COARSEST_STRIDE * rows, 3: COARSEST_STRIDE * columns},
        {2: step * rows, 3: step * columns},
    )
    return _traced(head, (photometric, geometric), exported.HEAD_INPUTS, exported.HEAD_OUTPUTS, shapes)


def _example(model: ModelConfig) -> tuple[torch.Tensor, ...]:
    view = model.view
    side = (view.crop_size, view.crop_size) if view.mode == "center_crop" else (224, 320)
    imu = (torch.zeros(1, model.motion_window.rows, 6), torch.full((1,), 0.05))
    motor = (torch.zeros(1, model.motor_numbers),) if model.motor_numbers else ()
    return torch.rand(1, 1, *side), *imu, *motor


def _traced(
    network: nn.Module,
    inputs: tuple[torch.Tensor, ...],
    input_names: Sequence[str],
    output_names: Sequence[str],
    shapes: Any,
) -> Any:
    import onnx  # noqa: PLC0415  # an extra

    with _quiet(), torch.no_grad(), tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "network.onnx"
        torch.onnx.export(
            network.eval(),
            inputs,
            dynamo=True,
            opset_version=OPSET,
            input_names=list(input_names),
            output_names=list(output_names),
            dynamic_shapes=shapes,
            verbose=False,
            external_data=False,
        ).save(str(whole))  # type: ignore[union-attr]
        return onnx.load(str(whole))


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
