"""A recording that is sent to a service: every sample once, every frame in its time, answers as the library's."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

sys.path.append(str(Path(__file__).parents[1] / "service"))

from difference_detector import DifferenceDetector
from service_world import LiveServer, live_server
from test_client import without_times
from worlds import make_world, write_lines, write_plain

from viflow_anomaly.batch_job import BatchOptions, run_batch
from viflow_anomaly.client import Client, replay
from viflow_anomaly.client.replay import LEAD_NS, recorded_calls
from viflow_anomaly.config import TrackingConfig
from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.detection_reading import detection_from_json
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.sensor_data import Frame


@pytest.fixture(scope="module")
def service() -> Iterator[LiveServer]:
    with live_server(lambda settings: DifferenceDetector()) as running:
        yield running


def recorded(folder: Path, **world: Any) -> Recording:
    return open_recording(write_plain(folder, make_world(square_px=24, **world)))


def test_the_service_says_what_a_batch_says(tmp_path: Path, service: LiveServer) -> None:
    recording = recorded(tmp_path / "drone", time_offset_s=0.004)
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=tmp_path / "out", tracking=TrackingConfig()))
    lines = (tmp_path / "out" / "detections.jsonl").read_text().splitlines()
    expected = [without_times(detection_from_json(line)) for line in lines]
    found, begun = [], []
    with Client(f"http://127.0.0.1:{service.port}") as client:
        with client.stream("replayed", camera=recording.camera) as stream:
            for answer in replay(recording, stream, speed=0):
                assert answer.faults == ()
                begun.append(answer.begun)
                found += [without_times(one) for one in answer]
        assert begun == [True] + [False] * (len(recording) - 1)
    assert found == expected


@given(imu_rate_hz=st.integers(3, 400), margin_s=st.floats(0.0, 3.0), offset_s=st.floats(-0.05, 0.05))
def test_every_sample_is_sent_once_and_in_time(imu_rate_hz: int, margin_s: float, offset_s: float) -> None:
    world = make_world(frames=4, imu_rate_hz=imu_rate_hz, margin_s=margin_s, time_offset_s=offset_s)
    recording = SimpleNamespace(
        imu=world.imu,
        camera=world.camera,
        frame_timestamps_ns=world.frame_timestamps_ns,
        frame=lambda k: Frame(int(world.frame_timestamps_ns[k]), world.images[k]),
    )
    calls = list(recorded_calls(recording))  # type: ignore[arg-type]
    assert [call.frame.timestamp_ns for call in calls] == world.frame_timestamps_ns.tolist()
    sent: list[int] = []
    for call in calls:
        sent += [] if call.imu is None else call.imu.timestamps_ns.tolist()
        now_ns = call.frame.timestamp_ns + round(offset_s * 1e9)
        stamps = world.imu.timestamps_ns
        assert set(stamps[(stamps <= now_ns) & (stamps > now_ns - LEAD_NS)].tolist()) <= set(sent)
        assert sum(stamp > now_ns for stamp in sent) <= 1
    assert sent == sorted(set(sent))
    assert not sent or sent[0] > int(world.frame_timestamps_ns[0]) + round(offset_s * 1e9) - LEAD_NS


def test_frames_go_out_when_they_were_taken(tmp_path: Path) -> None:
    recording = recorded(tmp_path / "drone", frame_rate_hz=20)
    clock = Clock()
    stream = SlowStream(clock, answers_after_s=[0.0, 0.02, 0.2, 0.0, 0.0, 0.0])
    assert len(list(replay(recording, stream, speed=2.0, now_s=clock.now_s, wait=clock.wait))) == 6  # type: ignore[arg-type]
    # 25 ms apart; the third answer takes 200 ms, and what was due meanwhile follows at once
    assert stream.sent_at_s == pytest.approx([100.0, 100.025, 100.05, 100.25, 100.25, 100.25])
    at_once = SlowStream(clock, answers_after_s=[0.01] * 6)
    began_s = clock.now_s()
    list(replay(recording, at_once, speed=0, now_s=clock.now_s, wait=clock.wait))  # type: ignore[arg-type]
    assert np.diff([began_s, *at_once.sent_at_s]) == pytest.approx([0.0] + [0.01] * 5)


class Clock:
    """Time that passes when somebody waits."""

    def __init__(self) -> None:
        self._s = 100.0

    def now_s(self) -> float:
        return self._s

    def wait(self, seconds: float) -> None:
        assert seconds >= 0
        self._s += seconds


class SlowStream:
    """Answers nothing, some time later."""

    def __init__(self, clock: Clock, answers_after_s: list[float]) -> None:
        self.sent_at_s: list[float] = []
        self._clock, self._after_s = clock, iter(answers_after_s)

    def send(self, **sent: Any) -> object:
        self.sent_at_s.append(self._clock.now_s())
        self._clock.wait(next(self._after_s))
        return object()


def test_disorder_among_samples_is_told(tmp_path: Path) -> None:
    folder = write_plain(tmp_path / "drone", make_world())
    lines = (folder / "imu.csv").read_text().splitlines()
    middle = len(lines) // 2
    lines[middle], lines[middle + 1] = lines[middle + 1], lines[middle]
    write_lines(folder / "imu.csv", lines)
    with pytest.raises(InvalidInputError) as caught:
        list(recorded_calls(open_recording(folder)))
    assert caught.value.code == "imu_unsorted"
