from __future__ import annotations

from pathlib import Path

import pytest
from pair_world import Ask

from viflow_anomaly.checkpoint import save_checkpoint
from viflow_anomaly.config import ModelConfig
from viflow_anomaly.model.builder import build_model

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
