from __future__ import annotations

import json
import os
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pair_world import Ask
from simulated_truth import add_ground_truth, add_movers
from worlds import make_world, write_euroc, write_lines

from viflow_anomaly.checkpoint import load_checkpoint, save_checkpoint
from viflow_anomaly.config import ModelConfig, SplitConfig
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.datasets.splits import split_pairs
from viflow_anomaly.evaluation.flo_files import write_flo
from viflow_anomaly.evaluation.flow_report import cpu_model
from viflow_anomaly.evaluation.flow_truth import RecordingTruth, TestPart
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
    answer = ask(flow(recordings, checkpoint, "--json", "--methods", "identity,dis-ultrafast"))
    assert (answer.code, answer.err) == (0, "")
    report: dict[str, Any] = json.loads(answer.out)
    assert report["machine"]["cpu"]
    assert report["machine"]["cores"] == os.cpu_count()
    assert report["threads"] == 1
    assert datetime.now(UTC) - datetime.fromisoformat(report["date"]) < timedelta(minutes=5)
    assert list(report["methods"]) == ["identity", "dis-ultrafast", "untrained", "untrained+correction"]
    network = report["methods"]["untrained"]
    assert network["model"] == {
        "name": "untrained",
        "version": "1.2",
        "sha256": load_checkpoint(checkpoint).record.sha256,
    }
    assert (network["preset"], network["inputs"], network["hypotheses"]) == ("calibrated", "imu", 4)
    assert {name: group["untrained"]["pairs"] for name, group in report["groups"].items()} == {"car": 1, "drone": 3}
    assert {name: one["identity"]["pairs"] for name, one in report["sequences"].items()} == {
        "car_000001": 1,
        "drone_000001": 2,
        "drone_000002": 1,
    }
    identity, ours = report["all"]["identity"], report["all"]["untrained+correction"]
    assert (identity["epe_mean_px"], identity["epe_sd_px"], identity["f1_all"]) == (2.0, 0.0, 0.0)
    assert identity["runtime_ms"] is None
    assert ours["epe_ratio"] == pytest.approx(ours["epe_mean_px"] / 2.0, abs=1e-3)
    assert ours["runtime_ms"] > 0
    assert report["paper"]["rows"][0]["algorithm"] == "FlowNetC"


def test_table(ask: Ask, recordings: list[Path], checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "150")
    answer = ask(flow(recordings, checkpoint, "--methods", "identity"))
    assert (answer.code, answer.err) == (0, "")
    lines = [line.strip() for line in answer.out.splitlines()]
    assert [line for line in lines if line.endswith((" pair", " pairs"))] == [
        "car: 1 pair",
        "drone: 3 pairs",
        "all pairs: 4 pairs",
    ]
    rows = [line.split() for line in lines if line.startswith("identity ")]
    assert [row[4:8] for row in rows] == [["2.000", "0.000", "2.002", "0.0"]] * 3
    assert any(line.startswith("VIFlow-IMU+SFFMS") for line in lines)
    assert any(line.startswith("Runtime: median") and "1 thread(s)" in line for line in lines)


def test_results_are_written(ask: Ask, recordings: list[Path], checkpoint: Path, tmp_path: Path) -> None:
    out, markdown, latex = (tmp_path / "results" / f"flow.{kind}" for kind in ("json", "md", "tex"))
    more = ["--out", str(out), "--markdown", str(markdown), "--latex", str(latex), "--methods", "none"]
    answer = ask(flow(recordings, checkpoint, "--json", *more))
    assert out.read_text() == answer.out
    assert sorted(out.parent.iterdir()) == sorted([out, markdown, latex])
    assert "| untrained+correction | calibrated | imu | 4 |" in markdown.read_text()
    assert "untrained+correction & calibrated & imu & 4 &" in latex.read_text()


