from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from difference_detector import DifferenceDetector
from pair_world import Ask, PairFolder
from worlds import WRITERS, make_world, write_plain

from viflow_anomaly.cli.batch import default_out_dir
from viflow_anomaly.sensor_data import FramePair


def lines(out: Path) -> list[str]:
    return (out / "detections.jsonl").read_text().splitlines()


def test_results_go_beside_the_recording(ask: Ask, pair: PairFolder) -> None:
    answer = ask(["batch", str(pair.folder)])
    out = pair.folder.with_name("recording-detections")
    assert (answer.code, answer.err) == (0, "")
    assert answer.out.startswith("3 pairs in ")
    assert f"3 ok, 0 abstained, 0 failed -> {out}" in answer.out
    assert len(lines(out)) == 3


@pytest.mark.parametrize(
    ("directory", "expected"),
    [("a/mav0", "a/mav0-detections"), ("a/mav0/", "a/mav0-detections"), ("a/..", None), (".", None)],
)
def test_default_out_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, directory: str, expected: str | None) -> None:
    here = tmp_path / "here"
    (here / "a").mkdir(parents=True)
    monkeypatch.chdir(here)
    found = default_out_dir(Path(directory))
    assert found == (Path(expected) if expected else tmp_path / "here-detections")


@pytest.mark.parametrize("layout", sorted(WRITERS))
def test_every_layout(ask: Ask, tmp_path: Path, layout: str) -> None:
    folder = WRITERS[layout](tmp_path / "data")
    answer = ask(["batch", str(folder), "--out", str(tmp_path / "out"), "--limit", "2", "--json"])
    assert (answer.code, answer.err) == (0, "")
    assert len(lines(tmp_path / "out")) == 2


def test_json_is_run_json_and_nothing_else(ask: Ask, pair: PairFolder, tmp_path: Path) -> None:
    answer = ask(["batch", str(pair.folder), "--out", str(tmp_path / "out"), "--json", "--threads", "1"])
    run = json.loads(answer.out)
    assert run == json.loads((tmp_path / "out" / "run.json").read_text())
    assert run["counts"]["ok"] == 3
    assert run["configuration"]["threads"] == 1
    assert run["configuration"]["checkpoint"] is None


def test_options_reach_the_run(ask: Ask, pair: PairFolder, tmp_path: Path) -> None:
    out = tmp_path / "out"
    which = ["--format", "plain", "--look-ahead", "2", "--limit", "1"]
    how = ["--overlays", "all", "--video", "--masks", "--set", "detector.regions.max_regions=5"]
    how += ["--set", "tracking.max_tracks=9"]
    answer = ask(["batch", str(pair.folder), "--out", str(out), *which, *how])
    assert answer.code == 0
    run = json.loads((out / "run.json").read_text())
    rig_estimate = run["options"].pop("rig_estimate")
    assert (rig_estimate["enabled"], rig_estimate["apply"]) == (True, False)
    assert run["rig_estimate"] is None  # this detector does not know how the camera turned
    tracking = run["options"].pop("tracking")
    assert run["options"] == {"look_ahead": 2, "limit": 1, "overlays": "all", "video": True}
    assert (tracking["max_tracks"], tracking["max_gap_s"]) == (9, 0.6)
    assert run["configuration"]["detector"]["regions"]["max_regions"] == 5
    assert run["configuration"]["detector"]["include_masks"] is True
    assert sorted(path.name for path in out.iterdir()) == ["detections.jsonl", "overlay.mp4", "overlays", "run.json"]


def test_tracking_can_be_turned_off(ask: Ask, pair: PairFolder, tmp_path: Path) -> None:
    for name, how in (("on", []), ("off", ["--no-track"])):
        assert ask(["batch", str(pair.folder), "--out", str(tmp_path / name), *how]).code == 0
    numbered = {
        name: {roi["track_id"] for line in lines(tmp_path / name) for roi in json.loads(line)["rois"]}
        for name in ("on", "off")
    }
    assert numbered["off"] == {None}
    assert 1 in numbered["on"]
    assert json.loads((tmp_path / "off" / "run.json").read_text())["options"]["tracking"] is None


