from __future__ import annotations

import json
import os
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from pair_world import Ask
from simulated_truth import add_ground_truth, add_movers
from worlds import make_world, write_euroc

from viflow_anomaly.checkpoint import load_checkpoint, save_checkpoint
from viflow_anomaly.config import ModelConfig
from viflow_anomaly.evaluation.flow_report import cpu_model
from viflow_anomaly.model.builder import build_model


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = ModelConfig(hypotheses=4)
    path = tmp_path_factory.mktemp("model") / "model.safetensors"
    return save_checkpoint(path, build_model(config), config, name="untrained", version="1.2")


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("recordings")
    frames = {"drone_000001": 3, "drone_000002": 2, "car_000001": 2}
    return [add_ground_truth(folder / name, make_world(frames=count)) for name, count in frames.items()]


def flow(recordings: list[Path], checkpoint: Path, *more: str) -> list[str]:
    return ["evaluate", "flow", *map(str, recordings), "--checkpoint", str(checkpoint), *more]


def test_json(ask: Ask, recordings: list[Path], checkpoint: Path) -> None:
    answer = ask(flow(recordings, checkpoint, "--json"))
    assert (answer.code, answer.err) == (0, "")
    report: dict[str, Any] = json.loads(answer.out)
    assert list(report) == ["model", "commit", "machine", "date", "all", "groups", "sequences"]
    assert report["model"] == {
        "name": "untrained",
        "version": "1.2",
        "sha256": load_checkpoint(checkpoint).record.sha256,
    }
    assert report["machine"]["cpu"]
    assert report["machine"]["cores"] == os.cpu_count()
    assert datetime.now(UTC) - datetime.fromisoformat(report["date"]) < timedelta(minutes=5)
    assert {name: group["pairs"] for name, group in report["groups"].items()} == {"car": 1, "drone": 3}
    assert {name: one["pairs"] for name, one in report["sequences"].items()} == {
        "car_000001": 1,
        "drone_000001": 2,
        "drone_000002": 1,
    }
    assert set(report["all"]) == {
        "epe_px",
        "predicted_epe_px",
        "identity_epe_px",
        "epe_ratio",
        "predicted_epe_ratio",
        "pairs",
    }
    assert report["all"]["pairs"] == 4
    assert report["all"]["identity_epe_px"] == 2.0
    assert report["all"]["epe_ratio"] == pytest.approx(report["all"]["epe_px"] / 2.0, abs=1e-3)


def test_table(ask: Ask, recordings: list[Path], checkpoint: Path) -> None:
    answer = ask(flow(recordings, checkpoint))
    assert (answer.code, answer.err) == (0, "")
    rows = {words[0]: words[1:] for line in answer.out.splitlines() if (words := line.split())}
    assert rows["model"][:2] == ["untrained", "1.2"]
    assert rows["model"][2] == f"({load_checkpoint(checkpoint).record.sha256[:8]})"
    assert {name: row[0] for name, row in rows.items() if name.startswith(("drone", "car", "all"))} == {
        "car_000001": "1",
        "drone_000001": "2",
        "drone_000002": "1",
        "car": "1",
        "drone": "3",
        "all": "4",
    }
    assert rows["all"][3] == "2.000"


def test_out_holds_the_same_json(ask: Ask, recordings: list[Path], checkpoint: Path, tmp_path: Path) -> None:
    out = tmp_path / "results" / "flow.json"
    answer = ask(flow(recordings, checkpoint, "--json", "--out", str(out)))
    assert out.read_text() == answer.out
    assert list(out.parent.iterdir()) == [out]
    table = ask(flow(recordings, checkpoint, "--out", str(out)))
    assert "predicted" in table.out
    assert json.loads(out.read_text())["groups"] == json.loads(answer.out)["groups"]


def test_max_pairs(ask: Ask, recordings: list[Path], checkpoint: Path) -> None:
    report = json.loads(ask(flow(recordings, checkpoint, "--json", "--max-pairs", "2")).out)
    assert report["all"]["pairs"] == 2
    assert list(report["sequences"]) == ["car_000001", "drone_000001"]


