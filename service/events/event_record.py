"""An event as it is told and stored: one JSON text, the same for everybody, and beside it what can be asked for."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from viflow_anomaly.detection import SCORE_DECIMALS
from viflow_anomaly_service.events.event_rules import MOTION, EndReason, EventKind, TrackEvent


@dataclass(frozen=True)
class EventRecord:
    """A row to be, or a row.

    Attributes:
        event_id: see ``store.record.IdMaker``.
        thing_id: of all events of one track.
        body: the event's JSON.
    """

    event_id: str
    thing_id: str
    kind: EventKind
    stream_id: str
    timestamp_ns: int
    body: str


def record_of(
    told: TrackEvent, *, event_id: str, stream_id: str, session_id: str, detection_id: str | None
) -> EventRecord:
    """The event of a track of a stream's session."""
    event, thing_id = told.event, f"{session_id}-{told.event.track_id}"
    box = event.bbox
    members = {
        "event_id": event_id,
        "kind": told.kind,
        "thing_id": thing_id,
        "stream_id": stream_id,
        "session_id": session_id,
        "track_id": event.track_id,
        "timestamp_ns": told.timestamp_ns,
        "started_at_ns": event.started_at_ns,
        "label": MOTION,
        "score": round(event.score, SCORE_DECIMALS),
        "top_score": round(event.top_score, SCORE_DECIMALS),
        "bbox": {"x": box.x, "y": box.y, "width": box.width, "height": box.height},
        "image": {"width": told.image.width, "height": told.image.height},
        "detection_id": detection_id,
        "reason": told.reason,
    }
    return EventRecord(event_id, thing_id, told.kind, stream_id, told.timestamp_ns, _text(members))


def ended(last_body: str, *, event_id: str, reason: EndReason) -> EventRecord:
    """The end of an event whose last message is all that is known of it."""
    members = json.loads(last_body) | {"event_id": event_id, "kind": "end", "detection_id": None, "reason": reason}
    return EventRecord(
        event_id, members["thing_id"], "end", members["stream_id"], members["timestamp_ns"], _text(members)
    )


def _text(members: dict[str, Any]) -> str:
    return json.dumps(members, separators=(",", ":"))
