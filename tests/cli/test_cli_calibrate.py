from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pair_world import Ask, PairFolder
from worlds import WRITERS, make_world, write_plain

from viflow_anomaly.config import DetectorConfig
from viflow_anomaly.detector import AnomalyDetector


def recorded(folder: Path, *, frames: int = 15, square_px: int = 20, seed: int = 0, rate_hz: int = 20) -> Path:
    """A resting camera; a square moves by itself unless its side is 0."""
    world = make_world(frames=frames, shift_px=0, square_px=square_px, seed=seed, frame_rate_hz=rate_hz)
    return write_plain(folder, world)


def calibrate(*recordings: Path, out: Path, budget: float = 10.0, more: tuple[str, ...] = ()) -> list[str]:
    where = ["--out", str(out), "--false-alarms-per-hour", f"{budget:g}"]
    return ["calibrate", *map(str, recordings), *where, *more]


@pytest.fixture
def hall(ask: Ask, tmp_path: Path) -> Path:
    """A calibration that lets nothing of the world's square through."""
    path = tmp_path / "hall.json"
    assert ask(calibrate(recorded(tmp_path / "calm"), out=path)).code == 0
    return path


def test_short_footage_says_what_it_can_promise(ask: Ask, tmp_path: Path) -> None:
    answer = ask(calibrate(recorded(tmp_path / "calm"), out=tmp_path / "hall.json"))
    assert (answer.code, answer.err) == (0, "")
    threshold, footage, promise, estimate, needed = answer.out.splitlines()
    assert threshold.endswith(f" -> {tmp_path / 'hall.json'}")
    assert "0.7 s, 14 pairs judged, 0 abstained, 0 failed; 0 of 14 regions reach" in footage
    assert promise.startswith("NOT PROMISED: the footage is too short for 10 an hour at 95 %;")
    assert "5.14e+03 an hour expected, and even that is over the budget" in estimate
    assert needed.startswith("needed for the promise: at least 0.")
    values = json.loads((tmp_path / "hall.json").read_text())
    assert values["promised"] is False
    assert values["expected_per_hour"] == pytest.approx(3600 / 0.7, rel=1e-5)
    assert values["recordings"][0]["name"] == "calm"


def test_a_promise_is_told(ask: Ask, tmp_path: Path) -> None:
    calm = recorded(tmp_path / "calm", frames=8, rate_hz=2, square_px=0)
    more = ("--block-seconds", "0.1", "--confidence", "0.9")
    answer = ask(calibrate(calm, out=tmp_path / "hall.json", budget=3000, more=more))
    assert "motion_score 0.5000 -> " in answer.out
    assert "promised: at most 2.37e+03 false alarms an hour at 90 %, budget 3000 an hour" in answer.out
    values = json.loads((tmp_path / "hall.json").read_text())
    assert (values["promised"], values["alarms"], values["confidence"]) == (True, 0, 0.9)


def test_json_is_the_file_and_nothing_else(ask: Ask, tmp_path: Path) -> None:
    both = (recorded(tmp_path / "a"), recorded(tmp_path / "b", seed=4))
    answer = ask(calibrate(*both, out=tmp_path / "hall.json", more=("--json",)))
    assert (answer.code, answer.err) == (0, "")
    assert json.loads(answer.out) == json.loads((tmp_path / "hall.json").read_text())
    assert [one["name"] for one in json.loads(answer.out)["recordings"]] == ["a", "b"]


@pytest.mark.parametrize("layout", sorted(WRITERS))
def test_every_layout(ask: Ask, tmp_path: Path, layout: str) -> None:
    folder = WRITERS[layout](tmp_path / "data")
    assert ask(calibrate(folder, out=tmp_path / "hall.json")).code == 0


# --- the threshold at work


def labels(lines: str) -> set[str]:
    return {roi["label"] for line in lines.splitlines() for roi in json.loads(line)["rois"]}


def test_batch_labels_by_the_threshold_and_records_it(ask: Ask, tmp_path: Path, hall: Path) -> None:
    out = tmp_path / "out"
    calm = str(tmp_path / "calm")
    assert ask(["batch", calm, "--out", str(tmp_path / "plain")]).code == 0
    assert "independent_motion" in labels((tmp_path / "plain" / "detections.jsonl").read_text())
    assert ask(["batch", calm, "--out", str(out), "--calibration", str(hall)]).code == 0
    assert labels((out / "detections.jsonl").read_text()) == {"model_error"}
    configuration = json.loads((out / "run.json").read_text())["configuration"]
    made = json.loads(hall.read_text())
    assert configuration["detector"]["regions"]["motion_score"] == made["motion_score"]
    assert configuration["calibration"] == {"path": str(hall), **made}
    without = json.loads((tmp_path / "plain" / "run.json").read_text())
    assert without["configuration"]["calibration"] is None


def test_a_run_does_not_go_on_under_another_threshold(ask: Ask, tmp_path: Path, hall: Path) -> None:
    arguments = ["batch", str(tmp_path / "calm"), "--out", str(tmp_path / "out")]
    assert ask([*arguments, "--calibration", str(hall)]).code == 0
    assert ask([*arguments, "--resume"]).is_refusal("motion_score")
    assert ask([*arguments, "--resume", "--calibration", str(hall)]).code == 0


def test_batch_refuses_pairs_further_apart(ask: Ask, tmp_path: Path, hall: Path) -> None:
    answer = ask(["batch", str(tmp_path / "calm"), "--calibration", str(hall), "--look-ahead", "2"])
    assert answer.is_refusal(
        "expected what it was made with, pairs of successive frames (look-ahead 1), found look-ahead 2"
    )
    assert "[calibration_stale]" in answer.err


