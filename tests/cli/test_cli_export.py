from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from pair_world import Ask

from viflow_anomaly.checkpoint import save_checkpoint
from viflow_anomaly.checkpoint_record import bundled_evidence_head
from viflow_anomaly.config import ModelConfig
from viflow_anomaly.model.builder import build_model
from viflow_anomaly.runtime.loading import load_evidence

pytest.importorskip("onnxscript", reason="the extra 'export' is not installed")


def test_an_export_lands_beside_its_checkpoint_or_where_it_is_told(ask: Ask, tmp_path: Path) -> None:
    config = ModelConfig(hypotheses=1)
    path = save_checkpoint(tmp_path / "m.safetensors", build_model(config), config, name="m", version="1")
    answer = ask(["export", "--checkpoint", str(path)])
    assert (answer.code, answer.out.strip()) == (0, str(tmp_path / "m.onnx"))
    elsewhere = tmp_path / "new" / "other.onnx"
    assert ask(["export", "--checkpoint", str(path), "--out", str(elsewhere)]).code == 0
    assert elsewhere.read_bytes() == (tmp_path / "m.onnx").read_bytes()


def test_a_missing_checkpoint_is_refused(ask: Ask, tmp_path: Path) -> None:
    assert ask(["export", "--checkpoint", str(tmp_path / "absent.safetensors")]).is_refusal("[checkpoint_missing]")


def test_help_shows_an_example(ask: Ask) -> None:
    answer = ask(["export", "--help"])
    assert answer.code == 0
    assert "viflow-anomaly export --checkpoint" in answer.out


def test_a_head_alone_needs_no_network(ask: Ask, tmp_path: Path) -> None:
    """It was ignored once."""
    answer = ask(["export", "--checkpoint", str(tmp_path / "m.safetensors"), "--evidence-head", "h.safetensors"])
    assert answer.code == 2
    assert "expected one of" in " ".join(answer.err.split())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--int8", "--format", "openvino"], "--evidence-head PATH and --format openvino"),
        (["--int8", "--evidence-head", "h.safetensors"], "--evidence-head PATH and --format openvino"),
        (["--calibration", "DIR"], "--calibration alone"),
    ],
)
def test_options_that_need_each_other(ask: Ask, options: list[str], words: str) -> None:
    answer = ask(["export", *options])
    assert answer.code == 2
    assert words in " ".join(answer.err.replace("│", " ").split())


def test_openvinos_format(ask: Ask, tmp_path: Path) -> None:
    pytest.importorskip("openvino", reason="the extra 'openvino' is not installed")
    config = ModelConfig(hypotheses=1)
    path = save_checkpoint(tmp_path / "m.safetensors", build_model(config), config, name="m", version="1")
    answer = ask(["export", "--checkpoint", str(path), "--format", "openvino"])
    assert (answer.code, answer.out.strip()) == (0, str(tmp_path / "m.xml"))
    assert (tmp_path / "m.bin").exists()


def test_an_int8_head_is_calibrated_on_the_recording_that_is_named(ask: Ask, tmp_path: Path) -> None:
    pytest.importorskip("nncf", reason="the extra 'int8' is not installed")
    for suffix in (".safetensors", ".json"):
        shutil.copy(bundled_evidence_head().with_suffix(suffix), tmp_path / f"h{suffix}")
    head = tmp_path / "h.safetensors"
    sample = Path(__file__).parents[2] / "samples" / "drone"
    answer = ask(
        ["export", "--evidence-head", str(head), "--int8", "--format", "openvino", "--calibration", str(sample)]
    )
    assert (answer.code, answer.out.strip(), answer.err) == (0, str(tmp_path / "h.int8.xml"), "")
    assert load_evidence(head, precision="int8").runtime.backend.precision == "int8"
