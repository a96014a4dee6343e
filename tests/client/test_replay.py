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
from viflow_anomaly.client import Client, StreamAnswer, replay
from viflow_anomaly.client.replaying import LEAD_NS, SAMPLES_A_CALL, recorded_calls
from viflow_anomaly.config import TrackingConfig
from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.detection_reading import detection_from_json
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.imu_log import ImuLog
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
    assert [call.frame.timestamp_ns for call in calls if call.frame] == world.frame_timestamps_ns.tolist()
    sent: list[int] = []
    for call in calls:
        sent += [] if call.imu is None else call.imu.timestamps_ns.tolist()
        assert call.left_out == ()
        now_ns = call.due_ns + round(offset_s * 1e9)
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

    def send(self, **sent: Any) -> StreamAnswer:
        self.sent_at_s.append(self._clock.now_s())
        self._clock.wait(next(self._after_s))
        begun = len(self.sent_at_s) == 1
        return StreamAnswer((), (), session_id="one", begun=begun, waiting_frames=0, detection_ids=None)


@pytest.mark.parametrize("speed", [-1.0, 1e-4, 1e4, float("nan"), float("inf")])
def test_no_clock_goes_at_every_speed(tmp_path: Path, speed: float) -> None:
    stream = SlowStream(Clock(), answers_after_s=[])
    with pytest.raises(ConfigError, match=r"expected 0 or 0\.001 to 1000") as caught:
        list(replay(recorded(tmp_path / "drone"), stream, speed=speed))  # type: ignore[arg-type]
    assert (caught.value.code, stream.sent_at_s) == ("speed_out_of_range", [])


def test_what_cannot_be_read_is_left_out_and_told(tmp_path: Path, service: LiveServer) -> None:
    folder = write_plain(tmp_path / "drone", make_world(frames=8, square_px=24))
    recording = open_recording(folder)
    (folder / "images" / "0002.png").write_bytes(b"not a picture")
    (folder / "images" / "0007.png").unlink()
    with Client(f"http://127.0.0.1:{service.port}") as client, client.stream("left-out") as stream:
        answers = list(replay(recording, stream, speed=0))
    assert [[fault.code for fault in answer.faults] for answer in answers] == [
        *([], []),
        ["image_unsupported_type"],
        *([], [], [], []),
        ["image_missing"],
    ]
    assert [len(answer) for answer in answers] == [0, 1, 0, 1, 1, 1, 1, 0]  # 1 -> 3 is a pair as well


def test_samples_in_disorder_are_left_out_and_told(tmp_path: Path) -> None:
    folder = write_plain(tmp_path / "drone", make_world())
    lines = (folder / "imu.csv").read_text().splitlines()
    middle = len(lines) // 2
    lines[middle], lines[middle + 1] = lines[middle + 1], lines[middle]
    write_lines(folder / "imu.csv", lines)
    calls = list(recorded_calls(open_recording(folder)))
    told = [[fault.code for fault in call.left_out] for call in calls]
    assert [one for one in told if one] == [["imu_unsorted"]]
    stamps = [stamp for call in calls if call.imu for stamp in call.imu.timestamps_ns.tolist()]
    assert stamps == sorted(set(stamps))


def test_nothing_is_sent_where_there_is_nothing(tmp_path: Path) -> None:
    world = make_world(frames=3, imu_rate_hz=30, margin_s=0.0)
    folder = write_plain(tmp_path / "drone", world)
    lines = (folder / "imu.csv").read_text().splitlines()
    write_lines(folder / "imu.csv", lines[:3])  # up to the second frame
    recording, clock = open_recording(folder), Clock()
    (folder / "images" / "0002.png").unlink()
    stream = SlowStream(clock, answers_after_s=[0.0, 0.0])
    answers = list(replay(recording, stream, now_s=clock.now_s, wait=clock.wait))  # type: ignore[arg-type]
    assert len(stream.sent_at_s) == 2
    assert [[fault.code for fault in answer.faults] for answer in answers] == [[], [], ["image_missing"]]


def test_a_long_pause_of_the_camera_is_sent_in_parts() -> None:
    world = make_world(frames=2, imu_rate_hz=200, margin_s=0.1)
    times = 3 * SAMPLES_A_CALL
    stamps = int(world.frame_timestamps_ns[0]) + np.arange(times, dtype=np.int64) * 1_000_000
    log = ImuLog(stamps, np.zeros((times, 3)), np.zeros((times, 3)))
    frames_ns = np.array([world.frame_timestamps_ns[0], stamps[-1]])
    recording = SimpleNamespace(
        imu=log, camera=None, frame_timestamps_ns=frames_ns, frame=lambda k: Frame(int(frames_ns[k]), world.images[k])
    )
    calls = list(recorded_calls(recording))  # type: ignore[arg-type]
    assert [call.frame is not None for call in calls] == [True, False, False, True]
    assert all(call.imu is not None and len(call.imu) <= SAMPLES_A_CALL for call in calls)
    assert np.concatenate([call.imu.timestamps_ns for call in calls if call.imu]).tolist() == stamps.tolist()


def test_the_last_answer_says_how_many_pairs_wait(tmp_path: Path, service: LiveServer) -> None:
    folder = write_plain(tmp_path / "drone", make_world(frames=6, margin_s=0.0))
    lines = (folder / "imu.csv").read_text().splitlines()
    write_lines(folder / "imu.csv", lines[: len(lines) - 15])  # 200 Hz: it ends 75 ms before the last frame
    recording = open_recording(folder)
    with Client(f"http://127.0.0.1:{service.port}") as client, client.stream("waits") as stream:
        answers = list(replay(recording, stream, speed=0))
    assert sum(len(answer) for answer in answers) == 3
    assert answers[-1].waiting_frames == 2
