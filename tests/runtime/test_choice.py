"""Which runtime "auto" takes, and what a wish that cannot be met is answered with."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest

from viflow_anomaly.checkpoint import save_checkpoint
from viflow_anomaly.checkpoint_record import bundled_checkpoint, bundled_evidence_head
from viflow_anomaly.config import ModelConfig, Precision, RuntimeName
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.model.builder import build_model
from viflow_anomaly.runtime import loading
from viflow_anomaly.runtime.loading import load_evidence, load_runtime

pytest.importorskip("openvino", reason="the extra 'openvino' is not installed")
onnxruntime = pytest.importorskip("onnxruntime", reason="the extra 'onnxruntime' is not installed")


def hide(monkeypatch: pytest.MonkeyPatch, *packages: str) -> None:
    monkeypatch.setattr(loading, "find_spec", lambda name: None if name in packages else find_spec(name))


@pytest.mark.parametrize(
    ("missing", "taken"),
    [
        ((), "openvino"),
        (("openvino",), "onnxruntime"),
        (("onnxruntime",), "openvino"),
        (("openvino", "onnxruntime"), "torch"),
    ],
)
def test_auto_takes_the_fastest_that_is_installed(
    missing: tuple[str, ...], taken: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    hide(monkeypatch, *missing)
    assert load_runtime(None).runtime.backend == (taken, "cpu", "f32")
    assert load_evidence(None).runtime.backend.runtime == taken


@pytest.mark.parametrize("runtime", ["openvino", "onnxruntime"])
def test_a_missing_package_is_named(runtime: RuntimeName, monkeypatch: pytest.MonkeyPatch) -> None:
    hide(monkeypatch, runtime)
    with pytest.raises(ConfigError, match=rf"pip install 'viflow-anomaly\[{runtime}\]'") as caught:
        load_runtime(None, runtime=runtime)
    assert (caught.value.code, caught.value.field) == ("runtime_unavailable", "runtime")


def test_a_checkpoint_without_an_export_runs_in_torch(tmp_path: Path) -> None:
    config = ModelConfig(preset="compact", hypotheses=1)
    path = save_checkpoint(tmp_path / "m.safetensors", build_model(config), config, name="m", version="1")
    assert load_runtime(path).runtime.backend.runtime == "torch"
    with pytest.raises(ConfigError, match=f"viflow-anomaly export --checkpoint {path} writes it") as caught:
        load_runtime(path, runtime="onnxruntime")
    assert caught.value.code == "runtime_unavailable"


@pytest.mark.parametrize(
    ("runtime", "command"),
    [
        ("openvino", "--format openvino --int8"),
        ("auto", "--format openvino --int8"),
    ],
)
def test_int8_that_was_not_exported_says_how(runtime: RuntimeName, command: str) -> None:
    head = bundled_evidence_head()
    with pytest.raises(
        ConfigError, match=f"viflow-anomaly export --evidence-head {head} {command} writes it"
    ) as caught:
        load_evidence(None, runtime=runtime, precision="int8")
    assert caught.value.code == "runtime_unavailable"


@pytest.mark.parametrize(
    ("runtime", "precision", "known"),
    [
        ("torch", "int8", "f32, bf16 or auto"),
        ("onnxruntime", "bf16", "f32 or auto"),
        ("onnxruntime", "int8", "f32 or auto"),
    ],
)
def test_a_precision_that_a_runtime_has_not_is_refused(runtime: RuntimeName, precision: Precision, known: str) -> None:
    with pytest.raises(ConfigError, match=f"one of the runtime '{runtime}', {known}.*found '{precision}'") as caught:
        load_evidence(None, runtime=runtime, precision=precision)
    assert (caught.value.code, caught.value.field) == ("precision_unavailable", "precision")


def test_bfloat16_needs_a_processor_that_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    from viflow_anomaly.runtime import openvino_network  # noqa: PLC0415  # an extra

    class OldProcessor:
        def __init__(self) -> None:
            self.core = core()

        def read_model(self, *files: bytes) -> object:
            return self.core.read_model(*files)

        def get_property(self, device: str, name: str) -> list[str]:
            return ["FP32", "INT8"]

    core = openvino_network.openvino.Core
    monkeypatch.setattr(openvino_network.openvino, "Core", OldProcessor)
    assert load_evidence(None, runtime="openvino").runtime.backend.precision == "f32"
    with pytest.raises(ConfigError, match="a CPU that computes in bfloat16") as caught:
        load_evidence(None, runtime="openvino", precision="bf16")
    assert caught.value.code == "precision_unavailable"


@pytest.mark.parametrize("device", ["cuda", "cuda:1"])
def test_onnx_runtime_without_cuda_says_so(device: str) -> None:
    if "CUDAExecutionProvider" in onnxruntime.get_available_providers():
        pytest.skip("this ONNX Runtime has CUDA")
    with pytest.raises(ConfigError, match=f"compute on '{device}'.*pip install onnxruntime-gpu") as caught:
        load_runtime(None, runtime="onnxruntime", device=device)
    assert (caught.value.code, caught.value.field) == ("device_unavailable", "device")


def test_a_provider_that_does_not_start_is_no_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without a GPU, and the package that was built for one."""
    start = onnxruntime.InferenceSession

    def on_the_cpu_after_all(data: bytes, options: object, providers: list[object]) -> object:
        assert providers == [("CUDAExecutionProvider", {"device_id": 2})]
        return start(data, options, providers=["CPUExecutionProvider"])

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CUDAExecutionProvider"])
    monkeypatch.setattr(onnxruntime, "InferenceSession", on_the_cpu_after_all)
    with pytest.raises(ConfigError, match="to start on 'cuda:2'") as caught:
        load_evidence(None, runtime="onnxruntime", device="cuda:2")
    assert caught.value.code == "device_unavailable"


@pytest.mark.parametrize("device", ["gpu", "cuda:x", "cuda:", "cpu:0", ""])
def test_onnx_runtime_knows_two_kinds_of_devices(device: str) -> None:
    with pytest.raises(ConfigError, match="expected 'cpu', 'cuda' or 'cuda:N'") as caught:
        load_runtime(None, runtime="onnxruntime", device=device)
    assert caught.value.code == "device_unavailable"


def test_another_device_than_the_cpu_is_torchs_by_itself() -> None:
    with pytest.raises(ConfigError, match="found 'nonsense'") as caught:
        load_runtime(None, device="nonsense")
    assert caught.value.code == "device_unavailable"


def test_a_session_has_the_threads_asked_for_and_none_spins(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    start = onnxruntime.InferenceSession

    def watched(data: bytes, options: object, providers: list[object]) -> object:
        seen.append(options)
        return start(data, options, providers=providers)

    monkeypatch.setattr(onnxruntime, "InferenceSession", watched)
    load_runtime(bundled_checkpoint(), runtime="onnxruntime", threads=2)
    (options,) = seen
    assert options.intra_op_num_threads == 2
    assert options.get_session_config_entry("session.intra_op.allow_spinning") == "0"


def test_a_detector_says_what_computes_it() -> None:
    detector = AnomalyDetector.from_checkpoint(runtime="onnxruntime", network_precision="f32")
    assert detector.execution.as_mapping() == {
        "network": {"runtime": "onnxruntime", "device": "cpu", "precision": "f32"},
        "evidence": {"runtime": "onnxruntime", "device": "cpu", "precision": "f32"},
    }
    alone = detector.with_config(detector.config.model_copy(update={"evidence": "residual"}))
    assert alone.execution.evidence is None
