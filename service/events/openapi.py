"""What the OpenAPI document says of events."""

from __future__ import annotations

from typing import Any, Final

from fastapi import FastAPI

from viflow_anomaly_service.events.query import DELIVERY_ID, DELIVERY_STATES, KINDS
from viflow_anomaly_service.examples import SOURCE_NS
from viflow_anomaly_service.openapi_parts import (
    NANOSECONDS,
    OR_NULL,
    Fault,
    JsonObject,
    answer,
    closed_object,
    extend_openapi,
    parameter,
    problems,
    reference,
    set_examples,
)
from viflow_anomaly_service.paging_openapi import (
    INTERNAL,
    ITEM_ID_SCHEMA,
    NO_STORE,
    STORE_GONE,
    STREAM_ID_SCHEMA,
    TIME_PARAMETERS,
    lines_answer,
    list_faults,
    order_filter,
    page_parameters,
    page_schema,
    stream_filter,
)
from viflow_anomaly_service.store.openapi import EXAMPLE_ID

_DELIVERY_ID: Final[JsonObject] = {
    "type": "string",
    "pattern": f"^{DELIVERY_ID.pattern}$".replace("?P<event>", "").replace("?P<sink>", ""),
}
_SCORE: Final[JsonObject] = {"type": "number", "minimum": 0, "maximum": 1}
_PIXELS: Final[JsonObject] = {"type": "integer", "minimum": 0}
_SESSION: Final = "6b1f0c8ee3a34a0f9d51c1d2f0b7a955"
_REASONS: Final = ("left", "stream_deleted", "stream_expired", "service_stopped", "service_restarted")
EXAMPLE_EVENT: Final[JsonObject] = {
    "event_id": f"{SOURCE_NS:016x}a27d11c09b3e64f5",
    "kind": "start",
    "thing_id": f"{_SESSION}-3",
    "stream_id": "drone7",
    "session_id": _SESSION,
    "track_id": 3,
    "timestamp_ns": SOURCE_NS,
    "started_at_ns": SOURCE_NS - 100_000_000,
    "label": "independent_motion",
    "score": 0.91,
    "top_score": 0.93,
    "bbox": {"x": 311, "y": 120, "width": 24, "height": 41},
    "image": {"width": 752, "height": 480},
    "detection_id": EXAMPLE_ID,
    "reason": None,
}
EXAMPLE_EVENT_PAGE: Final[JsonObject] = {"events": [EXAMPLE_EVENT], "next_cursor": None}
EVENT_SCHEMA: Final = closed_object(
    {
        "event_id": {**ITEM_ID_SCHEMA, "description": "of this message; later ones are greater"},
        "kind": {"type": "string", "enum": list(KINDS)},
        "thing_id": {"type": "string", "description": "the same for all events of one track"},
        "stream_id": STREAM_ID_SCHEMA,
        "session_id": {"type": "string"},
        "track_id": {"type": "integer"},
        "timestamp_ns": {**NANOSECONDS, "description": "source frame of the pair that said so (the camera's clock)"},
        "started_at_ns": {**NANOSECONDS, "description": "source frame of the first pair with the score"},
        "label": {"type": "string", "const": "independent_motion"},
        "score": {**_SCORE, "description": "in this pair; at an end, when it was last seen"},
        "top_score": {**_SCORE, "description": "since the start"},
        "bbox": closed_object({"x": _PIXELS, "y": _PIXELS, "width": _PIXELS, "height": _PIXELS}),
        "image": closed_object({"width": _PIXELS, "height": _PIXELS}),
        "detection_id": {
            "anyOf": [ITEM_ID_SCHEMA, OR_NULL],
            "description": "the stored detection that said so; null without a store, and when a stream ends",
        },
        "reason": {"enum": [*_REASONS, None], "description": "of an end; else null"},
    },
    description="Something began to move by itself, goes on, or has ended",
)
EVENT_PAGE_SCHEMA: Final = page_schema("events", "Event", "Some events")
EXAMPLE_DELIVERY: Final[JsonObject] = {
    "id": f"{EXAMPLE_EVENT['event_id']}.webhook-1f6c0d2b9e57",
    "sink": "webhook-1f6c0d2b9e57",
    "state": "dead",
    "attempts": 15,
    "next_attempt_ns": None,
    "last_error": "answered 500",
    "queued_at_ns": SOURCE_NS,
    "event": EXAMPLE_EVENT,
}
EXAMPLE_DELIVERIES: Final[JsonObject] = {"deliveries": [EXAMPLE_DELIVERY], "next_cursor": None}
EXAMPLE_RETRY: Final[JsonObject] = EXAMPLE_DELIVERY | {
    "state": "pending",
    "attempts": 0,
    "next_attempt_ns": SOURCE_NS,
}
DELIVERY_SCHEMA: Final = closed_object(
    {
        "id": _DELIVERY_ID,
        "sink": {"type": "string", "description": "mqtt, or webhook- and the beginning of the URL's SHA-256"},
        "state": {"type": "string", "enum": list(DELIVERY_STATES)},
        "attempts": {"type": "integer", "minimum": 0},
        "next_attempt_ns": {"anyOf": [NANOSECONDS, OR_NULL], "description": "Unix time; of what is pending"},
        "last_error": {"type": ["string", "null"]},
        "queued_at_ns": {**NANOSECONDS, "description": "Unix time"},
        "event": reference("Event"),
    },
    description="An event on its way to a webhook or to MQTT",
)
DELIVERIES_SCHEMA: Final = page_schema("deliveries", "Delivery", "Some deliveries", limited=False)
_ONE_PROCESS: Final[Fault] = (
    "streams_need_one_process",
    "expected a store or one process (VIFLOW_WORKERS=1), found 4",
    None,
)
_WRONG: Final[Fault] = ("parameter_invalid", "kind: expected start or update or end, found 'stop'", "kind")
_FULL: Final[Fault] = ("event_readers_full", "expected at most 64 readers of events at once, found one more", None)
_UNKNOWN: Final[Fault] = ("delivery_not_found", "expected the id of a delivery, found '17'", None)
_NOT_DEAD: Final[Fault] = ("delivery_not_dead", "expected a delivery that is dead, found one that is pending", None)
_STREAM: Final = stream_filter("events of this stream")
_FILTERS: Final = [
    _STREAM,
    parameter("kind", {"type": "string", "enum": list(KINDS)}, "of this kind"),
    *TIME_PARAMETERS,
    order_filter("newest or oldest first"),
]
_LIST_FAULTS: Final = list_faults(_WRONG)
_LIVE_ANSWER: Final[JsonObject] = {
    "description": "`id:` is the event_id, `event:` the kind (or `gap`: some are missing), `data:` an Event",
    "content": {"text/event-stream": {"schema": {"type": "string"}}},
}
EVENT_PAGE_OPERATION: Final[dict[str, Any]] = {
    "responses": {200: answer("A page", reference("EventPage"), EXAMPLE_EVENT_PAGE), **problems(_LIST_FAULTS)},
    "openapi_extra": {"parameters": [*_FILTERS, *page_parameters("at most so many on a page")]},
}
EVENT_EXPORT_OPERATION: Final[dict[str, Any]] = {
    "responses": {200: lines_answer("Event"), **problems(_LIST_FAULTS)},
    "openapi_extra": {"parameters": _FILTERS},
}
LIVE_OPERATION: Final[dict[str, Any]] = {
    "responses": {200: _LIVE_ANSWER, **problems({422: _WRONG, 500: INTERNAL, 501: _ONE_PROCESS, 503: _FULL})},
    "openapi_extra": {
        "parameters": [_STREAM, parameter("Last-Event-ID", ITEM_ID_SCHEMA, "go on behind this event", place="header")]
    },
}
_STATE: Final = parameter("state", {"type": "string", "enum": list(DELIVERY_STATES)}, "in this state")
DELIVERIES_OPERATION: Final[dict[str, Any]] = {
    "responses": {200: answer("A page", reference("DeliveryPage"), EXAMPLE_DELIVERIES), **problems(_LIST_FAULTS)},
    "openapi_extra": {"parameters": [_STATE, *page_parameters("deliveries of at most so many events")]},
}
RETRY_OPERATION: Final[dict[str, Any]] = {
    "responses": {
        200: answer("It will be tried at once", reference("Delivery"), EXAMPLE_RETRY),
        **problems({404: _UNKNOWN, 409: _NOT_DEAD, 500: INTERNAL, 501: NO_STORE, 503: STORE_GONE}),
    }
}


def add_events_openapi(app: FastAPI) -> None:
    """The components, the examples whole, and the pattern of an id."""

    def change(document: JsonObject) -> None:
        document["components"]["schemas"] |= {
            "Event": EVENT_SCHEMA,
            "EventPage": EVENT_PAGE_SCHEMA,
            "Delivery": DELIVERY_SCHEMA,
            "DeliveryPage": DELIVERIES_SCHEMA,
        }
        paths = document["paths"]
        set_examples(
            paths,
            ("/events", "get", EXAMPLE_EVENT_PAGE),
            ("/events/deliveries", "get", EXAMPLE_DELIVERIES),
            ("/events/deliveries/{delivery_id}/retry", "post", EXAMPLE_RETRY),
        )
        (one,) = paths["/events/deliveries/{delivery_id}/retry"]["post"]["parameters"]
        one["schema"] = _DELIVERY_ID

    extend_openapi(app, change)
