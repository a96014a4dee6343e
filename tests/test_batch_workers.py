from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import batch_helpers
import numpy as np
import pytest
from difference_detector import DifferenceDetector
from turning_detector import TurningDetector
from worlds import in_memory, make_world, write_plain

from viflow_anomaly.batch_job import BatchOptions, run_batch
from viflow_anomaly.batch_pairs import JudgedPair, PairJudge, PairTask
from viflow_anomaly.batch_workers import QUEUED_PER_HELPER, Helpers, answers_in_order
from viflow_anomaly.config import RigEstimateConfig
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.recording import FileRecording
from viflow_anomaly.errors import ViflowError
from viflow_anomaly.sensor_data import FramePair

FRAMES = 40


@pytest.fixture
def recording(tmp_path: Path) -> FileRecording:
    return in_memory(make_world(frames=FRAMES, width=192, square_px=24), tmp_path / "frames")


def lines(out: Path) -> list[dict[str, Any]]:
    found = [json.loads(line) for line in (out / "detections.jsonl").read_text().splitlines()]
    for detection in found:
        del detection["timings_ms"]
    return found


def rig_of(out: Path) -> Any:
    return json.loads((out / "run.json").read_text())["rig_estimate"]


def waiting_for(folder: Path) -> DifferenceDetector:
    """A detector of the main process that gives helpers the time to start: without them it would be done before."""
    mine = batch_helpers.difference(folder)

    def judge(pair: FramePair) -> None:
        mine.on_pair(pair)
        until = time.monotonic() + 60
        while len(list(folder.iterdir())) >= 8 and not processes(folder) - {os.getpid()} and time.monotonic() < until:
            time.sleep(0.02)

    return DifferenceDetector(on_pair=judge)


def processes(folder: Path) -> set[int]:
    return {int(path.name.partition("-")[0]) for path in folder.iterdir()}


def test_helpers_change_nothing(recording: FileRecording, tmp_path: Path) -> None:
    """Every pair is judged once, in this process or in the other, and all files are those of a run without helpers."""
    recording.frame_paths[20].write_bytes(b"")
    alone, shared, seen = tmp_path / "alone", tmp_path / "shared", tmp_path / "seen"
    seen.mkdir()
    options = {"overlays": 5, "video": True}
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=alone, **options))
    told: list[tuple[int, int, int]] = []
    summary = run_batch(
        recording,
        waiting_for(seen),
        BatchOptions(out_dir=shared, **options),
        helpers=Helpers(1, partial(batch_helpers.difference, seen), worth_s=0),
        on_progress=lambda *counts: told.append(counts),
    )
    assert len(processes(seen)) == 2
    judged = [int(path.name.partition("-")[2]) for path in seen.iterdir()]
    stamps = recording.frame_timestamps_ns.tolist()
    assert sorted(judged) == [*stamps[:19], *stamps[21:-1]]
    assert lines(shared) == lines(alone)
    assert [failure.source_timestamp_ns for failure in summary.failures] == stamps[19:21]
    assert [one[0] for one in told] == [*range(1, FRAMES)]
    pictures = sorted(path.name for path in (alone / "overlays").iterdir())
    assert sorted(path.name for path in (shared / "overlays").iterdir()) == pictures
    for name in (*(f"overlays/{picture}" for picture in pictures), "overlay.mp4"):
        assert (shared / name).read_bytes() == (alone / name).read_bytes()


def test_the_rig_is_learnt_in_the_order_of_time(recording: FileRecording, tmp_path: Path) -> None:
    alone, shared = tmp_path / "alone", tmp_path / "shared"
    run_batch(recording, TurningDetector(), BatchOptions(out_dir=alone))
    helpers = Helpers(1, batch_helpers.turning, worth_s=0)
    run_batch(
        recording, TurningDetector(on_pair=lambda pair: time.sleep(0.05)), BatchOptions(out_dir=shared), helpers=helpers
    )
    assert (shared / "rig_estimate.jsonl").read_bytes() == (alone / "rig_estimate.jsonl").read_bytes()
    assert rig_of(shared) == rig_of(alone)
    assert lines(shared) == lines(alone)


def test_an_estimate_that_is_applied_takes_no_helpers(recording: FileRecording, tmp_path: Path) -> None:
    """Each pair depends on the ones before it."""
    config = RigEstimateConfig(apply=True)
    detector = TurningDetector()
    options = BatchOptions(out_dir=tmp_path / "out", rig_estimate=config)
    run_batch(recording, detector, options, helpers=Helpers(1, batch_helpers.killed, worth_s=0))
    assert len(detector.seen) == FRAMES - 1


def test_little_work_starts_no_helper(recording: FileRecording, tmp_path: Path) -> None:
    detector = DifferenceDetector()
    run_batch(recording, detector, BatchOptions(out_dir=tmp_path / "out"), helpers=Helpers(3, batch_helpers.killed))
    assert len(detector.seen) == FRAMES - 1


def slowly(pair: FramePair) -> None:
    time.sleep(0.2)


