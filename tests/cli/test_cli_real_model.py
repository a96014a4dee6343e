"""The command line with the bundled model: one answer from both commands, and what only the model can refuse."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from pair_world import PairFolder, answer_to

from viflow_anomaly.detection import load_detection_schema, to_json
from viflow_anomaly.detection_reading import detection_from_json
from viflow_anomaly.track_labels import untracked


def untimed(text: str) -> dict[str, Any]:
    detection: dict[str, Any] = json.loads(text)
    del detection["timings_ms"]
    return detection


def test_detect_and_batch_give_the_same_answer(
    pair: PairFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    detected = answer_to(pair.arguments("--camera", str(pair.camera), "--json"), capsys)
    assert (detected.code, detected.err) == (0, "")
    out = tmp_path / "out"
    assert answer_to(["batch", str(pair.folder), "--out", str(out), "--overlays", "1"], capsys).code == 0
    lines = (out / "detections.jsonl").read_text().splitlines()
    assert untimed(to_json(untracked(detection_from_json(lines[0])))) == untimed(detected.out)
    for line in lines:
        jsonschema.validate(json.loads(line), load_detection_schema())
    run = json.loads((out / "run.json").read_text())
    assert run["model"] == untimed(lines[0])["model"]


def test_drawing_does_not_change_the_answer(
    pair: PairFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = answer_to(pair.arguments("--json"), capsys)
    drawn = answer_to(pair.arguments("--json", "--overlay", str(tmp_path / "out.png")), capsys)
    assert untimed(plain.out) == untimed(drawn.out)


def test_the_installed_command_detects(pair: PairFolder) -> None:
    command = Path(sys.executable).with_name("viflow-anomaly")
    done = subprocess.run(
        [command, *pair.arguments("--json")],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"OMP_WAIT_POLICY": "PASSIVE"},
    )
    assert done.stderr == ""
    jsonschema.validate(json.loads(done.stdout), load_detection_schema())


def scaled(pair: PairFolder, name: str, factor: float) -> dict[str, list[list[float]]]:
    rows = json.loads(pair.imu.read_text())[name]
    return {name: [[value * factor for value in row] for row in rows]}


@pytest.mark.parametrize(
    ("name", "factor", "code"),
    [("accel_m_s2", 1 / 9.80665, "imu_accel_in_g"), ("gyro_rad_s", 300.0, "imu_gyro_in_deg_s")],
)
def test_imu_in_other_units(
    pair: PairFolder, capsys: pytest.CaptureFixture[str], name: str, factor: float, code: str
) -> None:
    pair.change_imu(**scaled(pair, name, factor))
    assert answer_to(pair.arguments(), capsys).is_refusal(f"[{code}]")


def test_imu_that_ends_before_the_target(pair: PairFolder, capsys: pytest.CaptureFixture[str]) -> None:
    document = json.loads(pair.imu.read_text())
    kept = sum(stamp < document["source_timestamp_ns"] for stamp in document["timestamps_ns"])
    pair.change_imu(**{name: document[name][:kept] for name in ("timestamps_ns", "gyro_rad_s", "accel_m_s2")})
    assert answer_to(pair.arguments(), capsys).is_refusal("[imu_not_covering]")


def test_imu_without_accelerometer(pair: PairFolder, capsys: pytest.CaptureFixture[str]) -> None:
    pair.change_imu(accel_m_s2=None)
    answer = json.loads(answer_to(pair.arguments("--json"), capsys).out)
    assert answer["status"] == "ok"
    assert "no_accelerometer" in [reason["code"] for reason in answer["reasons"]]


@pytest.mark.parametrize("content", [b"", b"not a model", pickle.dumps({"weights": [1, 2]})])
def test_checkpoints_that_cannot_be_used(
    pair: PairFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes
) -> None:
    checkpoint = tmp_path / "model.safetensors"
    checkpoint.write_bytes(content)
    arguments = ["--checkpoint", str(checkpoint)]
    assert answer_to(pair.arguments(*arguments), capsys).is_refusal(str(checkpoint))
    assert answer_to(["batch", str(pair.folder), *arguments], capsys).is_refusal(str(checkpoint))
    assert not pair.folder.with_name("recording-detections").exists()


def test_a_checkpoint_that_is_not_there(pair: PairFolder, capsys: pytest.CaptureFixture[str]) -> None:
    assert answer_to(pair.arguments("--checkpoint", "nowhere.safetensors"), capsys).is_refusal("nowhere.safetensors")


def test_scores_are_fitted_by_a_command_that_says_on_how_much(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    samples, out = Path(__file__).parents[2] / "samples", tmp_path / "rescored.safetensors"
    answer = answer_to(["fit-scores", str(samples), "--out", str(out)], capsys)
    assert answer.code == 0
    assert answer.out == f"{out}\n"
    assert "regions in 1 recordings" in answer.err
    assert "scores may be far off" in answer.err
    assert out.is_file()
    nothing = answer_to(["fit-scores", str(tmp_path / "no"), "--out", str(out)], capsys)
    assert nothing.is_refusal("expected a folder of recordings, found nothing there")
