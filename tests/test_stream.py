"""Frames and samples as they come: the pairs of a recording, and a fault for whatever does not fit."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from difference_detector import DifferenceDetector
from worlds import World, in_memory, make_world

from viflow_anomaly.batch_job import BatchOptions, run_batch
from viflow_anomaly.config import MotionWindowConfig, TrackingConfig
from viflow_anomaly.detection import Detection, to_json
from viflow_anomaly.errors import ViflowError
from viflow_anomaly.motion_input import build_motion_window
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples
from viflow_anomaly.stream import DetectionStream, StreamConfig, StreamState, StreamStep

FRAMES = 6
Input = Frame | ImuSamples


@pytest.fixture(params=[0.0, 0.02])
def world(request: pytest.FixtureRequest) -> World:
    return make_world(frames=FRAMES, shift_px=0, square_px=24, time_offset_s=request.param)


def frame(world: World, k: int) -> Frame:
    return Frame(int(world.frame_timestamps_ns[k]), world.images[k])


def samples(world: World, rows: slice, *, accel: bool = True) -> ImuSamples:
    imu = world.imu
    assert imu.accel_m_s2 is not None
    return ImuSamples(imu.timestamps_ns[rows], imu.gyro_rad_s[rows], imu.accel_m_s2[rows] if accel else None)


def in_time(world: World, *, packet: int = 3, frame_delay_ns: int = 0) -> list[Input]:
    """Packets of the IMU and frames in the order in which a robot would get them."""
    offset_ns = round(world.camera.time_offset_s * 1e9)
    packets = [samples(world, slice(k, k + packet)) for k in range(0, len(world.imu), packet)]
    timed: list[tuple[int, int, Input]] = [(int(one.timestamps_ns[-1]), 0, one) for one in packets]
    frames = [frame(world, k) for k in range(len(world.images))]
    timed += [(one.timestamp_ns + offset_ns + frame_delay_ns, 1, one) for one in frames]
    return [value for _, _, value in sorted(timed, key=lambda one: one[:2])]


def feed(stream: DetectionStream, inputs: Iterable[Input], state: StreamState | None = None) -> StreamStep:
    """All detections and faults of a sequence of inputs."""
    state = state or StreamState()
    detections: list[Detection] = []
    faults = []
    for one in inputs:
        step = stream.add_frame(state, one) if isinstance(one, Frame) else stream.add_imu(state, one)
        state = step.state
        detections += step.detections
        faults += step.faults
    return StreamStep(state, tuple(detections), tuple(faults))


def codes(step: StreamStep) -> list[str]:
    return [fault.code for fault in step.faults]


def lines(detections: Iterable[Detection]) -> list[str]:
    return [to_json(replace(one, timings_ms={})) for one in detections]


@pytest.mark.parametrize("packet", [1, 3, 40])
@pytest.mark.parametrize("frame_delay_ns", [0, 120_000_000])
def test_a_stream_gives_the_detections_and_tracks_of_a_batch(
    world: World, tmp_path: Path, packet: int, frame_delay_ns: int
) -> None:
    seen: list[FramePair] = []
    stream = DetectionStream(DifferenceDetector(on_pair=seen.append), camera=world.camera)
    step = feed(stream, in_time(world, packet=packet, frame_delay_ns=frame_delay_ns))
    recording = in_memory(world, tmp_path / "frames")
    written: list[FramePair] = []
    run_batch(recording, DifferenceDetector(on_pair=written.append), BatchOptions(out_dir=tmp_path / "out"))
    assert step.faults == ()
    assert [one.rois[0].track_id for one in step.detections] == [1] * 5
    timeless = [
        line.split('"timings_ms"')[0] for line in (tmp_path / "out" / "detections.jsonl").read_text().split("\n")
    ]
    assert [line.split('"timings_ms"')[0] for line in lines(step.detections)] == timeless[:-1]
    for ours, theirs in zip(seen, written, strict=True):
        windows = [build_motion_window(pair, MotionWindowConfig()) for pair in (ours, theirs)]
        np.testing.assert_array_equal(windows[0].values, windows[1].values)
        assert windows[0].faults == windows[1].faults


def test_without_tracking_nothing_is_numbered(world: World) -> None:
    stream = DetectionStream(DifferenceDetector(), world.camera, StreamConfig(tracking=None))
    step = feed(stream, in_time(world))
    assert [one.rois[0].track_id for one in step.detections] == [None] * 5


def test_a_pair_is_judged_as_soon_as_the_imu_reaches_its_target(world: World) -> None:
    stream = DetectionStream(DifferenceDetector(), world.camera)
    target_ns = int(world.frame_timestamps_ns[1]) + round(world.camera.time_offset_s * 1e9)
    row = int(np.searchsorted(world.imu.timestamps_ns, target_ns))
    step = feed(stream, [samples(world, slice(0, row)), frame(world, 0), frame(world, 1)])
    assert step.detections == ()
    assert len(stream.add_imu(step.state, samples(world, slice(row, row + 1))).detections) == 1


def test_a_state_is_left_as_it_was_and_can_be_gone_on_from_twice(world: World) -> None:
    stream = DetectionStream(DifferenceDetector(), world.camera)
    half = feed(stream, in_time(world)[:45])
    rest = in_time(world)[45:]
    first, second = feed(stream, rest, half.state), feed(stream, rest, half.state)
    assert first.detections
    assert lines(first.detections) == lines(second.detections)


@pytest.mark.parametrize(("again", "code"), [(2, "frame_duplicate"), (1, "frame_out_of_order")])
def test_frames_twice_or_out_of_order_are_left_out(world: World, again: int, code: str) -> None:
    stream = DetectionStream(DifferenceDetector(), world.camera)
    frames = [frame(world, k) for k in (0, 1, 2, again, 3)]
    step = feed(stream, [samples(world, slice(0, None)), *frames])
    assert codes(step) == [code]
    assert len(step.detections) == 3
    assert f"found {world.frame_timestamps_ns[again]} ns" in step.faults[0].message


def test_samples_twice_or_out_of_order_are_left_out_and_the_later_ones_taken(world: World) -> None:
    stream = DetectionStream(DifferenceDetector(), world.camera)
    state = feed(stream, [samples(world, slice(0, 50, 2))]).state
    step = stream.add_imu(state, samples(world, slice(44, 49, 2)))
    assert codes(step) == ["imu_duplicate"]
    step = stream.add_imu(state, samples(world, slice(45, 60)))
    assert codes(step) == ["imu_out_of_order"]
    assert "found 4 that are not" in step.faults[0].message
    assert step.state.imu is not None
    assert step.state.imu.timestamps_ns[-12:].tolist() == world.imu.timestamps_ns[48:60].tolist()


@pytest.mark.parametrize("accel", [True, False])
def test_an_accelerometer_does_not_come_or_go(world: World, accel: bool) -> None:
    stream = DetectionStream(DifferenceDetector(), world.camera)
    state = stream.add_imu(StreamState(), samples(world, slice(0, 9), accel=not accel)).state
    step = stream.add_imu(state, samples(world, slice(9, 12), accel=accel))
    assert codes(step) == ["imu_accel_changed"]
    assert step.state.imu is not None
    assert len(step.state.imu) == 9
    assert codes(stream.add_imu(state, samples(world, slice(9, 12), accel=not accel))) == []


def test_frames_whose_imu_does_not_come_are_given_up(world: World) -> None:
    stream = DetectionStream(DifferenceDetector(), world.camera, StreamConfig(max_waiting_frames=3))
    step = feed(stream, [frame(world, k) for k in range(FRAMES)])
    assert codes(step) == ["imu_late"] * 3
    assert [one.timestamp_ns for one in step.state.frames] == world.frame_timestamps_ns[3:].tolist()
    assert len(stream.add_imu(step.state, samples(world, slice(0, None))).detections) == 2


def test_errors_of_a_pair_are_told_and_the_stream_goes_on(world: World) -> None:
    def refuse(pair: FramePair) -> None:
        if pair.source.timestamp_ns == world.frame_timestamps_ns[2]:
            raise ViflowError("no gravity", code="imu_no_gravity", field="imu")

    step = feed(DetectionStream(DifferenceDetector(on_pair=refuse), world.camera), in_time(world))
    assert codes(step) == ["imu_no_gravity"]
    assert "no gravity" in step.faults[0].message
    assert [one.rois[0].track_id for one in step.detections] == [1] * 4


def test_frames_of_another_size_are_told_and_the_stream_goes_on(world: World) -> None:
    small = Frame(int(world.frame_timestamps_ns[2]), world.images[2][:40])
    frames = [frame(world, k) if k != 2 else small for k in range(FRAMES)]
    step = feed(DetectionStream(DifferenceDetector()), [samples(world, slice(0, None)), *frames])
    assert codes(step) == ["image_sizes_differ"] * 2
    assert len(step.detections) == 3


def test_old_samples_are_forgotten(world: World) -> None:
    config = StreamConfig(before_s=0.1, max_frame_delay_s=0.2)
    step = feed(DetectionStream(DifferenceDetector(), world.camera, config), in_time(world))
    assert step.state.imu is not None
    kept_s = np.ptp(step.state.imu.timestamps_ns) * 1e-9
    # The last frame is half a second old, and is the source of the next pair.
    assert kept_s == pytest.approx(0.6, abs=0.006)
    assert len(step.state.frames) == 1
    no_frames = feed(
        DetectionStream(DifferenceDetector(), world.camera, config), [samples(world, slice(0, None))]
    ).state.imu
    assert no_frames is not None
    assert np.ptp(no_frames.timestamps_ns) * 1e-9 == pytest.approx(0.3, abs=0.006)


def test_more_samples_than_may_be_kept_are_dropped_and_told(world: World) -> None:
    config = StreamConfig(max_imu_samples=20, tracking=TrackingConfig())
    step = feed(DetectionStream(DifferenceDetector(), world.camera, config), [samples(world, slice(0, 30))])
    assert codes(step) == ["imu_dropped"]
    assert step.state.imu is not None
    assert step.state.imu.timestamps_ns.tolist() == world.imu.timestamps_ns[10:30].tolist()


def test_frames_that_come_long_after_their_imu_are_told(world: World) -> None:
    config = StreamConfig(before_s=0.0, max_frame_delay_s=0.01)
    stream = DetectionStream(DifferenceDetector(), world.camera, config)
    step = feed(stream, [samples(world, slice(0, None)), frame(world, 0), frame(world, 1)])
    assert codes(step) == ["imu_not_covering"]
