"""Every runtime answers as torch does, and says clearly why it cannot run."""

from __future__ import annotations

import hashlib
import json
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from traced_once import traced_anew
from worlds import make_world, textured_image

from viflow_anomaly.checkpoint import save_checkpoint
from viflow_anomaly.config import ModelConfig, MotionWindowConfig, RuntimeName, ViewConfig
from viflow_anomaly.detection import to_json
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import CheckpointError, ConfigError
from viflow_anomaly.model.builder import build_model
from viflow_anomaly.model_input import ModelInput, prepare
from viflow_anomaly.runtime import export as export_module
from viflow_anomaly.runtime import loading
from viflow_anomaly.runtime.export import export_network
from viflow_anomaly.runtime.loading import load_runtime
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples

pytest.importorskip("openvino", reason="the extra 'openvino' is not installed")
pytest.importorskip("onnxruntime", reason="the extra 'onnxruntime' is not installed")
pytest.importorskip("onnxscript", reason="the extra 'export' is not installed")

MAX_FLOW_DIFFERENCE_PX = 1e-3
CONFIG_AT_232_PX = ModelConfig(preset="compact", hypotheses=4, view=ViewConfig(focal_px=232.0)).model_dump(mode="json")
RUNTIMES: tuple[RuntimeName, ...] = ("torch", "openvino", "onnxruntime")
PRESETS: list[Literal["compact", "calibrated"]] = ["compact", "calibrated"]


def save(folder: Path, preset: Literal["paper", "compact", "calibrated"], **more: object) -> Path:
    config = ModelConfig.model_validate({"preset": preset, "hypotheses": 4, **more})
    path = folder / f"{preset}.safetensors"
    return save_checkpoint(path, build_model(config, seed=2), config, name=preset, version="3")


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("exported")
    paths = {preset: save(folder, preset) for preset in PRESETS}
    for path in paths.values():
        assert export_network(path) == path.with_suffix(".onnx")
    return paths


def change_record(path: Path, **changes: object) -> None:
    record = path.with_suffix(".json")
    record.write_text(json.dumps(json.loads(record.read_text()) | changes))


def frame_pair(height: int = 128, width: int = 192) -> FramePair:
    world = make_world()
    imu = ImuSamples(world.imu.timestamps_ns, world.imu.gyro_rad_s + 0.2, world.imu.accel_m_s2)
    images = [textured_image(width, height, seed=seed) for seed in (1, 1)]
    images[1] = np.roll(images[1], 2, axis=1)
    frames = [Frame(int(world.frame_timestamps_ns[k]), image) for k, image in zip((1, 2), images, strict=True)]
    return FramePair(frames[0], frames[1], imu, None)


def model_input(height: int, width: int) -> ModelInput:
    return prepare(frame_pair(height, width), ModelConfig())


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("runtime", RUNTIMES[1:])
@pytest.mark.parametrize(("height", "width"), [(128, 192), (128, 128), (64, 96), (33, 65)])
def test_every_runtime_gives_torchs_flow(
    exported: dict[str, Path], preset: str, runtime: RuntimeName, height: int, width: int
) -> None:
    one = model_input(height, width)
    reference = load_runtime(exported[preset], runtime="torch").runtime
    fast = load_runtime(exported[preset], runtime=runtime).runtime
    assert (reference.backend.runtime, fast.backend.runtime) == ("torch", runtime)
    expected, found = reference.predict(one), fast.predict(one)
    assert found.stride == expected.stride
    np.testing.assert_allclose(found.flow_px, expected.flow_px, atol=MAX_FLOW_DIFFERENCE_PX)
    assert (found.scene is None) == (expected.scene is None) == (preset == "compact")
    if found.scene is not None and expected.scene is not None:
        for ours, theirs in zip(found.scene, expected.scene, strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-4)