def test_a_helper_that_dies_ends_the_run_and_resume_goes_on(recording: FileRecording, tmp_path: Path) -> None:
    alone, out = tmp_path / "alone", tmp_path / "out"
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=alone))
    with pytest.raises(ViflowError, match="go on with --resume") as caught:
        run_batch(
            recording,
            DifferenceDetector(on_pair=slowly),
            BatchOptions(out_dir=out),
            helpers=Helpers(1, batch_helpers.killed, worth_s=0),
        )
    assert (caught.value.code, caught.value.field) == ("batch_helper_died", "jobs")
    assert not (out / "detections.jsonl").exists()
    assert json.loads((out / "run.json").read_text())["state"] == "running"
    summary = run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, resume=True))
    assert summary.reused >= 6
    assert lines(out) == lines(alone)


def test_what_keeps_a_helper_from_loading_is_raised_here(recording: FileRecording, tmp_path: Path) -> None:
    with pytest.raises(MemoryError, match="no room for a second network"):
        run_batch(
            recording,
            DifferenceDetector(on_pair=slowly),
            BatchOptions(out_dir=tmp_path / "out"),
            helpers=Helpers(1, batch_helpers.raising, worth_s=0),
        )


def test_few_pairs_are_under_way_at_a_time(recording: FileRecording, tmp_path: Path) -> None:
    """However fast tasks come, they are taken a bounded number ahead of the answers."""
    pairs = RecordingPairs(recording)
    seen = tmp_path / "seen"
    seen.mkdir()
    taken = count()
    ahead: list[int] = []

    def tasks() -> Any:
        for index in range(len(pairs)):
            next(taken)
            yield PairTask(index, draw=False, applied=np.zeros(7))

    judge = PairJudge(pairs, waiting_for(seen), RigEstimateConfig())
    helpers = Helpers(1, partial(batch_helpers.difference, seen), worth_s=0)
    stamps = []
    for answered, answer in enumerate(answers_in_order(tasks(), len(pairs), judge, helpers)):
        assert isinstance(answer, JudgedPair)
        stamps.append(json.loads(answer.text)["source_timestamp_ns"])
        ahead.append(int(repr(taken)[6:-1]) - answered)
    assert stamps == recording.frame_timestamps_ns[:-1].tolist()
    assert max(ahead) <= QUEUED_PER_HELPER + 4 + 1


RUN = """
import sys
from functools import partial
from pathlib import Path

sys.path.insert(0, {tests!r})
import batch_helpers
from viflow_anomaly.cli import batch
from viflow_anomaly.cli.main import run
from viflow_anomaly.batch_workers import Helpers

own, helper = (Path({out!r}).with_name(name) for name in ("own", "helper"))
batch.load_detector = lambda settings: batch_helpers.slow(own)
batch._helpers = lambda jobs, settings: Helpers(1, partial(batch_helpers.slow, helper), worth_s=0)
if __name__ == "__main__":
    sys.exit(run(["batch", {folder!r}, "--out", {out!r}, "--jobs", "2"]))
"""


def ended(pid: int) -> bool:
    """Also a process that nobody has waited for yet is one."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_or_killed_run_leaves_no_helper_and_resumes(tmp_path: Path, how: signal.Signals) -> None:
    """Ctrl-C goes to the whole group of processes, as from a terminal; a kill to the main one alone."""
    folder = write_plain(tmp_path / "data", make_world(frames=400, width=48, height=32))
    out, script = tmp_path / "out", tmp_path / "run.py"
    script.write_text(RUN.format(tests=str(Path(__file__).parent), folder=str(folder), out=str(out)))
    process = subprocess.Popen(
        [sys.executable, str(script)], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, process_group=0
    )
    helper = tmp_path / "helper"
    try:
        while process.poll() is None and not (helper.exists() and helper.read_text()):
            time.sleep(0.02)
        time.sleep(0.3)
        (os.killpg if how is signal.SIGINT else os.kill)(process.pid, how)
        printed, said = process.communicate(timeout=60)
    finally:
        process.kill()
    until = time.monotonic() + 30
    while not ended(int(helper.read_text())) and time.monotonic() < until:
        time.sleep(0.02)
    assert ended(int(helper.read_text()))
    assert process.returncode == (130 if how is signal.SIGINT else -signal.SIGKILL)
    assert printed == ""
    assert "Traceback" not in said
    if how is signal.SIGINT:
        assert said.splitlines()[-1].startswith("interrupted: what is done is kept in")
    assert not (out / "detections.jsonl").exists()
    recording = in_memory(make_world(frames=400, width=48, height=32), tmp_path / "again")
    assert (out / "detections.jsonl.partial").read_bytes().count(b"\n") < len(recording) - 1
    resumed = subprocess.run(
        [sys.executable, "-c", RESUME.format(tests=str(Path(__file__).parent), folder=str(folder), out=str(out))],
        check=True,
        capture_output=True,
        text=True,
    )
    assert "399 ok" in resumed.stdout
    assert json.loads((out / "run.json").read_text())["reused"] >= 6


RESUME = """
import sys
sys.path.insert(0, {tests!r})
from difference_detector import DifferenceDetector
from viflow_anomaly.cli import batch
from viflow_anomaly.cli.main import run

batch.load_detector = lambda settings: DifferenceDetector()
sys.exit(run(["batch", {folder!r}, "--out", {out!r}, "--jobs", "1", "--resume"]))
"""