def test_detect_takes_it(ask: Ask, pair: PairFolder, hall: Path) -> None:
    assert "independent_motion" in labels(ask(pair.arguments("--json")).out)
    assert labels(ask(pair.arguments("--json", "--calibration", str(hall))).out) == {"model_error"}


def test_the_environment_names_it(ask: Ask, pair: PairFolder, hall: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIFLOW_CALIBRATION", str(hall))
    assert labels(ask(pair.arguments("--json")).out) == {"model_error"}


def test_a_new_calibration_does_not_look_at_an_old_one(
    ask: Ask, tmp_path: Path, hall: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = json.loads(hall.read_text())
    hall.write_text("stale")
    monkeypatch.setenv("VIFLOW_CALIBRATION", str(hall))
    assert ask(calibrate(tmp_path / "calm", out=tmp_path / "new.json")).code == 0
    assert json.loads((tmp_path / "new.json").read_text())["motion_score"] == made["motion_score"]


@pytest.mark.parametrize("command", ["detect", "batch"])
def test_a_stale_one_is_refused(ask: Ask, pair: PairFolder, hall: Path, command: str) -> None:
    arguments = pair.arguments() if command == "detect" else ["batch", str(pair.folder)]
    answer = ask([*arguments, "--calibration", str(hall), "--set", "detector.regions.max_regions=5"])
    assert answer.is_refusal("detector.regions.max_regions 64, found 5; run `calibrate` again [calibration_stale]")
    values: dict[str, Any] = json.loads(hall.read_text())
    values["model"]["sha256"] = "0" * 64
    hall.write_text(json.dumps(values))
    answer = ask([*arguments, "--calibration", str(hall)])
    assert answer.is_refusal(f"model.sha256 {'0' * 64}, found {'ab' * 32}; run `calibrate` again [calibration_stale]")


def test_a_malformed_one_is_refused(ask: Ask, pair: PairFolder, hall: Path) -> None:
    hall.write_text("{")
    assert ask(pair.arguments("--calibration", str(hall))).is_refusal("expected JSON, found: ")
    assert ask(pair.arguments("--calibration", "missing.json")).is_refusal("missing.json: expected a readable file")


# --- bad footage and bad options


def test_footage_of_one_frame_is_refused(ask: Ask, tmp_path: Path) -> None:
    answer = ask(calibrate(recorded(tmp_path / "calm", frames=1), out=tmp_path / "hall.json"))
    assert answer.is_refusal("expected at least 2 frames, found 1 [recording_too_short]")
    assert not (tmp_path / "hall.json").exists()


def test_footage_without_a_usable_pair_is_refused(ask: Ask, tmp_path: Path) -> None:
    world = make_world(frames=3)
    for image in world.images:
        image[:] = 0
    answer = ask(calibrate(write_plain(tmp_path / "dark", world), out=tmp_path / "hall.json"))
    assert answer.is_refusal("found none in 2 (2 abstained, failed: {}) [no_usable_pairs]")
    calm = recorded(tmp_path / "calm", frames=3)
    for image in (calm / "images").iterdir():
        image.write_bytes(b"")
    answer = ask(calibrate(calm, out=tmp_path / "hall.json"))
    assert answer.is_refusal("(0 abstained, failed: {'image_empty': 2}) [no_usable_pairs]")
    assert not (tmp_path / "hall.json").exists()


def test_failed_pairs_are_told(ask: Ask, tmp_path: Path) -> None:
    calm = recorded(tmp_path / "calm")
    (calm / "images" / "0000.png").write_bytes(b"")
    assert "13 pairs judged, 0 abstained, 1 failed" in ask(calibrate(calm, out=tmp_path / "hall.json")).out


def test_the_same_recording_twice_is_refused(ask: Ask, tmp_path: Path) -> None:
    calm = recorded(tmp_path / "calm")
    assert ask(calibrate(calm, calm, out=tmp_path / "hall.json")).is_refusal("[recording_repeated]")


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--false-alarms-per-hour", "0"),
        ("--false-alarms-per-hour", "5e-324"),
        ("--false-alarms-per-hour", "nan"),
        ("--false-alarms-per-hour", "inf"),
        ("--confidence", "0"),
        ("--confidence", "1"),
        ("--confidence", "nan"),
        ("--block-seconds", "0"),
        ("--block-seconds", "nan"),
    ],
)
def test_numbers_out_of_range_are_refused(ask: Ask, tmp_path: Path, option: str, value: str) -> None:
    arguments = calibrate(tmp_path / "calm", out=tmp_path / "hall.json", more=(option, value))
    assert ask(arguments).is_refusal(f"Invalid value for '{option}'")


def test_a_place_that_cannot_be_written_is_refused_before_the_work(ask: Ask, tmp_path: Path) -> None:
    assert ask(calibrate(tmp_path / "missing", out=tmp_path)).is_refusal("Invalid value for '--out'")


# --- with the bundled model


def test_the_detector_itself_is_calibrated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from pair_world import answer_to  # noqa: PLC0415 - without the stand-in of ``ask``

    calm, path = recorded(tmp_path / "calm", frames=5), tmp_path / "hall.json"
    assert answer_to(calibrate(calm, out=path), capsys).code == 0
    values = json.loads(path.read_text())
    assert values["model"]["sha256"] == AnomalyDetector.from_checkpoint().model_info.sha256
    out = tmp_path / "out"
    assert answer_to(["batch", str(calm), "--out", str(out), "--calibration", str(path)], capsys).code == 0
    assert labels((out / "detections.jsonl").read_text()) <= {"model_error"}
    configuration = json.loads((out / "run.json").read_text())["configuration"]
    assert DetectorConfig.model_validate(configuration["detector"]).regions.motion_score == values["motion_score"]
    assert np.isclose(values["hours"], 4 * 0.05 / 3600)
