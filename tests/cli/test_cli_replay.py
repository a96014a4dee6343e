"""``replay``: a recording sent to a live service."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from difference_detector import DifferenceDetector
from hypothesis import given
from hypothesis import strategies as st
from pair_world import Ask, PairFolder

sys.path.append(str(Path(__file__).parents[1] / "service"))

from service_world import LiveServer, live_server, wait_until

from viflow_anomaly.cli.replay import _Counted, stream_name
from viflow_anomaly.client import StreamAnswer
from viflow_anomaly_service.parameters import STREAM_ID


@pytest.fixture(scope="module")
def service() -> Iterator[LiveServer]:
    with live_server(lambda settings: DifferenceDetector()) as running:
        yield running


def test_a_detection_a_line_and_what_it_came_to(ask: Ask, pair: PairFolder, service: LiveServer) -> None:
    url = f"http://127.0.0.1:{service.port}"
    answer = ask(["replay", str(pair.folder), "--url", url, "--speed", "0", "--stream", "kept", "--keep"])
    assert answer.code == 0
    found = [json.loads(line) for line in answer.out.splitlines()]
    assert len(found) == 3
    assert all(one["rois"][0]["track_id"] is not None for one in found[1:])
    assert answer.err.splitlines() == [f"{url}, stream kept: 3 pairs, in 3 something moves by itself"]
    assert service.client.get("/streams/kept").json()["received_frames"] == 4
    again = ask(["replay", str(pair.folder), "--url", url, "--speed", "0", "--stream", "kept"])
    assert again.is_refusal("found that of a stream that goes on there")
    assert service.client.get("/streams/kept").status_code == 200  # nobody's but the other's to forget


def test_what_is_left_out_is_told_once_and_in_the_exit_code(ask: Ask, pair: PairFolder, service: LiveServer) -> None:
    lines = (pair.folder / "imu.csv").read_text().splitlines()
    middle = len(lines) // 2
    (pair.folder / "imu.csv").write_text("\n".join([*lines[: middle + 1], *lines[middle:]]) + "\n")
    url = f"http://127.0.0.1:{service.port}"
    answer = ask(["replay", str(pair.folder), "--url", url, "--speed", "0", "--stream", "twice"])
    assert answer.code == 3
    told, summary = answer.err.splitlines()
    assert told.startswith("imu_duplicate_timestamps: timestamps_ns: expected strictly increasing stamps, found ")
    assert "; left out: 1 x imu_duplicate_timestamps" in summary
    assert service.client.get("/streams/twice").status_code == 404


def test_one_frame_is_no_recording(ask: Ask, pair: PairFolder, service: LiveServer) -> None:
    lines = (pair.folder / "frames.csv").read_text().splitlines()
    (pair.folder / "frames.csv").write_text("\n".join(lines[:2]) + "\n")
    answer = ask(["replay", str(pair.folder), "--url", f"http://127.0.0.1:{service.port}"])
    assert answer.is_refusal("expected at least 2 frames, found 1")


def test_a_terminated_replay_has_its_stream_forgotten(pair: PairFolder, service: LiveServer) -> None:
    code = "from viflow_anomaly.cli.main import main; main()"
    place = ["--url", f"http://127.0.0.1:{service.port}", "--stream", "ended", "--speed", "0.02"]
    command = [sys.executable, "-c", code, "replay", str(pair.folder), *place]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as running:
        # With a second frame there, the answer to the first, which tells whose stream it is, has been read.
        wait_until(lambda: service.client.get("/streams/ended").json().get("received_frames", 0) >= 2, seconds=60)
        running.terminate()
        assert running.wait(timeout=60) == 128 + signal.SIGTERM
    assert service.client.get("/streams/ended").status_code == 404


def test_what_is_wrong_is_one_line(ask: Ask, pair: PairFolder, service: LiveServer, tmp_path: Path) -> None:
    url = f"http://127.0.0.1:{service.port}"
    assert ask(["replay", str(tmp_path / "none"), "--url", url]).is_refusal("expected a directory")
    assert ask(["replay", str(pair.folder), "--url", "here"]).is_refusal("expected the address of a service")
    for name in ("a/b", "..", ""):
        assert ask(["replay", str(pair.folder), "--url", url, "--stream", name]).is_refusal("expected 1 to 64 of")
    assert ask(["replay", str(pair.folder), "--url", url, "--speed", "-1"]).is_refusal("expected 0 or 0.001 to 1000")


def test_lines_reach_a_pipe_while_a_person_watches_progress(pair: PairFolder, service: LiveServer) -> None:
    shown, terminal = os.openpty()
    code = "from viflow_anomaly.cli.main import main; main()"
    command = [sys.executable, "-c", code, "replay", str(pair.folder), "--url", f"http://127.0.0.1:{service.port}"]
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=terminal, check=True, env={**os.environ, "TERM": "xterm"}
    )
    os.close(terminal)
    os.close(shown)
    assert len(done.stdout.splitlines()) == 3


def test_a_stream_that_began_anew_and_answers_that_were_lost_are_told() -> None:
    counted = _Counted()
    for begun, lost in ((True, False), (True, False), (False, True)):
        counted.add(
            StreamAnswer((), (), session_id="s", begun=begun, waiting_frames=2, detection_ids=None, answer_lost=lost)
        )
    assert str(counted) == (
        "0 pairs, in 0 something moves by itself; 2 frames wait for IMU samples that did not come; "
        "the service forgot the stream and began it anew 1 times; 1 answers were lost on their way"
    )


@pytest.mark.parametrize(
    ("recording", "name"),
    [("V1_01_easy", "V1_01_easy"), ("Monday, hall", "Monday-hall"), ("..", "recording"), ("x" * 90, "x" * 64)],
)
def test_a_recordings_name_becomes_a_streams(recording: str, name: str) -> None:
    assert stream_name(recording) == name


@given(st.text())
def test_every_name_becomes_one_that_the_service_takes(recording: str) -> None:
    assert STREAM_ID.fullmatch(stream_name(recording))
    assert stream_name(stream_name(recording)) == stream_name(recording)