def test_max_pairs_and_look_aheads(ask: Ask, recordings: list[Path], checkpoint: Path) -> None:
    quick = ("--json", "--methods", "identity")
    report = json.loads(ask(flow(recordings, checkpoint, *quick, "--max-pairs", "2")).out)
    assert report["all"]["identity"]["pairs"] == 2
    assert list(report["sequences"]) == ["car_000001", "drone_000001"]


def test_pairs_further_apart(ask: Ask, checkpoint: Path, tmp_path: Path) -> None:
    """A camera that stands still: the flow over two frames comes from depth and poses, and is zero."""
    folder = add_ground_truth(tmp_path / "drone_1", make_world(frames=3, shift_px=0), shift_px=0.0)
    rows = [f"{stamp},0,0,0,1,0,0,0" for stamp in open_recording(folder).frame_timestamps_ns]
    write_lines(folder / "mav0/state_groundtruth_estimate0/data.csv", ["#timestamp", *rows])
    quick = ("--json", "--methods", "identity", "--look-aheads", "2,1")
    report = json.loads(ask(flow([folder], checkpoint, *quick)).out)
    assert report["options"]["look_aheads"] == [1, 2]
    assert (report["all"]["identity"]["pairs"], report["all"]["identity"]["epe_mean_px"]) == (3, 0.0)
    assert report["all"]["untrained"]["epe_ratio"] is None


def test_checkpoints_by_name(ask: Ask, recordings: list[Path], checkpoint: Path) -> None:
    more = ("--checkpoint", f"second={checkpoint}", "--methods", "none", "--json")
    uncorrected = ("--set", "detector.correction.enabled=false")
    assert list(json.loads(ask(flow(recordings[:1], checkpoint, *more, *uncorrected)).out)["methods"]) == [
        "untrained",
        "second",
    ]
    twice = ask(flow(recordings[:1], checkpoint, "--checkpoint", str(checkpoint)))
    assert twice.is_refusal("[method_names]")
    none = ["evaluate", "flow", str(recordings[0]), "--checkpoint", "none"]
    assert list(json.loads(ask([*none, "--methods", "identity", "--json"]).out)["methods"]) == ["identity"]
    assert ask([*none, "--methods", "none"]).is_refusal("found none [method_names]")


def test_another_methods_results(ask: Ask, recordings: list[Path], tmp_path: Path) -> None:
    stamp = int(open_recording(recordings[0]).frame_timestamps_ns[1])
    flow_px = np.full((64, 96, 2), np.nan, np.float32)
    flow_px[:16] = (-2.0, 1.0)
    write_flo(tmp_path / "Sparse" / recordings[0].name / f"{stamp}.flo", flow_px)
    command = ["evaluate", "flow", *map(str, recordings), "--checkpoint", "none", "--methods", "none", "--json"]
    report = json.loads(ask([*command, "--results", f"Sparse={tmp_path / 'Sparse'}"]).out)
    found = report["all"]["Sparse"]
    assert (found["pairs"], found["missing_pairs"]) == (1, {"no_file": 3})
    assert (found["density"], found["epe_mean_px"], found["runtime_ms"]) == (0.25, 1.0, None)
    assert ask([*command, "--results", str(tmp_path / "Sparse")]).is_refusal("[results_unnamed]")
    assert ask([*command, "--results", f"Absent={tmp_path / 'absent'}"]).is_refusal("[results_missing]")


def test_ground_truth_beside_the_recording(ask: Ask, checkpoint: Path, tmp_path: Path) -> None:
    whole = add_ground_truth(tmp_path / "drone_1")
    bare = write_euroc(tmp_path / "V1_01", make_world(frames=3))
    quick = ("--json", "--methods", "identity", "--ground-truth", str(whole))
    report = json.loads(ask(flow([bare], checkpoint, *quick)).out)
    assert report["sequences"]["V1_01"]["identity"]["epe_mean_px"] == 2.0
    assert ask(flow([bare, whole], checkpoint, *quick)).is_refusal("[ground_truth_ambiguous]")