@pytest.mark.parametrize("rate_rad_s", [0.0, 1e-9, 1e-6, 1e-4, 1e-2, 1.0, 30.0])
@pytest.mark.parametrize("preset", PRESETS)
def test_any_turn_is_the_same_and_standing_still_is_a_number(
    exported: dict[str, Path], preset: str, rate_rad_s: float
) -> None:
    one = model_input(64, 96)
    values = one.window.values * np.float32(0)
    values[:, 1] = rate_rad_s
    values[:, 5] = 9.81
    turning = replace(one, window=replace(one.window, values=values))
    flows = [load_runtime(exported[preset], runtime=name).runtime.predict(turning).flow_px for name in RUNTIMES]
    assert np.isfinite(flows[0]).all()
    for flow in flows[1:]:
        np.testing.assert_allclose(flow, flows[0], rtol=1e-4, atol=MAX_FLOW_DIFFERENCE_PX)


@pytest.mark.parametrize("preset", PRESETS)
def test_the_detections_are_the_same(exported: dict[str, Path], preset: str) -> None:
    detectors = [AnomalyDetector.from_checkpoint(exported[preset], runtime=name) for name in RUNTIMES]
    first, *others = (detector.detect(frame_pair()) for detector in detectors)
    for other in others:
        assert [(roi.bbox, roi.label) for roi in first.rois] == [(roi.bbox, roi.label) for roi in other.rois]
        assert first.model == other.model


def test_auto_takes_openvino_where_there_is_an_export(exported: dict[str, Path], tmp_path: Path) -> None:
    assert load_runtime(exported["compact"]).runtime.backend.runtime == "openvino"
    assert load_runtime(save(tmp_path, "compact")).runtime.backend.runtime == "torch"


def test_auto_takes_torch_where_openvino_is_missing(exported: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loading, "find_spec", lambda _: None)
    assert load_runtime(exported["compact"]).runtime.backend.runtime == "torch"
    with pytest.raises(ConfigError, match=r"pip install 'viflow-anomaly\[openvino\]'") as caught:
        load_runtime(exported["compact"], runtime="openvino")
    assert caught.value.code == "runtime_unavailable"


def test_openvino_without_an_export_or_on_another_device_is_refused(exported: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="viflow-anomaly export") as caught:
        load_runtime(save(tmp_path, "compact"), runtime="openvino")
    assert caught.value.code == "runtime_unavailable"
    with pytest.raises(ConfigError, match="expected the device 'cpu'") as caught:
        load_runtime(exported["compact"], runtime="openvino", device="cuda")
    assert caught.value.code == "runtime_unavailable"


def test_an_export_of_other_weights_is_stale(exported: dict[str, Path], tmp_path: Path) -> None:
    path = save(tmp_path, "compact")
    path.with_suffix(".onnx").write_bytes(exported["calibrated"].with_suffix(".onnx").read_bytes())
    with pytest.raises(CheckpointError, match="viflow-anomaly export --checkpoint") as caught:
        load_runtime(path)
    assert caught.value.code == "export_stale"


