"""From a stream's detections to events: when a track's motion begins, goes on and ends. Pure: a state in, a state out.

Begin and end have thresholds and durations of their own (hysteresis), so that a score that flickers around one of them
makes one event and not many.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final, Literal, NamedTuple

from viflow_anomaly.detection import Detection, ImageSize, Roi
from viflow_anomaly.regions import BoundingBox

EventKind = Literal["start", "update", "end"]
EndReason = Literal["left", "stream_deleted", "stream_expired", "service_stopped", "service_restarted"]
MOTION: Final = "independent_motion"


@dataclass(frozen=True)
class EventRules:
    """When an event begins and ends; times are the camera's, from frame to frame.

    Attributes:
        start_score, start_pairs: a track begins one with at least this score in so many judged pairs in a row.
        end_score, end_s: it ends when the track had less, or was not seen, for so long.
        update_s: time at least between two messages of one event.
        cooldown_s: after an end, none begins in this stream; what still moves then begins late.
    """

    start_score: float
    start_pairs: int
    end_score: float
    end_s: float
    update_s: float
    cooldown_s: float


@dataclass(frozen=True)
class Candidate:
    """A track on its way to an event.

    Attributes:
        pairs: in a row with the score.
        since_ns: source frame of the first of them.
        held_back: the cool-down keeps it from beginning, which was counted.
    """

    pairs: int
    since_ns: int
    held_back: bool = False


@dataclass(frozen=True)
class OpenEvent:
    """A track whose event has begun and not ended.

    Attributes:
        told_ns: source frame of its last message.
        seen_ns: source frame in which it last had the score that keeps it open; later by the time of pairs since then
            that could not be judged.
    """

    track_id: int
    started_at_ns: int
    told_ns: int
    seen_ns: int
    score: float
    top_score: float
    bbox: BoundingBox


@dataclass(frozen=True)
class TrackEvent:
    """What there is to tell.

    Attributes:
        timestamp_ns: source frame of the pair that said so; at the end of a stream, of its last pair.
        reason: of an end.
    """

    kind: EventKind
    event: OpenEvent
    timestamp_ns: int
    image: ImageSize
    reason: EndReason | None = None


@dataclass(frozen=True)
class EventState:
    """Of one stream; ``EventState()`` begins it."""

    candidates: Mapping[int, Candidate] = field(default_factory=dict)
    open: Mapping[int, OpenEvent] = field(default_factory=dict)
    quiet_until_ns: int | None = None
    newest: tuple[int, ImageSize] | None = None


class EventStep(NamedTuple):
    """What a detection came to.

    Attributes:
        held_back: tracks that would have begun now, but for the cool-down.
    """

    state: EventState
    events: tuple[TrackEvent, ...]
    held_back: int


def step(rules: EventRules, state: EventState, detection: Detection) -> EventStep:
    """One detection, later than those before."""
    now_ns = detection.source_timestamp_ns
    if detection.status == "abstained":
        return EventStep(_unjudged(state, now_ns, detection.image), (), 0)
    moving = {roi.track_id: roi for roi in reversed(detection.rois) if roi.label == MOTION and roi.track_id is not None}
    open_events, told = _gone_on(rules, state, moving, now_ns)
    events = [TrackEvent(kind, event, now_ns, detection.image, _left(kind)) for kind, event in told]
    quiet_until_ns = state.quiet_until_ns
    if any(one.kind == "end" for one in events):
        quiet_until_ns = now_ns + _ns(rules.cooldown_s)
    new = {key: roi for key, roi in moving.items() if key not in open_events}
    candidates: Mapping[int, Candidate] = _counted(rules, state.candidates, new, now_ns)
    ready = {key for key, one in candidates.items() if one.pairs >= rules.start_pairs and key in new}
    held_back = 0
    if quiet_until_ns is not None and now_ns < quiet_until_ns:
        held_back = sum(not candidates[key].held_back for key in ready)
        candidates = {key: replace(one, held_back=one.held_back or key in ready) for key, one in candidates.items()}
    else:
        for track_id in sorted(ready):
            score = float(new[track_id].score)
            since_ns = candidates[track_id].since_ns
            begun = OpenEvent(track_id, since_ns, now_ns, now_ns, score, score, new[track_id].bbox)
            events.append(TrackEvent("start", begun, now_ns, detection.image))
            open_events[track_id] = begun
        candidates = {key: one for key, one in candidates.items() if key not in ready}
    after = EventState(candidates, open_events, quiet_until_ns, (now_ns, detection.image))
    return EventStep(after, tuple(events), held_back)


def end_all(state: EventState, reason: EndReason) -> tuple[TrackEvent, ...]:
    """The ends of what is open when the stream itself ends."""
    if state.newest is None:
        return ()
    now_ns, image = state.newest
    return tuple(TrackEvent("end", event, now_ns, image, reason) for event in state.open.values())


def _unjudged(state: EventState, now_ns: int, image: ImageSize) -> EventState:
    """After a pair that speaks neither for nor against a track: its time is not one in which nothing was seen."""
    passed_ns = 0 if state.newest is None else now_ns - state.newest[0]
    still = {key: replace(event, seen_ns=event.seen_ns + passed_ns) for key, event in state.open.items()}
    return replace(state, open=still, newest=(now_ns, image))


def _gone_on(
    rules: EventRules, state: EventState, moving: Mapping[int, Roi], now_ns: int
) -> tuple[dict[int, OpenEvent], list[tuple[EventKind, OpenEvent]]]:
    """What stays open, and what there is to tell of what was open."""
    still: dict[int, OpenEvent] = {}
    told: list[tuple[EventKind, OpenEvent]] = []
    for track_id, before in state.open.items():
        roi, event = moving.get(track_id), before
        if roi is not None:
            score = float(roi.score)
            event = replace(event, score=score, top_score=max(event.top_score, score), bbox=roi.bbox)
        if event.score >= rules.end_score and roi is not None:
            event = replace(event, seen_ns=now_ns)
            if now_ns - event.told_ns >= _ns(rules.update_s):
                event = replace(event, told_ns=now_ns)
                told.append(("update", event))
        elif now_ns - event.seen_ns >= _ns(rules.end_s):
            told.append(("end", event))
            continue
        still[track_id] = event
    return still, told


def _counted(
    rules: EventRules, candidates: Mapping[int, Candidate], moving: Mapping[int, Roi], now_ns: int
) -> dict[int, Candidate]:
    """The candidates after one more judged pair; whoever is not seen with the score is none any more."""
    counted = {}
    for track_id, roi in sorted(moving.items()):
        if roi.score >= rules.start_score:
            known = candidates.get(track_id, Candidate(0, now_ns))
            counted[track_id] = replace(known, pairs=min(known.pairs + 1, rules.start_pairs))
    return counted


def _left(kind: EventKind) -> EndReason | None:
    return "left" if kind == "end" else None


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