def test_layers_of_settings_are_recorded_as_they_resolved(
    ask: Ask, pair: PairFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tmp_path / "settings.toml"
    config.write_text("[detector.regions]\nmax_regions = 3\nthreshold_mads = 7\nclosing_fraction = 0.01\n")
    monkeypatch.setenv("VIFLOW_DETECTOR__REGIONS__MAX_REGIONS", "4")
    monkeypatch.setenv("VIFLOW_DETECTOR__REGIONS__THRESHOLD_MADS", "8")
    arguments = [
        "batch",
        str(pair.folder),
        "--config",
        str(config),
        "--set",
        "detector.regions.max_regions=5",
        "--json",
    ]
    regions = json.loads(ask(arguments).out)["configuration"]["detector"]["regions"]
    assert (regions["max_regions"], regions["threshold_mads"], regions["closing_fraction"]) == (5, 8, 0.01)


def test_failed_pairs_give_exit_code_3_and_are_named(ask: Ask, pair: PairFolder, tmp_path: Path) -> None:
    pair.source.write_bytes(b"")
    answer = ask(["batch", str(pair.folder), "--out", str(tmp_path / "out")])
    assert answer.code == 3
    assert "2 ok, 0 abstained, 1 failed" in answer.out
    assert answer.err.startswith("failed: ")
    assert "[image_empty]" in answer.err
    assert len(lines(tmp_path / "out")) == 2


def test_many_failures_are_cut_short(ask: Ask, tmp_path: Path) -> None:
    folder = write_plain(tmp_path / "data", make_world(frames=9))
    for image in (folder / "images").iterdir():
        image.write_bytes(b"")
    answer = ask(["batch", str(folder)])
    assert answer.code == 3
    assert len(answer.err.splitlines()) == 6
    assert answer.err.splitlines()[-1].startswith("failed: and 3 more, see ")


def test_second_run_is_refused_then_resumes_then_overwrites(ask: Ask, pair: PairFolder) -> None:
    arguments = ["batch", str(pair.folder)]
    assert ask([*arguments, "--limit", "1"]).code == 0
    assert ask(arguments).is_refusal("[output_not_empty]")
    assert "3 ok" in ask([*arguments, "--resume"]).out
    assert ask([*arguments, "--resume", "--set", "detector.regions.max_regions=1"]).is_refusal(
        "[resume_config_differs]"
    )
    assert "1 ok" in ask([*arguments, "--overwrite", "--limit", "1"]).out
    assert ask([*arguments, "--overwrite", "--resume"]).is_refusal("give one of them")


def test_interrupt_keeps_what_is_done(ask: Ask, pair: PairFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []

    def interrupt(pair: FramePair) -> None:
        seen.append(pair.source.timestamp_ns)
        if len(seen) == 3:
            raise KeyboardInterrupt

    arguments = ["batch", str(pair.folder)]
    with monkeypatch.context() as patch:
        patch.setattr("viflow_anomaly.cli.batch.load_detector", lambda settings: DifferenceDetector(on_pair=interrupt))
        answer = ask(arguments)
    assert (answer.code, answer.out) == (130, "")
    assert "interrupted: what is done is kept in" in answer.err
    assert "go on with --resume" in answer.err
    assert ask([*arguments, "--resume"]).code == 0
    run = json.loads((pair.folder.with_name("recording-detections") / "run.json").read_text())
    assert (run["reused"], run["counts"]["ok"]) == (2, 3)


def test_a_full_disk_is_an_error_that_says_how_to_go_on(
    ask: Ask, pair: PairFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("viflow_anomaly.batch_files.Journal.append", full)
    answer = ask(["batch", str(pair.folder)])
    assert answer.is_refusal("No space left on device; what is done is kept in")
    assert "--resume" in answer.err


# --- bad input


def test_bad_directories(ask: Ask, pair: PairFolder, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert ask(["batch", str(tmp_path / "nowhere")]).is_refusal("[directory_missing]")
    assert ask(["batch", str(pair.source)]).is_refusal("[not_a_directory]")
    assert ask(["batch", str(tmp_path / "empty")]).is_refusal("[layout_unknown]")
    assert ask(["batch", str(pair.folder), "--format", "rosbag"]).is_refusal("[format_unknown]")
    assert ask(["batch", str(pair.folder), "--format", "euroc"]).is_refusal("[layout_unknown]")
    assert ask(["batch", str(pair.folder), "--camera", "cam1"]).is_refusal("[camera_unknown]")


def test_an_image_that_the_table_names_is_missing(ask: Ask, pair: PairFolder) -> None:
    pair.target.unlink()
    assert ask(["batch", str(pair.folder)]).is_refusal("frames.csv, line 3: expected the image")


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("frames.csv", "a,b\n", "frames.csv, line 1"),
        ("imu.csv", "timestamp_ns,gyro_x,gyro_y,gyro_z\n1,2,3,x\n", "imu.csv, line 2: expected a finite number"),
        ("camera.json", "{}", "camera.json: camera.fx"),
    ],
)
def test_malformed_files_are_named(ask: Ask, pair: PairFolder, name: str, text: str, words: str) -> None:
    (pair.folder / name).write_text(text)
    assert ask(["batch", str(pair.folder)]).is_refusal(words)


def test_a_recording_of_one_frame(ask: Ask, pair: PairFolder) -> None:
    table = (pair.folder / "frames.csv").read_text().splitlines()
    (pair.folder / "frames.csv").write_text("\n".join(table[:2]))
    assert ask(["batch", str(pair.folder)]).is_refusal("expected at least 2 frames, found 1 [recording_too_short]")


def test_out_is_a_file(ask: Ask, pair: PairFolder) -> None:
    assert ask(["batch", str(pair.folder), "--out", str(pair.source)]).is_refusal("File exists")


def test_out_below_a_file(ask: Ask, pair: PairFolder) -> None:
    assert ask(["batch", str(pair.folder), "--out", str(pair.source / "out")]).is_refusal("Not a directory")


@pytest.mark.parametrize(
    "arguments",
    [["--overlays", "some"], ["--overlays", "-1"], ["--look-ahead", "5"], ["--look-ahead", "0"], ["--limit", "0"]],
)
def test_bad_usage(ask: Ask, pair: PairFolder, arguments: list[str]) -> None:
    assert ask(["batch", str(pair.folder), *arguments]).is_refusal(f"Invalid value for '{arguments[0]}'")


SLOW_RUN = """
import sys, time
sys.path.insert(0, {tests!r})
from difference_detector import DifferenceDetector
from viflow_anomaly.cli import batch
from viflow_anomaly.cli.main import run

batch.load_detector = lambda settings: DifferenceDetector(on_pair=lambda pair: time.sleep(0.2))
sys.exit(run(["batch", {folder!r}, "--out", {out!r}, "--overlays", "2"]))
"""


def test_a_killed_run_resumes_to_the_same_results(ask: Ask, tmp_path: Path) -> None:
    folder = write_plain(tmp_path / "data", make_world(frames=8, square_px=24))
    whole, out = tmp_path / "whole", tmp_path / "killed"
    assert ask(["batch", str(folder), "--out", str(whole), "--overlays", "2"]).code == 0

    code = SLOW_RUN.format(tests=str(Path(__file__).parents[1]), folder=str(folder), out=str(out))
    journal = out / "detections.jsonl.partial"
    with subprocess.Popen([sys.executable, "-c", code]) as process:
        while process.poll() is None and not (journal.exists() and journal.read_bytes().count(b"\n") >= 3):
            time.sleep(0.01)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    assert not (out / "detections.jsonl").exists()

    answer = ask(["batch", str(folder), "--out", str(out), "--overlays", "2", "--resume"])
    assert answer.code == 0
    assert json.loads((out / "run.json").read_text())["reused"] >= 3
    assert without_timings(lines(out)) == without_timings(lines(whole))
    for picture in (whole / "overlays").iterdir():
        assert (out / "overlays" / picture.name).read_bytes() == picture.read_bytes()


def without_timings(texts: list[str]) -> list[str]:
    """The lines as bytes would be without ``timings_ms``, the last field."""
    return [text.partition(',"timings_ms":')[0] for text in texts]
