"""Tracks in closed form: who keeps a number, who gets one, who loses it."""

from __future__ import annotations

import random
from collections.abc import Iterable, Sequence
from dataclasses import FrozenInstanceError, replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from moving_boxes import detection, roi

from viflow_anomaly.config import TrackingConfig
from viflow_anomaly.detection import OWN_VELOCITY_NAMES, Detection, ImageSize, Roi
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.tracking import Tracker, TrackingState

TWO_SIGHTINGS = TrackingConfig(confirm_score=1.0)


def follow(
    detections: Iterable[Detection], config: TrackingConfig = TWO_SIGHTINGS
) -> tuple[TrackingState, list[Detection]]:
    """All steps of one stream: the last state and the tracked detections."""
    tracker, state, tracked = Tracker(config), TrackingState(), []
    for one in detections:
        state, after = tracker.update(state, one)
        tracked.append(after)
    return state, tracked


def numbers(tracked: Sequence[Detection]) -> list[list[int | None]]:
    """Track numbers by detection, its regions from left to right."""
    return [[one.track_id for one in sorted(det.rois, key=lambda one: one.bbox)] for det in tracked]


def test_a_box_at_constant_velocity_over_a_panning_camera_keeps_its_number() -> None:
    # The world goes 25 px to the left a frame, the box 6 px to the right of it: faster than any overlap of its boxes.
    boxes = [detection(k, [roi(550 - 19 * k, 100, 12, 12, static=(-25.0, 0.0))]) for k in range(20)]
    state, tracked = follow(boxes)
    assert numbers(tracked) == [[None]] + [[1]] * 19
    (track,) = state.tracks
    assert track.box.own_velocity_px_s == pytest.approx((120.0, 0.0), abs=5.0)
    assert track.static_px_s == (-500.0, 0.0)
    told = [tracked[-1].rois[0].evidence[name] for name in OWN_VELOCITY_NAMES]
    assert told == pytest.approx(track.box.own_velocity_px_s, abs=0.005)
    assert (track.sightings, track.last_seen_ns) == (20, tracked[-1].source_timestamp_ns)


@pytest.mark.parametrize(("told", "later"), [(True, 1), (False, None)])
def test_a_jerk_of_the_camera_is_followed_where_the_static_flow_is_told(told: bool, later: int | None) -> None:
    pan = [0, 40, 0, 40, 0, 40, 0]  # to the left and back again
    frames = [
        detection(k, [roi(300 - here, 100, 12, 12, static=(here - there, 0.0) if told else None)])
        for k, (here, there) in enumerate(zip(pan, [*pan[1:], 0], strict=True))
    ]
    assert numbers(follow(frames)[1]) == [[None]] + [[later]] * 6


def test_two_crossing_boxes_keep_their_numbers() -> None:
    def boxes(k: int) -> list[Roi]:
        return [roi(100 + 10 * k, 200, static=(0.0, 0.0)), roi(300 - 10 * k, 206, 30, 40)]

    _, tracked = follow(detection(k, boxes(k)) for k in range(20))
    by_frame = [{one.bbox.y: one.track_id for one in det.rois} for det in tracked[1:]]
    assert by_frame == [{200: 1, 206: 2}] * 19


@pytest.mark.parametrize("missed", [1, 3, 5])
def test_a_box_that_is_missed_for_a_while_comes_back_with_its_number(missed: int) -> None:
    gone = range(8, 8 + missed)  # 0.05 s each, with max_missed_s 0.3
    frames = [detection(k, [] if k in gone else [roi(100 + 9 * k, 50, static=(4.0, 0.0))]) for k in range(20)]
    _, tracked = follow(frames)
    assert [det for det in numbers(tracked) if det] == [[None]] + [[1]] * (19 - missed)


