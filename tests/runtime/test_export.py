"""What an export carries, in both formats, and that a file is refused that is not its checkpoint's."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from viflow_anomaly.checkpoint import save_checkpoint
from viflow_anomaly.checkpoint_record import EXPORT_SUFFIXES, CheckpointRecord, bundled_checkpoint, read_checkpoint
from viflow_anomaly.config import DetectorConfig, ImageLimits, ModelConfig, RegionScore, RuntimeName
from viflow_anomaly.errors import CheckpointError, ConfigError, DatasetError, MissingDependencyError
from viflow_anomaly.export_samples import MAX_SAMPLES, network_samples
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.model.builder import build_model
from viflow_anomaly.runtime import quantisation
from viflow_anomaly.runtime.export import ExportFormat, export_head, export_network
from viflow_anomaly.runtime.exported import Feed
from viflow_anomaly.runtime.loading import load_evidence, load_runtime

for package, extra in (("openvino", "openvino"), ("onnxruntime", "onnxruntime"), ("onnxscript", "export")):
    pytest.importorskip(package, reason=f"the extra {extra!r} is not installed")

FORMATS: list[ExportFormat] = ["onnx", "openvino"]
SAMPLE = Path(__file__).parents[2] / "samples" / "drone"


def saved(folder: Path, seed: int = 0) -> Path:
    config = ModelConfig(preset="compact", hypotheses=1)
    path = folder / "net.safetensors"
    return save_checkpoint(path, build_model(config, seed=seed), config, name="net", version="7")


def metadata(path: Path) -> dict[str, str]:
    """As a program reads it that has nothing but the backend."""
    if path.suffix == ".onnx":
        from onnxruntime import InferenceSession  # noqa: PLC0415

        session = InferenceSession(path, providers=["CPUExecutionProvider"])
        return dict(session.get_modelmeta().custom_metadata_map)
    from openvino import Core  # noqa: PLC0415

    info = Core().read_model(path).get_rt_info()["framework"]
    return {str(key): str(value.astype(str)) for key, value in info.items()}


@pytest.mark.parametrize("file_format", FORMATS)
def test_a_network_says_what_a_program_must_know(file_format: ExportFormat, tmp_path: Path) -> None:
    path = saved(tmp_path)
    record = read_checkpoint(path)[1]
    found = metadata(export_network(path, file_format=file_format))
    named = {key: found[f"viflow.{key}"] for key in ("name", "version", "weights_sha256", "precision", "flow_stride")}
    assert named == {
        "name": "net",
        "version": "7",
        "weights_sha256": record.sha256,
        "precision": "f32",
        "flow_stride": "4",
    }
    assert DetectorConfig.model_validate_json(found["viflow.detector"]) == DetectorConfig()
    assert ModelConfig.model_validate_json(found["viflow.model"]) == record.model
    about = json.loads(found["viflow.preprocessing"])
    assert about["side_multiple_px"] == 32
    assert about["inputs"]["source"]["scale"] == pytest.approx(1 / 255)
    assert about["inputs"]["source"]["shape"][:2] == [1, 1]
    assert about["inputs"]["motion"]["shape"] == [1, 16, 6]
    assert about["motion_window"] == record.model.motion_window.model_dump(mode="json")


@pytest.mark.parametrize("file_format", FORMATS)
def test_a_head_says_how_its_regions_are_scored(file_format: ExportFormat, tmp_path: Path) -> None:
    out = tmp_path / ("head.onnx" if file_format == "onnx" else "head.xml")
    found = metadata(export_head(None, out, file_format=file_format))
    record = load_evidence(None, runtime="torch").record
    assert RegionScore.model_validate_json(found["viflow.region_score"]) == record.region_score
    about = json.loads(found["viflow.preprocessing"])
    assert tuple(about["inputs"]["geometric"]["cues"]) == record.geometric_cues
    assert (about["block_px"], about["side_multiple_px"]) == (4, 32)
    assert about["outputs"]["logits"]["shape"][2:] == about["inputs"]["photometric"]["shape"][2:]


def test_openvinos_own_format_runs_where_there_is_no_onnx_file(tmp_path: Path) -> None:
    path = saved(tmp_path)
    assert export_network(path, file_format="openvino") == tmp_path / "net.xml"
    assert (tmp_path / "net.bin").stat().st_size > 1000
    loaded = load_runtime(path, runtime="openvino")
    assert loaded.runtime.backend == ("openvino", "cpu", "f32")
    assert loaded.record.exports.keys() == {".xml"}
    assert loaded.record.onnx_sha256 is None


@pytest.mark.parametrize("altered", ["net.xml", "net.bin"])
def test_either_file_of_the_two_is_checked(altered: str, tmp_path: Path) -> None:
    path = saved(tmp_path)
    export_network(path, file_format="openvino")
    file = tmp_path / altered
    file.write_bytes(file.read_bytes()[:-1] + b"\x07")
    with pytest.raises(CheckpointError, match=f"export --checkpoint {path} --format openvino") as caught:
        load_runtime(path, runtime="openvino")
    assert caught.value.code == "export_stale"


@pytest.mark.parametrize("runtime", ["openvino", "onnxruntime"])
def test_an_export_of_other_weights_is_refused_even_where_the_record_names_it(
    runtime: RuntimeName, tmp_path: Path
) -> None:
    path, other = saved(tmp_path), saved(tmp_path / "other", seed=1)
    export_network(path)
    export_network(other)
    shutil.copy(other.with_suffix(".onnx"), path.with_suffix(".onnx"))
    values = json.loads(path.with_suffix(".json").read_text())
    values["onnx_sha256"] = json.loads(other.with_suffix(".json").read_text())["onnx_sha256"]
    path.with_suffix(".json").write_text(json.dumps(values))
    with pytest.raises(CheckpointError, match=f"of the tensors {values['sha256']}") as caught:
        load_runtime(path, runtime=runtime)
    assert caught.value.code == "export_stale"


@pytest.mark.parametrize("content", [b"", b"no network", b"\x80\x04pickle"])
def test_what_onnx_runtime_cannot_read_is_told(content: bytes, tmp_path: Path) -> None:
    path = saved(tmp_path)
    path.with_suffix(".onnx").write_bytes(content)
    values = json.loads(path.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps(values | {"onnx_sha256": sha256(content)}))
    with pytest.raises(CheckpointError, match="an ONNX network of this package") as caught:
        load_runtime(path, runtime="onnxruntime")
    assert caught.value.code == "checkpoint_corrupt"


def sha256(content: bytes) -> str:
    import hashlib  # noqa: PLC0415

    return hashlib.sha256(content).hexdigest()


def test_another_spelling_of_the_own_place_keeps_record_and_file_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = saved(tmp_path)
    monkeypatch.chdir(tmp_path)
    export_network(Path(path.name), out=path.with_suffix(".onnx"), file_format="onnx")
    load_runtime(path, runtime="onnxruntime")
    with pytest.raises(ConfigError) as caught:
        export_network(path, out=Path("net.int8.xml"), file_format="openvino")
    assert caught.value.code == "export_name"


def test_a_new_checkpoint_takes_all_old_exports_away(tmp_path: Path) -> None:
    path = saved(tmp_path)
    for suffix in (*EXPORT_SUFFIXES, ".bin", ".int8.bin"):
        path.with_suffix(suffix).write_bytes(b"old")
    saved(tmp_path, seed=1)
    assert {one.name for one in tmp_path.iterdir()} == {"net.safetensors", "net.json"}


def test_a_record_without_other_exports_is_as_it_was(tmp_path: Path) -> None:
    record = read_checkpoint(saved(tmp_path))[1]
    assert "exports" not in record.model_dump_json()
    both = record.with_export(".onnx", "a" * 64).with_export(".int8.xml", "b" * 64)
    again = CheckpointRecord.model_validate_json(both.model_dump_json())
    found = (again.export_sha256(".onnx"), again.export_sha256(".int8.xml"), again.export_sha256(".xml"))
    assert found == ("a" * 64, "b" * 64, None)


@pytest.mark.parametrize(("file_format", "name"), [("onnx", "n.xml"), ("openvino", "n.onnx"), ("openvino", "n.bin")])
def test_a_name_of_the_other_format_is_refused(file_format: ExportFormat, name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="the name of an") as caught:
        export_network(saved(tmp_path), tmp_path / name, file_format=file_format)
    assert caught.value.code == "export_name"


# --- int8


def calibration_samples() -> list[Feed]:
    rng = np.random.default_rng(0)
    return [
        {
            "source": rng.uniform(0, 1, (1, 1, 64, 96)).astype(np.float32),
            "motion": rng.normal(0, 0.1, (1, 16, 6)).astype(np.float32),
            "interval_s": np.array([0.05], np.float32),
        }
        for _ in range(4)
    ]


@pytest.mark.parametrize("file_format", FORMATS)
def test_int8_of_a_network_keeps_what_is_no_convolution(file_format: ExportFormat, tmp_path: Path) -> None:
    pytest.importorskip("nncf", reason="the extra 'int8' is not installed")
    out = tmp_path / ("n.onnx" if file_format == "onnx" else "n.xml")
    found = metadata(export_network(None, out, file_format=file_format, samples=calibration_samples()))
    assert found["viflow.precision"] == "int8"
    assert found["viflow.weights_sha256"] == read_checkpoint(bundled_checkpoint())[1].sha256
    kinds = operations(out)
    assert kinds.count("FakeQuantize" if file_format == "openvino" else "QuantizeLinear") >= 10
    assert "MatMul" in kinds or "Gemm" in kinds
    assert not quantised_products(out)


def operations(path: Path) -> list[str]:
    if path.suffix == ".onnx":
        import onnx  # noqa: PLC0415

        return [node.op_type for node in onnx.load(path).graph.node]
    from openvino import Core  # noqa: PLC0415

    return [one.get_type_name() for one in Core().read_model(path).get_ops()]


def quantised_products(path: Path) -> list[str]:
    """Products of matrices that take their input from a quantiser."""
    if path.suffix == ".onnx":
        import onnx  # noqa: PLC0415

        nodes = onnx.load(path).graph.node
        makers = {name: node.op_type for node in nodes for name in node.output}
        inputs = [(node, [makers.get(name) for name in node.input]) for node in nodes]
        return [
            node.name for node, kinds in inputs if node.op_type in ("MatMul", "Gemm") and "DequantizeLinear" in kinds
        ]
    from openvino import Core  # noqa: PLC0415

    found = []
    for one in Core().read_model(path).get_ops():
        kinds = [port.get_source_output().get_node().get_type_name() for port in one.inputs()]
        if one.get_type_name() == "MatMul" and "FakeQuantize" in kinds:
            found.append(one.get_friendly_name())
    return found


def test_int8_without_nncf_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(__import__("sys").modules, "nncf", None)
    with pytest.raises(MissingDependencyError, match=r"viflow-anomaly\[int8\]") as caught:
        quantisation.require_nncf()
    assert caught.value.code == "nncf_missing"


def test_samples_are_spread_over_the_recordings() -> None:
    model = read_checkpoint(bundled_checkpoint())[1].model
    samples = network_samples([SAMPLE], model, ImageLimits())
    assert 1 <= len(samples) <= MAX_SAMPLES
    for sample in samples:
        assert sample["source"].dtype == np.float32
        assert 0 <= sample["source"].min() < sample["source"].max() <= 1
        assert sample["motion"].shape == (1, 16, 6)
    means: list[Float32Array] = [sample["motion"].mean() for sample in samples]
    assert len(set(map(float, means))) == len(samples)


def test_recordings_without_a_pair_calibrate_nothing() -> None:
    model = read_checkpoint(bundled_checkpoint())[1].model
    with pytest.raises(DatasetError, match="expected pairs that can be used") as caught:
        network_samples([], model, ImageLimits())
    assert caught.value.code == "calibration_pairs_missing"
