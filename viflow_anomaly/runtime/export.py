"""A checkpoint as a file for other runtimes and programs: ONNX, or OpenVINO's own format; in float32 or in int8.

Beside its checkpoint, where the detector looks for it, the export's checksum is noted in the checkpoint's record. What
another program must know (sizes, scaling, names, thresholds, which weights) is in the file's metadata; docs/runtimes.md
lists it.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from viflow_anomaly.checkpoint import load_checkpoint, load_evidence_head
from viflow_anomaly.checkpoint_record import (
    CheckpointRecord,
    EvidenceRecord,
    ExportSuffix,
    TensorRecord,
    bundled_checkpoint,
    bundled_evidence_head,
    write_atomically,
    write_record,
)
from viflow_anomaly.config import EVIDENCE_BLOCK_PX, DetectorConfig
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.model.layers import COARSEST_STRIDE
from viflow_anomaly.runtime import exported
from viflow_anomaly.runtime.export_trace import flow_stride, trace_head, trace_network
from viflow_anomaly.runtime.exported import Feed
from viflow_anomaly.runtime.quantisation import quantised_onnx, quantised_openvino

ExportFormat = Literal["onnx", "openvino"]


def export_network(
    path: Path | None, out: Path | None = None, *, file_format: ExportFormat = "onnx", samples: Sequence[Feed] = ()
) -> Path:
    """Write a VIFlow network for any view whose sides are multiples of 32 (preset ``paper``: for its crop).

    Args:
        path: the checkpoint (None: the bundled one).
        out: where to, .onnx or .xml by the format (None: beside the checkpoint).
        file_format: "onnx", or OpenVINO's: an .xml, and its weights in the .bin beside it.
        samples: as ``exported.network_feed`` gives them; where there are any, convolutions become int8, calibrated on
            them.

    Returns:
        The .onnx or .xml.

    Raises:
        CheckpointError: as ``load_checkpoint``.
        ConfigError: ``export_unavailable``: packages are missing; ``export_name``: ``out`` ends otherwise.
        MissingDependencyError: ``nncf_missing``.
    """
    path = bundled_checkpoint() if path is None else path
    suffix, out = _place(path, out, file_format, int8=bool(samples))
    network, record = load_checkpoint(path)
    metadata = {
        exported.MODEL_KEY: record.model.model_dump_json(),
        exported.FLOW_STRIDE_KEY: str(flow_stride(network, record.model)),
    }
    model = trace_network(network, record.model)
    about = {**metadata, exported.PREPROCESSING_KEY: _network_preprocessing(model, record)}
    return _write(path, out, suffix, record, model, about, samples)


def export_head(
    path: Path | None, out: Path | None = None, *, file_format: ExportFormat = "onnx", samples: Sequence[Feed] = ()
) -> Path:
    """``export_network`` of an evidence head (None: the bundled one), for any image size; samples are cues by name."""
    path = bundled_evidence_head() if path is None else path
    suffix, out = _place(path, out, file_format, int8=bool(samples))
    head, record = load_evidence_head(path)
    model = trace_head(head, record)
    metadata = {
        exported.HEAD_KEY: record.head.model_dump_json(),
        exported.REGION_SCORE_KEY: record.region_score.model_dump_json(),
        exported.PREPROCESSING_KEY: _head_preprocessing(model, record),
    }
    return _write(path, out, suffix, record, model, metadata, samples)


def _place(path: Path, out: Path | None, file_format: ExportFormat, *, int8: bool) -> tuple[ExportSuffix, Path]:
    """What the export is called and where it goes, before anything is computed."""
    wanted = {"onnx": ("onnx", "onnxscript"), "openvino": ("onnx", "onnxscript", "openvino")}[file_format]
    for package in wanted:
        try:
            __import__(package)
        except ImportError as err:
            extra = "openvino" if package == "openvino" else "export"
            raise ConfigError(
                f"export: expected the packages {', '.join(wanted)}, found {package} missing: "
                f"pip install 'viflow-anomaly[{extra}]'",
                code="export_unavailable",
            ) from err
    suffixes: dict[tuple[ExportFormat, bool], ExportSuffix] = {
        ("onnx", False): ".onnx",
        ("onnx", True): ".int8.onnx",
        ("openvino", False): ".xml",
        ("openvino", True): ".int8.xml",
    }
    suffix = suffixes[file_format, int8]
    out = exported.export_path(path, suffix) if out is None else out
    ending = suffix[suffix.rindex(".") :]
    if out.suffix != ending:
        raise ConfigError(
            f"export: expected the name of an {ending} file to write, found {str(out)!r}",
            code="export_name",
            field="out",
        )
    others = {one for one in suffixes.values() if one != suffix}
    if out.resolve() in {exported.export_path(path, one).resolve() for one in others}:
        raise ConfigError(
            f"export: expected another name than that of the checkpoint's {''.join(out.suffixes[-2:])} export, found "
            f"{str(out)!r}",
            code="export_name",
            field="out",
        )
    return suffix, out


def _write(
    path: Path,
    out: Path,
    suffix: ExportSuffix,
    record: TensorRecord,
    model: Any,
    metadata: Mapping[str, str],
    samples: Sequence[Feed],
) -> Path:
    import onnx  # noqa: PLC0415  # an extra

    about = {
        exported.NAME_KEY: record.name,
        exported.VERSION_KEY: record.version,
        exported.WEIGHTS_KEY: record.sha256,
        exported.DETECTOR_KEY: DetectorConfig().model_dump_json(),
        exported.PRECISION_KEY: "int8" if samples else "f32",
        **metadata,
    }
    if samples and out.suffix == ".onnx":
        model = quantised_onnx(model, samples)
    _forget_the_machine(model)
    onnx.helper.set_model_props(model, about)
    data, weights = model.SerializeToString(deterministic=True), None
    if out.suffix == ".xml":
        data, weights = _as_openvino(data, samples)
        write_atomically(exported.weights_path(out), weights)
    write_atomically(out, data)
    if out.resolve() == exported.export_path(path, suffix).resolve():
        write_record(path, record.with_export(suffix, exported.checksum(data, weights)))
    return out


def _as_openvino(data: bytes, samples: Sequence[Feed]) -> tuple[bytes, bytes]:
    """The .xml and the .bin of an ONNX model; its metadata goes along."""
    import openvino  # noqa: PLC0415  # an extra

    model = openvino.Core().read_model(data)
    if samples:
        model = quantised_openvino(model, samples)
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "network.xml"
        openvino.save_model(model, whole, compress_to_fp16=False)
        return whole.read_bytes(), exported.weights_path(whole).read_bytes()


def _forget_the_machine(model: Any) -> None:
    """The exporter notes for every node which lines of which files on this machine it came from."""
    graph = model.graph
    for part in (model, graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        del part.metadata_props[:]
        part.doc_string = ""


def _network_preprocessing(model: Any, record: CheckpointRecord) -> str:
    """What the inputs are, for who runs the file without this package."""
    meanings: dict[str, dict[str, object]] = {
        "source": {"unit": "gray level / 255", "scale": 1 / 255, "of": "view of the source image"},
        "motion": {"unit": "rad/s (3), m/s^2 (3)", "layout": record.model.motion_window.layout},
        "interval_s": {"unit": "s", "of": "source to target image"},
        "motor": {"of": record.model.motion_inputs},
    }
    fixed = record.model.preset == "paper"
    about = {
        "inputs": {name: {**meanings[name], "shape": shape} for name, shape in _shapes(model.graph.input).items()},
        "outputs": {name: {"shape": shape} for name, shape in _shapes(model.graph.output).items()},
        "view": record.model.view.model_dump(mode="json"),
        "motion_window": record.model.motion_window.model_dump(mode="json"),
        "side_multiple_px": None if fixed else COARSEST_STRIDE,
    }
    return json.dumps(about)


def _head_preprocessing(model: Any, record: EvidenceRecord) -> str:
    cues = {"photometric": record.photometric_cues, "geometric": record.geometric_cues}
    shapes = _shapes(model.graph.input)
    about = {
        "inputs": {name: {"unit": "bounded to -1..1", "cues": cues[name], "shape": shapes[name]} for name in cues},
        "outputs": {name: {"shape": shape} for name, shape in _shapes(model.graph.output).items()},
        "block_px": EVIDENCE_BLOCK_PX,
        "side_multiple_px": COARSEST_STRIDE,
    }
    return json.dumps(about)


def _shapes(ports: Any) -> dict[str, list[int | str]]:
    """Of an ONNX graph's inputs or outputs: numbers, and expressions where the size is free."""
    return {port.name: [axis.dim_param or axis.dim_value for axis in port.type.tensor_type.shape.dim] for port in ports}
