"""The evidence head answers alike in torch and in OpenVINO, and says clearly why it cannot run."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from viflow_anomaly import detector as detector_module
from viflow_anomaly.checkpoint import load_evidence_head, save_evidence_head
from viflow_anomaly.checkpoint_record import EvidenceRecord, bundled_checkpoint
from viflow_anomaly.cli.pair_files import PairFiles, load_pair
from viflow_anomaly.config import DetectorConfig, EvidenceHeadConfig, ImageLimits, Precision, RuntimeName
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import CheckpointError, ConfigError
from viflow_anomaly.evidence_cues import CUES_VERSION, GEOMETRIC_CUES, PHOTOMETRIC_CUES
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.model.evidence_builder import build_evidence_head
from viflow_anomaly.runtime.export import export_head, export_network
from viflow_anomaly.runtime.loading import load_evidence
from viflow_anomaly.sensor_data import FramePair

pytest.importorskip("openvino", reason="the extra 'openvino' is not installed")
pytest.importorskip("onnxscript", reason="the extra 'export' is not installed")

RUNTIMES: tuple[RuntimeName, ...] = ("torch", "openvino")
PRECISIONS: tuple[Precision, ...] = ("f32", "auto")
MAX_LOGIT_DIFFERENCE = 1e-3
MAX_BFLOAT16_DIFFERENCE = 0.05
"""Of probabilities, in the mean."""


def record(**changes: object) -> EvidenceRecord:
    values = {
        "name": "test head",
        "version": "1",
        "sha256": "0" * 64,
        "head": EvidenceHeadConfig(widths=(16, 16, 24, 24)),
        "photometric_cues": PHOTOMETRIC_CUES,
        "geometric_cues": GEOMETRIC_CUES,
        "cues_version": CUES_VERSION,
    }
    return EvidenceRecord.model_validate(values | changes)


def save(path: Path, **changes: object) -> Path:
    about = record(**changes)
    return save_evidence_head(path, build_evidence_head(about.head, seed=4), about)


@pytest.fixture(scope="module")
def head(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = save(tmp_path_factory.mktemp("head") / "head.safetensors")
    assert export_head(path) == path.with_suffix(".onnx")
    return path


def cues(height: int, width: int) -> tuple[Float32Array, Float32Array]:
    rng = np.random.default_rng(height + width)
    photometric = rng.uniform(-1, 1, (len(PHOTOMETRIC_CUES), height, width)).astype(np.float32)
    geometric = rng.uniform(-1, 1, (len(GEOMETRIC_CUES), height // 4, width // 4)).astype(np.float32)
    return photometric, geometric


def sample_pair() -> FramePair:
    folder = Path(__file__).parents[2] / "samples" / "drone"
    names = ("source.png", "target.png", "imu.json", "camera.json")
    return load_pair(PairFiles(*(folder / name for name in names)), limits=ImageLimits())[0]


@pytest.mark.parametrize(("height", "width"), [(32, 32), (64, 96), (224, 224), (480, 768)])
def test_openvino_answers_as_torch_does(head: Path, height: int, width: int) -> None:
    torch_says, openvino_says = (
        load_evidence(head, runtime=runtime, threads=1, precision="f32").runtime.judge(*cues(height, width))
        for runtime in RUNTIMES
    )
    assert torch_says.logits.shape == openvino_says.logits.shape == (2, height, width)
    assert torch_says.offsets.shape == openvino_says.offsets.shape == (2, height // 4, width // 4)
    for one, other in zip(torch_says, openvino_says, strict=True):
        np.testing.assert_allclose(one, other, atol=MAX_LOGIT_DIFFERENCE)


def test_bfloat16_says_nearly_the_same(head: Path) -> None:
    exact, fast = (
        load_evidence(head, runtime="openvino", precision=precision).runtime.judge(*cues(128, 160)).logits
        for precision in PRECISIONS
    )
    assert np.abs(1 / (1 + np.exp(-exact)) - 1 / (1 + np.exp(-fast))).mean() < MAX_BFLOAT16_DIFFERENCE


def test_the_regions_of_the_sample_are_the_same_in_both_runtimes() -> None:
    pair = sample_pair()
    torch_says, openvino_says = (
        AnomalyDetector.from_checkpoint(runtime=runtime, threads=1, precision="f32").detect(pair).rois
        for runtime in RUNTIMES
    )
    assert len(torch_says) == len(openvino_says) > 0
    for one, other in zip(torch_says, openvino_says, strict=True):
        assert (one.bbox, one.label) == (other.bbox, other.label)
        assert one.area_px == pytest.approx(other.area_px, rel=1e-3)
        assert one.score == pytest.approx(other.score, abs=1e-3)


def test_an_altered_export_is_stale(head: Path, tmp_path: Path) -> None:
    path = tmp_path / "head.safetensors"
    for suffix in (".safetensors", ".json", ".onnx"):
        path.with_suffix(suffix).write_bytes(head.with_suffix(suffix).read_bytes())
    path.with_suffix(".onnx").write_bytes(path.with_suffix(".onnx").read_bytes()[:-1] + b"x")
    with pytest.raises(CheckpointError) as caught:
        load_evidence(path, runtime="openvino")
    assert caught.value.code == "export_stale"
    assert f"export --evidence-head {path}" in caught.value.message


def test_a_damaged_head_abstains(tmp_path: Path) -> None:
    about = record()
    for name in ("logits.weight", "logits.bias", "offsets.bias"):
        network = build_evidence_head(about.head)
        network.state_dict()[name].reshape(-1)[-1] = float("nan")  # one of the seam's
        path = save_evidence_head(tmp_path / "head.safetensors", network, about)
        detection = AnomalyDetector.from_checkpoint(evidence_head=path).detect(sample_pair())
        assert (detection.status, detection.reasons[-1].code) == ("abstained", "prediction_not_finite")
        assert "evidence head" in detection.reasons[-1].message


def test_the_head_does_not_look_at_a_pair_that_is_not_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    detector, pair = AnomalyDetector.from_checkpoint(), sample_pair()
    flat = replace(pair, source=replace(pair.source, image=np.full_like(pair.source.image, 90)))
    looked_at: list[int] = []
    judge = detector_module.judge_cues
    monkeypatch.setattr(detector_module, "judge_cues", lambda *given: looked_at.append(1) or judge(*given))
    judged, refused = detector.analyze(pair), detector.analyze(flat)
    assert looked_at == [1]
    assert (judged.detection.status, refused.detection.status) == ("ok", "abstained")
    assert judged.learned
    assert refused.learned
    assert judged.evidence.max() > 0.5
    assert not refused.evidence.any()
    assert refused.residual.any()


def test_scores_of_other_measures_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "head.safetensors", region_score={"weights": [1.0] * 5})
    with pytest.raises(CheckpointError, match=r"expected 13 weights.*found 5") as caught:
        AnomalyDetector.from_checkpoint(evidence_head=path)
    assert caught.value.code == "checkpoint_record_invalid"


def test_another_networks_export_is_no_head(tmp_path: Path) -> None:
    path = save(tmp_path / "head.safetensors")
    network = export_network(bundled_checkpoint(), tmp_path / "network.onnx")
    path.with_suffix(".onnx").write_bytes(network.read_bytes())
    about = path.with_suffix(".json")
    values = json.loads(about.read_text()) | {"onnx_sha256": hashlib.sha256(network.read_bytes()).hexdigest()}
    about.write_text(json.dumps(values))
    with pytest.raises(CheckpointError, match="export of an evidence head") as caught:
        load_evidence(path, runtime="openvino")
    assert caught.value.code == "checkpoint_corrupt"


def test_a_head_of_other_cues_is_refused(tmp_path: Path) -> None:
    others = {"geometric_cues": ("something else", *GEOMETRIC_CUES[1:])}, {"cues_version": CUES_VERSION - 1}
    for changes, told in zip(
        others, ("something else", f"cues_version {CUES_VERSION}, found {CUES_VERSION - 1}"), strict=True
    ):
        path = save(tmp_path / "head.safetensors", **changes)
        with pytest.raises(CheckpointError, match=told) as caught:
            AnomalyDetector.from_checkpoint(evidence_head=path)
        assert caught.value.code == "evidence_cues_differ"


def test_a_network_is_no_head_and_a_missing_one_is_told(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError) as caught:
        load_evidence(bundled_checkpoint(), runtime="torch")
    assert caught.value.code == "checkpoint_of_other_kind"
    with pytest.raises(CheckpointError) as caught:
        load_evidence(tmp_path / "none.safetensors")
    assert caught.value.code == "checkpoint_missing"


def test_tensors_of_another_head_are_refused(head: Path, tmp_path: Path) -> None:
    path = tmp_path / "head.safetensors"
    path.write_bytes(head.read_bytes())
    values = json.loads(head.with_suffix(".json").read_text())
    values["head"]["widths"] = [16, 16, 24, 32]
    path.with_suffix(".json").write_text(json.dumps(values))
    with pytest.raises(CheckpointError, match="tensors of the head") as caught:
        load_evidence_head(path)
    assert caught.value.code == "checkpoint_corrupt"


def test_learned_evidence_needs_a_head() -> None:
    with pytest.raises(ConfigError) as caught:
        AnomalyDetector.from_checkpoint(with_evidence=False, config=DetectorConfig(evidence="learned"))
    assert caught.value.code == "evidence_head_missing"


def test_the_version_names_the_head_that_takes_part() -> None:
    detector = AnomalyDetector.from_checkpoint()
    alone = detector.with_config(DetectorConfig(evidence="residual"))
    assert detector.model_info.version.startswith(alone.model_info.version + "+viflow-evidence.")
    assert "+" not in alone.model_info.version