def test_movers_can_be_left_out(ask: Ask, checkpoint: Path, tmp_path: Path) -> None:
    folder = add_movers(add_ground_truth(tmp_path / "drone_1"))
    pixels = [
        json.loads(ask(flow([folder], checkpoint, "--json", "--methods", "identity", option)).out)["all"]["identity"]
        for option in ("--movers", "--no-movers")
    ]
    assert pixels[0]["pixels"] - pixels[1]["pixels"] == 2 * (140 + 100)


def test_pictures(ask: Ask, recordings: list[Path], checkpoint: Path, tmp_path: Path) -> None:
    answer = ask(flow(recordings[2:], checkpoint, "--methods", "none", "--plots", str(tmp_path / "figures")))
    assert (answer.code, answer.err) == (0, "")
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert names == {
        f"{kind}-car.{end}" for kind in ("flow", "correspondences", "epe-runtime") for end in ("png", "pdf")
    }


def test_only_what_a_training_never_saw(ask: Ask, tmp_path: Path) -> None:
    folder = add_ground_truth(tmp_path / "drone_1", make_world(frames=12))
    split = SplitConfig(rule="blocks", block_s=0.1, seed=2)
    whole = RecordingTruth(folder)
    expected = [whole.name(k) for k in split_pairs(whole.pairs, "blocks", seed=2, block_s=0.1).test]
    part = TestPart(whole, split)
    assert [part.name(k) for k in range(len(part))] == expected
    assert 0 < len(expected) < 11
    model = ModelConfig(preset="compact", hypotheses=1)
    provenance = {"training": {"split": split.model_dump(mode="json")}}
    path = tmp_path / "trained.safetensors"
    save_checkpoint(path, build_model(model), model, name="trained", version="1", provenance=provenance)
    flow_of_it = flow([folder], path, "--methods", "none", "--test-part", "--json")
    settings = [part for key in ("rule=blocks", "block_s=0.1") for part in ("--set", f"training.split.{key}")]
    answer = ask([*flow_of_it, *settings, "--set", "training.split.seed=2"])
    report = json.loads(answer.out)
    assert report["all"]["trained"]["pairs"] == len(expected)
    assert report["options"]["test_part"]["seed"] == 2
    assert "split_differs" in ask([*flow_of_it, *settings]).err
    assert "split_rule_unknown" in ask([*flow_of_it]).err


def test_recordings_are_told_apart_by_their_names(ask: Ask, checkpoint: Path, tmp_path: Path) -> None:
    folders = [add_ground_truth(tmp_path / name / "drone_1", make_world(frames=2)) for name in "ab"]
    answer = ask(flow(folders, checkpoint))
    assert answer.code == 2
    assert "sequence_names" in answer.err


def test_places_that_cannot_be_written_are_found_before_the_measurement(
    ask: Ask, recordings: list[Path], checkpoint: Path, tmp_path: Path
) -> None:
    file = tmp_path / "file"
    file.write_text("kept")
    for more in (
        ("--out", str(tmp_path)),
        ("--plots", str(file)),
        ("--out", str(tmp_path / "a"), "--latex", str(tmp_path / "a")),
    ):
        answer = ask(flow(recordings, checkpoint, *more))
        assert answer.code == 2
        assert "output_unusable" in answer.err
    assert file.read_text() == "kept"