def test_no_motion_at_all_has_no_ratio(ask: Ask, checkpoint: Path, tmp_path: Path) -> None:
    folder = add_ground_truth(tmp_path / "drone_1", shift_px=0.0)
    report = json.loads(ask(flow([folder], checkpoint, "--json")).out)
    assert report["all"]["epe_ratio"] is None
    assert " nan" in ask(flow([folder], checkpoint)).out


def test_refusals(ask: Ask, recordings: list[Path], checkpoint: Path, tmp_path: Path) -> None:
    plain = write_euroc(tmp_path / "V1_01")
    assert ask(flow([plain], checkpoint)).is_refusal("[ground_truth_missing]")
    assert ask(flow([tmp_path / "absent"], checkpoint)).is_refusal("absent")
    assert ask(flow(recordings, tmp_path / "absent.safetensors")).is_refusal("[checkpoint_missing]")
    assert ask(flow(recordings, tmp_path / "model.pt")).is_refusal("[checkpoint_not_safetensors]")
    assert ask(flow(recordings, checkpoint, "--device", "abacus")).is_refusal("[device_unavailable]")
    assert ask(flow(recordings, checkpoint, "--max-pairs", "0")).is_refusal("Invalid value for '--max-pairs'")
    assert ask(flow([], checkpoint)).is_refusal("Missing argument")
    assert ask(["evaluate", "speed"]).is_refusal("No such command 'speed'")


def test_a_result_that_cannot_be_written(ask: Ask, recordings: list[Path], checkpoint: Path, tmp_path: Path) -> None:
    answer = ask(flow(recordings[2:], checkpoint, "--out", str(tmp_path)))
    assert answer.is_refusal(f"{tmp_path.name}: expected a file or nothing there")


@pytest.mark.parametrize("arguments", [["evaluate"], ["evaluate", "flow"], ["evaluate", "detect"]])
def test_help_shows_examples(ask: Ask, arguments: list[str]) -> None:
    answer = ask([*arguments, "--help"])
    assert answer.code == 0
    assert answer.out.count("viflow-anomaly evaluate ") >= 2


def test_help_loads_nothing_heavy() -> None:
    code = """
import sys
from viflow_anomaly.cli.main import run
codes = [run(["evaluate", "--help"]), run(["evaluate", "flow", "--help"])]
print("loaded:", codes, sorted({"torch", "cv2", "skimage", "numpy"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "loaded: [0, 0] []"


@pytest.mark.parametrize("content", ["", None])
def test_the_processor_has_a_name_everywhere(monkeypatch: pytest.MonkeyPatch, content: str | None) -> None:
    def read_text(self: Path, **_: object) -> str:
        if content is None:
            raise FileNotFoundError(2, "No such file", str(self))
        return content

    with monkeypatch.context() as patch:
        patch.setattr(Path, "read_text", read_text)
        patch.setattr("platform.processor", lambda: "")
        patch.setattr("platform.machine", lambda: "riscv64")
        assert cpu_model() == "riscv64"


# --- evaluate detect


def test_detection_json_and_table(ask: Ask, checkpoint: Path, tmp_path: Path) -> None:
    frames = {"drone_000001": 3, "drone_000002": 2, "car_000001": 2}
    folders = [add_movers(add_ground_truth(tmp_path / name, make_world(frames=n))) for name, n in frames.items()]
    command = ["evaluate", "detect", *map(str, folders), "--checkpoint", str(checkpoint)]
    answer = ask([*command, "--no-rivals", "--json", "--out", str(tmp_path / "detect.json")])
    assert (answer.code, answer.err) == (0, "")
    report: dict[str, Any] = json.loads(answer.out)
    assert json.loads((tmp_path / "detect.json").read_text()) == report
    assert {name: one["viflow-anomaly"]["frames"] for name, one in report["groups"].items()} == {"car": 1, "drone": 3}
    assert report["detector"]["correction"]["enabled"] is True
    table = ask(command).out
    assert "homography difference" in table
    assert "ROI AP" in table


def test_detection_refuses_what_it_cannot_judge(ask: Ask, checkpoint: Path, tmp_path: Path) -> None:
    plain = write_euroc(tmp_path / "V1_01")
    command = ["evaluate", "detect", str(plain), "--checkpoint", str(checkpoint)]
    assert ask(command).is_refusal("[ground_truth_missing]")
