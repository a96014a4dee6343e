"""When events begin, go on and end: what holds for every sequence of detections, and the rules one by one."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from viflow_anomaly.detection import AnalyzedRegion, Detection, ImageSize, ModelInfo, ResidualSummary, Roi
from viflow_anomaly.regions import BoundingBox
from viflow_anomaly_service.events.event_rules import EventRules, EventState, TrackEvent, end_all, step

SECOND_NS = 1_000_000_000
RULES = EventRules(start_score=0.5, start_pairs=2, end_score=0.3, end_s=1.0, update_s=1.0, cooldown_s=0.0)
Seen = dict[int, float]
"""Track -> score."""


def roi(track_id: int | None, score: float, label: Any = "independent_motion") -> Roi:
    return Roi(1, label, score, BoundingBox(1, 2, 3, 4), 3, 4, 12, 3, 9.0, 9.0, track_id=track_id)


def detection(time_s: float, seen: Seen | list[Roi], *, judged: bool = True) -> Detection:
    rois = seen if isinstance(seen, list) else [roi(track_id, score) for track_id, score in seen.items()]
    now_ns = round(time_s * 1e9)
    return Detection(
        source_timestamp_ns=now_ns,
        target_timestamp_ns=now_ns + 1,
        image=ImageSize(96, 64),
        status="ok" if judged else "abstained",
        reasons=(),
        model=ModelInfo("m", "1", "ab" * 32),
        rois=tuple(rois) if judged else (),
        region_analyzed=AnalyzedRegion(0, 0, 96, 64),
        residual=ResidualSummary(1.0, 1.0, 2.0),
        timings_ms={},
    )


def told(rules: EventRules, *detections: Detection) -> tuple[list[tuple[float, str, int]], EventState, int]:
    """(second, kind, track) of every event, the state behind them, and how many the cool-down held back."""
    state, found, held_back = EventState(), [], 0
    for one in detections:
        state, events, held = step(rules, state, one)
        held_back += held
        found += [(event.timestamp_ns / 1e9, event.kind, event.event.track_id) for event in events]
    return found, state, held_back


def every(step_s: float, *seen: Seen) -> list[Detection]:
    return [detection(number * step_s, one) for number, one in enumerate(seen)]


def test_an_event_begins_after_pairs_in_a_row() -> None:
    found, _, _ = told(RULES, *every(0.1, {1: 0.6}, {1: 0.4}, {1: 0.6}, {}, {1: 0.6}, {1: 0.5}))
    assert found == [(0.5, "start", 1)]


def test_it_says_since_when() -> None:
    state = EventState()
    for one in every(0.1, {1: 0.6}, {1: 0.9}):
        state, events, _ = step(RULES, state, one)
    assert (events[0].event.started_at_ns, events[0].timestamp_ns) == (0, SECOND_NS // 10)
    assert (events[0].event.score, events[0].event.top_score) == (0.9, 0.9)


def test_other_labels_and_regions_without_track_begin_nothing() -> None:
    rois = [roi(1, 0.9, "model_error"), roi(None, 0.9)]
    assert told(RULES, *(detection(k / 10, rois) for k in range(9)))[0] == []


def test_a_score_between_the_thresholds_keeps_it_open_and_begins_none() -> None:
    found, _, _ = told(RULES, *every(0.4, {1: 0.6}, {1: 0.6}, *[{1: 0.35}] * 6))
    assert [kind for _, kind, _ in found] == ["start", "update", "update"]
    assert told(RULES, *every(0.4, *[{1: 0.45}] * 9))[0] == []


def test_it_ends_after_a_while_below_the_score_or_unseen() -> None:
    for last in ({1: 0.29}, {}):
        found, _, _ = told(RULES, *every(0.5, {1: 0.6}, {1: 0.6}, last, last, last))
        assert found == [(0.5, "start", 1), (1.5, "end", 1)]


def test_a_short_gap_ends_nothing() -> None:
    found, _, _ = told(RULES, *every(0.4, {1: 0.6}, {1: 0.6}, {}, {}, {1: 0.6}, {}))
    assert found == [(0.4, "start", 1), (1.6, "update", 1)]


def test_pairs_that_could_not_be_judged_end_nothing() -> None:
    begun = every(0.1, {1: 0.6}, {1: 0.6})
    blurred = [detection(k / 10, {}, judged=False) for k in range(2, 50)]
    found, _, _ = told(RULES, *begun, *blurred, detection(5.0, {1: 0.6}))
    assert found == [(0.1, "start", 1), (5.0, "update", 1)]
    unseen = [detection(5.0 + k / 10, {}) for k in range(12)]
    found, _, _ = told(RULES, *begun, *blurred, *unseen)
    assert found == [(0.1, "start", 1), (5.9, "end", 1)]  # a second without it, of pairs that were judged


def test_a_track_that_is_there_again_after_a_pause_of_the_camera_goes_on() -> None:
    found, _, _ = told(RULES, detection(0, {1: 0.6}), detection(0.1, {1: 0.6}), detection(60, {1: 0.6}))
    assert found == [(0.1, "start", 1), (60.0, "update", 1)]


def test_updates_come_at_most_so_often() -> None:
    found, _, _ = told(RULES, *every(0.3, *[{1: 0.6}] * 12))
    assert [second for second, kind, _ in found if kind == "update"] == [1.5, 2.7]


def test_a_pair_that_was_not_judged_breaks_no_row() -> None:
    pairs = (detection(0, {1: 0.6}), detection(0.1, {}, judged=False), detection(0.2, {1: 0.6}))
    assert told(RULES, *pairs)[0] == [(0.2, "start", 1)]


def test_the_cool_down_holds_back_what_still_moves_then_and_counts_it_once() -> None:
    rules = EventRules(start_score=0.5, start_pairs=1, end_score=0.3, end_s=0.0, update_s=9.0, cooldown_s=1.0)
    seen = [{1: 0.9}, {}, {2: 0.9}, {2: 0.9}, {2: 0.9, 3: 0.9}]
    found, _, held_back = told(rules, *every(0.4, *seen))
    assert found == [(0.0, "start", 1), (0.4, "end", 1), (1.6, "start", 2), (1.6, "start", 3)]
    assert held_back == 1


def test_what_vanishes_within_the_cool_down_is_counted() -> None:
    rules = EventRules(start_score=0.5, start_pairs=1, end_score=0.3, end_s=0.0, update_s=9.0, cooldown_s=1.0)
    found, _, held_back = told(rules, *every(0.1, {1: 0.9}, {}, {2: 0.9}, {}, {3: 0.9}, {}))
    assert ([kind for _, kind, _ in found], held_back) == (["start", "end"], 2)


def test_the_end_of_the_stream_ends_everything() -> None:
    _, state, _ = told(RULES, *every(0.1, {1: 0.6, 2: 0.6}, {1: 0.6, 2: 0.6}))
    ends = end_all(state, "stream_expired")
    assert [(one.kind, one.event.track_id, one.timestamp_ns, one.reason) for one in ends] == [
        ("end", 1, SECOND_NS // 10, "stream_expired"),
        ("end", 2, SECOND_NS // 10, "stream_expired"),
    ]
    assert end_all(EventState(), "stream_deleted") == ()


SCORES = st.sampled_from([0.0, 0.1, 0.29, 0.3, 0.31, 0.49, 0.5, 0.51, 0.99])
PAIRS = st.tuples(
    st.sampled_from([0.05, 0.1, 0.5, 1.0, 3.0]),
    st.one_of(st.none(), st.dictionaries(st.integers(1, 4), SCORES, max_size=4)),
)
ALL_RULES = st.builds(
    EventRules,
    start_score=st.just(0.5),
    start_pairs=st.integers(1, 3),
    end_score=st.sampled_from([0.0, 0.3, 0.5]),
    end_s=st.sampled_from([0.0, 0.1, 1.0]),
    update_s=st.sampled_from([0.0, 0.1, 1.0]),
    cooldown_s=st.sampled_from([0.0, 0.1, 1.0]),
)


@given(rules=ALL_RULES, pairs=st.lists(PAIRS, max_size=40))
def test_what_holds_for_all_events(rules: EventRules, pairs: list[tuple[float, Seen | None]]) -> None:
    state, now_s = EventState(), 0.0
    found: list[TrackEvent] = []
    held_back = 0
    for wait_s, seen in pairs:
        now_s += wait_s
        state, events, held = step(rules, state, detection(now_s, seen or {}, judged=seen is not None))
        found += events
        held_back += held
    found += end_all(state, "stream_deleted")
    assert [one.timestamp_ns for one in found] == sorted(one.timestamp_ns for one in found)
    opened: dict[int, TrackEvent] = {}
    last_end_ns = None
    for one in found:
        track, before = one.event.track_id, opened.get(one.event.track_id)
        assert (one.reason is not None) == (one.kind == "end")
        assert one.event.score <= one.event.top_score
        if one.kind == "start":
            assert before is None
            assert one.event.score >= rules.start_score
            assert last_end_ns is None or one.timestamp_ns - last_end_ns >= round(rules.cooldown_s * 1e9)
            opened[track] = one
            continue
        assert before is not None
        assert one.event.started_at_ns == before.event.started_at_ns
        assert one.event.top_score >= before.event.top_score
        if one.kind == "update":
            assert one.timestamp_ns - before.timestamp_ns >= round(rules.update_s * 1e9)
            opened[track] = one
        else:
            del opened[track]
            last_end_ns = one.timestamp_ns
    assert opened == {}
    assert held_back == 0 or rules.cooldown_s > 0
    keys = [(one.kind, one.event.track_id, one.timestamp_ns) for one in found]
    assert len(set(keys)) == len(keys)