@pytest.mark.parametrize(("told", "number"), [(True, 1), (False, None)])
def test_a_missed_track_goes_where_other_regions_say_the_world_goes(told: bool, number: int | None) -> None:
    # The box is seen in frames 0 to 3 and in frame 6; the pan of 60 px a frame begins in frame 4.
    frames = [detection(k, [roi(300, 100, 12, 12)]) for k in range(4)]
    elsewhere = roi(400, 300, score=0.1, label="model_error", static=(-60.0, 0.0) if told else None)
    frames += [detection(k, [elsewhere]) for k in (4, 5)]
    frames += [detection(6, [roi(300 - 120, 100, 12, 12)])]
    assert numbers(follow(frames)[1])[-1] == [number]


def test_the_nearest_region_counts_most() -> None:
    frames = [detection(k, [roi(100, 100)]) for k in range(2)]
    near = roi(100, 148, score=0.1, label="model_error", static=(10.0, 0.0))
    far = roi(100, 388, score=0.1, label="model_error", static=(-10.0, 0.0))
    state, _ = follow([*frames, detection(2, [near, far])])
    near_weight, far_weight = 1 / (48**2 + 1), 1 / (288**2 + 1)
    expected_px = 10.0 * (near_weight - far_weight) / (near_weight + far_weight)
    assert state.tracks[0].static_px_s == pytest.approx((expected_px / 0.05, 0.0))


def test_a_box_that_was_missed_for_too_long_is_another_thing() -> None:
    frames = [detection(k, [] if 5 <= k < 13 else [roi(100, 50)]) for k in range(15)]
    state, tracked = follow(frames)
    assert numbers(tracked)[-2:] == [[None], [2]]
    assert [track.track_id for track in state.tracks] == [2]


def test_a_confirmed_track_ends_where_the_image_ends() -> None:
    frames = [detection(k, [roi(max(0, 60 - 20 * k), 50, 20, 20, static=(0.0, 0.0))]) for k in range(4)]
    state, _ = follow([*frames, detection(4), detection(5)])
    assert state.tracks == ()


def test_the_gate_keeps_a_far_region_from_a_track() -> None:
    near, far = roi(102, 50), roi(400, 300)
    first = [detection(k, [roi(100, 50)]) for k in range(3)]
    assert numbers(follow([*first, detection(3, [near])])[1])[-1] == [1]
    assert numbers(follow([*first, detection(3, [far])])[1])[-1] == [None]
    assert numbers(follow([*first, detection(3, [roi(100, 50, 400, 400)])])[1])[-1] == [None]  # another size


def test_each_region_feeds_one_track_and_each_track_takes_one_region() -> None:
    frames = [detection(k, [roi(100, 50), roi(150, 50)]) for k in range(3)]
    frames += [detection(3, [roi(104, 50)]), detection(4, [roi(100, 50), roi(112, 50), roi(150, 50)])]
    assert numbers(follow(frames)[1])[1:] == [[1, 2], [1, 2], [1], [1, None, 2]]


