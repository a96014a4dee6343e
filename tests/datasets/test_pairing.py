"""Which frames make a pair, and which IMU samples go with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds import in_memory, make_world, with_stamps

from viflow_anomaly.datasets.pairing import RecordingPairs, pair_indices
from viflow_anomaly.datasets.recording import FileRecording
from viflow_anomaly.errors import InvalidInputError


@pytest.fixture
def recording(tmp_path: Path) -> FileRecording:
    return in_memory(make_world(), tmp_path)


def test_pairs_by_source_then_look_ahead() -> None:
    assert pair_indices(4, (2, 1)) == [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]
    assert pair_indices(1, (1,)) == []
    assert pair_indices(5, (4, 4)) == [(0, 4)]


@given(st.integers(0, 12), st.sets(st.integers(1, 4), min_size=1))
def test_pairs_are_complete_and_unique(count: int, steps: set[int]) -> None:
    pairs = pair_indices(count, tuple(steps))
    assert pairs == sorted(set(pairs))
    assert len(pairs) == sum(max(count - step, 0) for step in steps)
    assert all(b - a in steps and a >= 0 and b < count for a, b in pairs)


@pytest.mark.parametrize("look_aheads", [(), (0,), (5,), (1, -1)])
def test_look_ahead_out_of_range(look_aheads: tuple[int, ...], recording: FileRecording) -> None:
    with pytest.raises(InvalidInputError) as caught:
        RecordingPairs(recording, look_aheads)
    assert (caught.value.code, caught.value.field) == ("look_ahead_out_of_range", "look_aheads")


@pytest.mark.parametrize("margin", [-0.1, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["before_s", "after_s"])
def test_margin_out_of_range(name: str, margin: float, recording: FileRecording) -> None:
    with pytest.raises(InvalidInputError) as caught:
        RecordingPairs(recording, **{name: margin})
    assert (caught.value.code, caught.value.field) == ("margin_out_of_range", name)


def test_access_by_index(recording: FileRecording) -> None:
    pairs = RecordingPairs(recording, (1, 3))
    assert len(pairs) == 8
    for k in (-1, 5, 0):
        source, target = pairs.indices[k]
        np.testing.assert_array_equal(pairs[k].source.image, recording.frame(source).image)
        np.testing.assert_array_equal(pairs[k].target.image, recording.frame(target).image)
        assert (pairs[k].source.timestamp_ns, pairs[k].target.timestamp_ns) == pairs.stamps(k)
    assert pairs[0].camera is recording.camera
    for k in (8, -9):
        with pytest.raises(IndexError):
            pairs[k]


def test_slices_and_iteration(recording: FileRecording) -> None:
    pairs = RecordingPairs(recording)
    stamps = [pair.source.timestamp_ns for pair in pairs]
    assert stamps == recording.frame_timestamps_ns[:5].tolist()
    assert [pair.source.timestamp_ns for pair in pairs[3:0:-2]] == [stamps[3], stamps[1]]


def test_imu_reaches_the_margins_and_one_sample_further(recording: FileRecording) -> None:
    pair = RecordingPairs(recording, before_s=0.1, after_s=0.02)[1]
    relative = (pair.imu.timestamps_ns - pair.source.timestamp_ns) / 1e6
    assert (relative[0], relative[-1]) == (-105.0, 75.0)


def test_look_ahead_lengthens_the_slice(recording: FileRecording) -> None:
    lengths = [len(RecordingPairs(recording, (step,), before_s=0.0, after_s=0.0).imu(0)) for step in (1, 2, 3, 4)]
    assert lengths == [13, 23, 33, 43]


def test_time_offset_moves_the_slice(tmp_path: Path) -> None:
    recording = in_memory(make_world(time_offset_s=0.03), tmp_path)
    imu = RecordingPairs(recording, before_s=0.0, after_s=0.0).imu(0)
    first, second = recording.frame_timestamps_ns[:2] + 30_000_000
    assert imu.timestamps_ns[1] == first
    assert imu.timestamps_ns[-2] == second


def test_pairs_too_far_apart_are_listed_not_lost(tmp_path: Path) -> None:
    world = make_world()
    world.frame_timestamps_ns[3:] += 100_000_000
    recording = in_memory(world, tmp_path)
    pairs = RecordingPairs(recording, (1, 2), max_interval_s=0.1)
    assert pairs.skipped == [(1, 3), (2, 3), (2, 4)]
    assert sorted(pairs.indices + pairs.skipped) == pair_indices(6, (1, 2))
    assert RecordingPairs(recording, (1, 2)).skipped == []


def test_imu_disorder_touches_only_its_pairs(tmp_path: Path) -> None:
    world = make_world()
    stamps = world.imu.timestamps_ns.tolist()
    middle = int(np.searchsorted(stamps, world.frame_timestamps_ns[2])) + 5
    stamps[middle], stamps[middle + 1] = stamps[middle + 1], stamps[middle]
    recording = in_memory(world, tmp_path)
    object.__setattr__(recording, "imu", with_stamps(world.imu, stamps))
    pairs = RecordingPairs(recording, before_s=0.01, after_s=0.01)
    for k in (0, 1, 3, 4):
        assert len(pairs[k].imu)
    with pytest.raises(InvalidInputError) as caught:
        pairs[2]
    assert caught.value.code == "imu_unsorted"