def test_refusals(ask: Ask, recordings: list[Path], checkpoint: Path, tmp_path: Path) -> None:
    plain = write_euroc(tmp_path / "V1_01")
    assert ask(flow([plain], checkpoint)).is_refusal("[ground_truth_missing]")
    assert ask(flow([tmp_path / "absent"], checkpoint)).is_refusal("absent")
    assert ask(flow(recordings, tmp_path / "absent.safetensors")).is_refusal("[checkpoint_missing]")
    assert ask(flow(recordings, tmp_path / "model.pt")).is_refusal("[checkpoint_not_safetensors]")
    assert ask(flow(recordings, checkpoint, "--device", "abacus")).is_refusal("[device_unavailable]")
    assert ask(flow(recordings, checkpoint, "--max-pairs", "0")).is_refusal("Invalid value for '--max-pairs'")
    assert ask(flow(recordings, checkpoint, "--look-aheads", "1,5")).is_refusal("[look_ahead_out_of_range]")
    assert ask(flow(recordings, checkpoint, "--look-aheads", "one")).is_refusal("[look_ahead_out_of_range]")
    assert ask(flow(recordings, checkpoint, "--methods", "magic")).is_refusal("[method_unknown]")
    assert ask(flow([], checkpoint)).is_refusal("Missing argument")
    assert ask(["evaluate", "speed"]).is_refusal("No such command 'speed'")


def test_a_result_that_cannot_be_written(ask: Ask, recordings: list[Path], checkpoint: Path, tmp_path: Path) -> None:
    answer = ask(flow(recordings[2:], checkpoint, "--methods", "none", "--out", str(tmp_path)))
    assert answer.is_refusal(f"{tmp_path.name}: expected the name of a file to write, found a directory")


@pytest.mark.parametrize("group", ["evaluate", "groundtruth", "keys"])
def test_a_group_without_a_command_says_what_is_missing(ask: Ask, group: str) -> None:
    answer = ask([group])
    assert answer.code == 2
    assert "Usage:" in answer.out
    assert answer.err == f"error: expected a command, found none (try 'viflow-anomaly {group} --help')\n"


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


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("labelled")
    frames = {"drone_000001": 3, "drone_000002": 2, "car_000001": 2}
    return [add_movers(add_ground_truth(folder / name, make_world(frames=n))) for name, n in frames.items()]


def detect(labelled: list[Path], checkpoint: Path, *more: str) -> list[str]:
    return ["evaluate", "detect", *map(str, labelled), "--checkpoint", str(checkpoint), *more]


def test_detection_json_and_files(ask: Ask, labelled: list[Path], checkpoint: Path, tmp_path: Path) -> None:
    out, text, plots = tmp_path / "detect.json", tmp_path / "detect.md", tmp_path / "plots"
    files = ["--out", str(out), "--markdown", str(text), "--plots", str(plots)]
    answer = ask(detect(labelled, checkpoint, "--no-rivals", "--json", *files))
    assert (answer.code, answer.err) == (0, "")
    report: dict[str, Any] = json.loads(answer.out)
    assert json.loads(out.read_text()) == report
    assert {name: one["viflow-anomaly"]["frames"] for name, one in report["groups"].items()} == {"car": 1, "drone": 3}
    assert {name: one["viflow-anomaly"]["movers"] for name, one in report["groups"].items()} == {"car": 1, "drone": 3}
    assert list(report["sequences"]) == ["car_000001", "drone_000001", "drone_000002"]
    assert report["detector"]["correction"]["enabled"] is True
    assert text.read_text().startswith("# Regions against ground truth")
    assert (plots / "precision-recall-all.png").is_file()


def test_detection_table(ask: Ask, labelled: list[Path], checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "170")
    table = ask(detect(labelled, checkpoint, "--every", "2")).out
    for text in ("homography difference", "plain residual", "gyro difference", "ROI AP", "alarms/frame", "@0.01"):
        assert text in table


def test_detection_refuses_what_it_cannot_judge(ask: Ask, checkpoint: Path, tmp_path: Path) -> None:
    assert ask(detect([write_euroc(tmp_path / "V1_01")], checkpoint)).is_refusal("[ground_truth_missing]")


def test_detection_needs_matplotlib_for_charts(
    ask: Ask, labelled: list[Path], checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("viflow_anomaly.evaluation.plot_style.find_spec", lambda name: None)
    answer = ask(detect(labelled, checkpoint, "--plots", str(tmp_path / "plots")))
    assert answer.is_refusal("[plots_unavailable]")