def test_an_export_of_another_configuration_is_refused(exported: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "compact.safetensors"
    for suffix in (".safetensors", ".onnx", ".json"):
        path.with_suffix(suffix).write_bytes(exported["compact"].with_suffix(suffix).read_bytes())
    change_record(path, model=CONFIG_AT_232_PX)
    with pytest.raises(CheckpointError, match="expected the model configuration") as caught:
        load_runtime(path)
    assert caught.value.code == "checkpoint_corrupt"


def test_a_new_checkpoint_takes_the_old_export_away(tmp_path: Path) -> None:
    path = save(tmp_path, "compact")
    export_network(path)
    save(tmp_path, "compact")
    assert not path.with_suffix(".onnx").exists()
    assert load_runtime(path).runtime.backend.runtime == "torch"


def test_a_foreign_network_is_refused(exported: dict[str, Path], tmp_path: Path) -> None:
    """Even where the record names it."""
    onnx = pytest.importorskip("onnx")
    path = save(tmp_path, "compact")
    model = onnx.load(str(exported["compact"].with_suffix(".onnx")))
    del model.metadata_props[:]
    for content in (model.SerializeToString(), b"no network at all"):
        path.with_suffix(".onnx").write_bytes(content)
        change_record(path, onnx_sha256=hashlib.sha256(content).hexdigest())
        with pytest.raises(CheckpointError, match="an ONNX network of this package") as caught:
            load_runtime(path)
        assert caught.value.code == "checkpoint_corrupt"


def test_an_altered_export_is_refused(exported: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "compact.safetensors"
    for suffix in (".safetensors", ".onnx", ".json"):
        path.with_suffix(suffix).write_bytes(exported["compact"].with_suffix(suffix).read_bytes())
    whole = path.with_suffix(".onnx").read_bytes()
    for content in (b"", b"no network", b"\x80\x04pickle", whole[: len(whole) // 2], whole[:-1] + b"\x01"):
        path.with_suffix(".onnx").write_bytes(content)
        with pytest.raises(CheckpointError, match="altered, or older than the checkpoint") as caught:
            load_runtime(path)
        assert caught.value.code == "export_stale"


def test_an_export_elsewhere_is_not_named(exported: dict[str, Path], tmp_path: Path) -> None:
    path = save(tmp_path, "compact")
    before = path.with_suffix(".json").read_bytes()
    export_network(path, tmp_path / "elsewhere" / "other.onnx")
    assert path.with_suffix(".json").read_bytes() == before


@pytest.mark.parametrize("name", ["m.safetensors", "m.json", "m", ""])
def test_an_export_never_overwrites_anything_else(tmp_path: Path, name: str) -> None:
    path = save(tmp_path, "compact")
    before = path.read_bytes()
    with pytest.raises(ConfigError) as caught:
        export_network(path, Path(name) if not name else tmp_path / name)
    assert caught.value.code == "export_name"
    assert path.read_bytes() == before


@pytest.mark.parametrize("runtime", RUNTIMES[1:])
def test_threads_share_a_runtime_and_get_the_serial_answers(exported: dict[str, Path], runtime: RuntimeName) -> None:
    detector = AnomalyDetector.from_checkpoint(exported["calibrated"], runtime=runtime)
    pairs = [frame_pair(height, 128) for height in (64, 96, 128)] * 4
    serial = [to_json(replace(detector.detect(one), timings_ms={})) for one in pairs]
    with ThreadPoolExecutor(4) as pool:
        threaded = [to_json(replace(one, timings_ms={})) for one in pool.map(detector.detect, pairs)]
    assert threaded == serial


def test_more_sizes_than_are_kept_work(exported: dict[str, Path]) -> None:
    runtime = load_runtime(exported["compact"], runtime="openvino").runtime
    inputs = [model_input(64, width) for width in range(33, 33 + 32 * 5, 16)] * 2
    answers = [runtime.predict(one).flow_px.sum() for one in inputs]
    np.testing.assert_array_equal(answers[:10], answers[10:])


def test_the_same_checkpoint_gives_the_same_export(exported: dict[str, Path], tmp_path: Path) -> None:
    with traced_anew():
        again = export_network(exported["calibrated"], tmp_path / "again.onnx")
    assert again.read_bytes() == exported["calibrated"].with_suffix(".onnx").read_bytes()


def test_an_export_says_nothing_of_the_machine(exported: dict[str, Path]) -> None:
    content = exported["calibrated"].with_suffix(".onnx").read_bytes()
    for secret in (b".py", b"stack_trace", str(Path(export_module.__file__).parent).encode()):
        assert secret not in content


def test_export_speaks_only_of_errors(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with traced_anew():
        export_network(save(tmp_path, "compact"))
    assert capfd.readouterr() == ("", "")


def test_the_paper_preset_is_exported_at_its_own_size(tmp_path: Path) -> None:
    path = save(
        tmp_path,
        "paper",
        view=ViewConfig(mode="center_crop", crop_size=32).model_dump(),
        motion_window=MotionWindowConfig(samples_before=1, samples_between=2).model_dump(),
    )
    export_network(path)
    record = load_runtime(path, runtime="torch").record
    one = prepare(frame_pair(40, 50), record.model)
    expected = load_runtime(path, runtime="torch").runtime.predict(one).flow_px
    found = load_runtime(path, runtime="openvino").runtime.predict(one).flow_px
    assert found.shape == (4, 32, 32, 2)
    np.testing.assert_allclose(found, expected, atol=MAX_FLOW_DIFFERENCE_PX)


def test_without_onnx_nothing_is_exported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save(tmp_path, "compact")
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ConfigError, match=r"viflow-anomaly\[export\]") as caught:
        export_network(path)
    assert caught.value.code == "export_unavailable"
    assert not path.with_suffix(".onnx").exists()