def test_numbers_are_never_used_again() -> None:
    frames = [detection(k, [roi(100 + 250 * (k // 4 % 2), 50)]) for k in range(24)]
    state, tracked = follow(frames, TrackingConfig(confirm_score=1.0, max_missed_s=0.0))
    assert numbers(tracked) == [[None if k % 4 == 0 else 1 + k // 4] for k in range(24)]
    assert state.next_id == 7


# --- hysteresis


def test_a_sighting_alone_has_no_number_and_leaves_nothing_behind() -> None:
    state, tracked = follow([detection(0, [roi(100, 50)]), detection(1)])
    assert numbers(tracked) == [[None], []]
    assert (state.tracks, state.next_id) == ((), 1)


def test_the_two_sightings_must_follow_each_other() -> None:
    _, tracked = follow([detection(0, [roi(100, 50)]), detection(1), detection(2, [roi(100, 50)])])
    assert numbers(tracked) == [[None], [], [None]]


@pytest.mark.parametrize(("score", "number"), [(0.79, None), (0.8, 1), (0.95, 1)])
def test_a_clear_region_is_confirmed_at_once(score: float, number: int | None) -> None:
    _, tracked = follow([detection(0, [roi(100, 50, score=score)])], TrackingConfig(confirm_score=0.8))
    assert numbers(tracked) == [[number]]


@pytest.mark.parametrize(("score", "number"), [(0.24, None), (0.25, 1), (0.4, 1)])
def test_a_confirmed_track_survives_a_lower_score(score: float, number: int | None) -> None:
    strong = [detection(k, [roi(100, 50)]) for k in range(2)]
    _, tracked = follow([*strong, detection(2, [roi(100, 50, score=score, label="model_error")])])
    assert numbers(tracked)[-1] == [number]


def test_what_is_not_labelled_motion_neither_opens_nor_confirms_a_track() -> None:
    weak = [roi(100, 50, score=0.45, label="model_error")]
    assert numbers(follow(detection(k, weak) for k in range(4))[1]) == [[None]] * 4
    assert numbers(follow([detection(0, [roi(100, 50)]), detection(1, weak)])[1]) == [[None], [None]]


def test_required_persistence_takes_back_what_no_confirmed_track_supports() -> None:
    config = TrackingConfig(confirm_score=1.0, require_persistence=True)
    _, tracked = follow([detection(k, [roi(100, 50), roi(300 + 90 * k, 300)]) for k in range(3)], config)
    labels = [[(one.bbox.x, one.label, one.track_id) for one in det.rois] for det in tracked]
    assert labels[2] == [(100, "independent_motion", 1), (480, "model_error", None)]
    assert [label for _, label, _ in labels[0]] == ["model_error", "model_error"]


# --- time


@pytest.mark.parametrize("step", [0.5, 1.0, 4.0])
def test_any_frame_rate(step: float) -> None:
    """10 px for each 0.05 s, seen at 40 Hz to 5 Hz."""
    frames = [detection(k * step, [roi(50 + 10 * k * step, 50)]) for k in range(12)]
    assert numbers(follow(frames)[1]) == [[None]] + [[1]] * 11


def test_no_track_is_carried_over_a_gap() -> None:
    frames = [detection(k, [roi(100, 50)]) for k in (0, 1, 2, 14, 15)]  # 0.6 s are allowed
    assert numbers(follow(frames)[1]) == [[None], [1], [1], [1], [1]]
    frames = [detection(k, [roi(100, 50)]) for k in (0, 1, 2, 15, 16)]
    assert numbers(follow(frames)[1]) == [[None], [1], [1], [None], [2]]


def test_abstained_pairs_do_not_count_as_missed_until_the_gap_is_too_long() -> None:
    def around(dark: int) -> list[list[int | None]]:
        seen = [detection(k, [roi(100, 50)]) for k in range(3)]
        unseen = [detection(3 + k, abstained=True) for k in range(dark)]
        return numbers(follow([*seen, *unseen, detection(3 + dark, [roi(100, 50)])])[1])

    assert around(9)[-1] == [1]  # max_missed_s is 0.3 s, that is 6 frames; max_gap_s 0.6 s
    assert around(12)[-1] == [None]


def test_overlapping_pairs_go_on_by_the_part_of_the_flow_to_the_next_source() -> None:
    # Pairs (k, k + 3): the flow of three frames is told, the source frames are one apart.
    frames = [detection(k, [roi(500 - 20 * k, 100, 12, 12, static=(-60.0, 0.0))], ahead=3) for k in range(10)]
    state, tracked = follow(frames)
    assert numbers(tracked) == [[None]] + [[1]] * 9
    assert state.tracks[0].box.own_velocity_px_s == pytest.approx((0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("frame", [2, 1.5, 0])
def test_pairs_out_of_order_or_twice_are_refused(frame: float) -> None:
    state, _ = follow([detection(k, [roi(100, 50)]) for k in range(3)])
    with pytest.raises(InvalidInputError, match="expected later than the pair before") as caught:
        Tracker(TWO_SIGHTINGS).update(state, detection(frame))
    assert (caught.value.code, caught.value.field) == ("pair_out_of_order", "source_timestamp_ns")


def test_another_image_size_begins_anew_and_numbers_go_on() -> None:
    frames = [detection(k, [roi(100, 50)]) for k in range(2)]
    frames += [detection(k, [roi(100, 50)], image=ImageSize(320, 240)) for k in (2, 3)]
    assert numbers(follow(frames)[1]) == [[None], [1], [None], [2]]


# --- the state


def test_the_number_of_tracks_is_bounded_and_the_clearest_regions_come_first() -> None:
    crowd = [roi(60 * k, 50, score=0.51 + 0.01 * k) for k in range(8)]
    state, tracked = follow([detection(k, crowd) for k in range(3)], replace_config(max_tracks=3))
    assert len(state.tracks) == 3
    assert numbers(tracked)[-1] == [None] * 5 + [3, 2, 1]


def replace_config(**changes: Any) -> TrackingConfig:
    return TWO_SIGHTINGS.model_copy(update=changes)


def test_a_state_is_left_as_it_was_and_can_be_gone_on_from_twice() -> None:
    tracker = Tracker(TWO_SIGHTINGS)
    state, _ = follow([detection(k, [roi(100, 50), roi(300, 50)]) for k in range(3)])
    before = repr(state)
    left = tracker.update(state, detection(3, [roi(103, 50)]))
    assert repr(state) == before
    assert tracker.update(state, detection(3, [roi(103, 50)])) == left
    assert tracker.update(state, detection(3, [roi(400, 50)])) != left
    assert hash(state) == hash(replace(state))
    with pytest.raises(FrozenInstanceError):
        state.next_id = 9  # type: ignore[misc]


def test_tracking_a_tracked_stream_anew_changes_nothing() -> None:
    for persistence in (False, True):
        config = replace_config(require_persistence=persistence)
        state, once = follow([detection(k, [roi(100 + k, 50), roi(300, 50 + 90 * (k % 2))]) for k in range(6)], config)
        assert follow(once, config) == (state, once)


def test_a_region_without_static_flow_is_followed_by_its_own_velocity() -> None:
    frames = [detection(k, [roi(100 + 6 * k, 50, static=None)]) for k in range(10)]
    assert numbers(follow(frames)[1]) == [[None]] + [[1]] * 9


boxes = st.builds(
    roi,
    x=st.integers(0, 590),
    y=st.integers(0, 430),
    width=st.integers(1, 50),
    height=st.integers(1, 50),
    score=st.sampled_from([0.5, 0.6, 0.7, 0.8]),
    static=st.tuples(st.integers(-9, 9), st.integers(-9, 9)),
)
streams = st.lists(st.lists(boxes, max_size=6, unique_by=lambda one: one.bbox), min_size=2, max_size=5)


@given(stream=streams, seed=st.integers(0, 99))
def test_the_order_of_regions_decides_nothing(stream: list[list[Roi]], seed: int) -> None:
    def by_box(tracked: Sequence[Detection]) -> list[dict[Any, int | None]]:
        return [{one.bbox: one.track_id for one in det.rois} for det in tracked]

    frames = [detection(k, rois) for k, rois in enumerate(stream)]
    order = random.Random(seed)  # noqa: S311
    shuffled = [replace(det, rois=tuple(order.sample(det.rois, len(det.rois)))) for det in frames]
    state, tracked = follow(frames)
    other_state, other = follow(shuffled)
    assert by_box(tracked) == by_box(other)
    assert state == other_state


@given(stream=streams)
def test_numbers_are_unique_dense_and_every_region_is_there(stream: list[list[Roi]]) -> None:
    frames = [detection(k, rois) for k, rois in enumerate(stream)]
    state, tracked = follow(frames)
    seen = [[one.track_id for one in det.rois if one.track_id] for det in tracked]
    assert all(len(set(row)) == len(row) for row in seen)
    assert sorted({number for row in seen for number in row}) == list(range(1, state.next_id))
    assert [[one.bbox for one in det.rois] for det in tracked] == [[one.bbox for one in det.rois] for det in frames]


def test_stamps_keep_their_nanoseconds() -> None:
    state, _ = follow([detection(k, [roi(100, 50)]) for k in range(2)])
    assert state.source_ns is not None
    later = replace(detection(2, [roi(100, 50)]), source_timestamp_ns=state.source_ns + 1)
    after, tracked = Tracker(TWO_SIGHTINGS).update(state, later)
    assert (after.source_ns, numbers([tracked])) == (state.source_ns + 1, [[1]])
