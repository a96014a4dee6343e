"""What the OpenAPI document says of stored detections."""

from __future__ import annotations

from typing import Any, Final

from fastapi import FastAPI

from viflow_anomaly_service.examples import EXAMPLE_DETECTION, SOURCE_NS
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
from viflow_anomaly_service.store.query import DEFAULT_LIMIT, DETECTION_ID, LABELS, MAX_CURSOR, MAX_LIMIT, ORDERS
from viflow_anomaly_service.store.query import STREAM_ID as STREAM_ID_PATTERN

NDJSON_MEDIA_TYPE: Final = "application/x-ndjson"
STREAM_ID: Final[JsonObject] = {"type": "string", "pattern": f"^{STREAM_ID_PATTERN.pattern}$"}
DETECTION_ID_SCHEMA: Final[JsonObject] = {"type": "string", "pattern": f"^{DETECTION_ID.pattern}$"}
EXAMPLE_ID: Final = f"{SOURCE_NS:016x}5f0c2a9be4d17388"
EXAMPLE_STORED: Final[JsonObject] = {
    "id": EXAMPLE_ID,
    "stored_at_ns": SOURCE_NS,
    "stream_id": "drone7",
    "session_id": "6b1f0c8ee3a34a0f9d51c1d2f0b7a955",
    "detection": EXAMPLE_DETECTION,
}
EXAMPLE_PAGE: Final[JsonObject] = {"detections": [EXAMPLE_STORED], "next_cursor": None}
STORED_SCHEMA: Final = closed_object(
    {
        "id": DETECTION_ID_SCHEMA,
        "stored_at_ns": {**NANOSECONDS, "description": "Unix time"},
        "stream_id": {"anyOf": [STREAM_ID, OR_NULL], "description": "null for POST /detect"},
        "session_id": {
            "anyOf": [{"type": "string"}, OR_NULL],
            "description": "of the stream; track_ids of one session name the same things",
        },
        "detection": reference("Detection"),
    },
    description="A detection that was stored",
)
PAGE_SCHEMA: Final = closed_object(
    {
        "detections": {"type": "array", "items": reference("StoredDetection"), "maxItems": MAX_LIMIT},
        "next_cursor": {"type": ["string", "null"], "description": "for the next page; null on the last one"},
    },
    description="Some stored detections",
)
STORE_GONE: Final[Fault] = ("store_unavailable", "The store of detections is not usable: it cannot be reached.", None)
_INTERNAL: Final[Fault] = ("internal_error", "The service failed unexpectedly; its log has the request_id.", None)
_NONE: Final[Fault] = ("store_not_configured", "expected a store (VIFLOW_STORE_URL), found none", None)
_WRONG: Final[Fault] = ("parameter_invalid", "limit: expected an integer from 1 to 1000, found '0'", "limit")
_UNKNOWN: Final[Fault] = ("detection_not_found", "expected the id of a stored detection, found '17'", None)

_FILTERS: Final = [
    parameter("stream", STREAM_ID, "detections of this stream"),
    parameter("from_ns", NANOSECONDS, "source frame at this time or later (the camera's clock)"),
    parameter("to_ns", NANOSECONDS, "source frame before this time"),
    parameter("label", {"type": "string", "enum": list(LABELS)}, "with a region of this label"),
    parameter(
        "min_score",
        {"type": "number", "minimum": 0, "maximum": 1},
        "with a region, of the label if one is given, that has at least this score",
    ),
    parameter("order", {"type": "string", "enum": list(ORDERS), "default": "desc"}, "newest or oldest stored first"),
]
_PAGING: Final = [
    parameter(
        "limit",
        {"type": "integer", "minimum": 1, "maximum": MAX_LIMIT, "default": DEFAULT_LIMIT},
        "most detections of a page; large ones make it end earlier",
    ),
    parameter("cursor", {"type": "string", "maxLength": MAX_CURSOR}, "next_cursor of a page with the same filters"),
]
_LIST_FAULTS: Final = {422: _WRONG, 500: _INTERNAL, 501: _NONE, 503: STORE_GONE}
_PAGE_ANSWER: Final = answer("A page", reference("DetectionPage"), EXAMPLE_PAGE)
_EXPORT_ANSWER: Final[JsonObject] = {
    "description": "One StoredDetection a line; an answer that breaks off is incomplete",
    "content": {NDJSON_MEDIA_TYPE: {"schema": {"type": "string"}}},
}
_ONE_ANSWER: Final = answer("The detection", reference("StoredDetection"), EXAMPLE_STORED)

PAGE_OPERATION: Final[dict[str, Any]] = {
    "responses": {200: _PAGE_ANSWER, **problems(_LIST_FAULTS)},
    "openapi_extra": {"parameters": [*_FILTERS, *_PAGING]},
}
EXPORT_OPERATION: Final[dict[str, Any]] = {
    "responses": {200: _EXPORT_ANSWER, **problems(_LIST_FAULTS)},
    "openapi_extra": {"parameters": _FILTERS},
}
GET_OPERATION: Final[dict[str, Any]] = {
    "responses": {200: _ONE_ANSWER, **problems({404: _UNKNOWN, 500: _INTERNAL, 501: _NONE, 503: STORE_GONE})},
}
_NO_THUMBNAIL: Final[Fault] = (
    "thumbnail_not_found",
    "expected the id of a stored detection with a thumbnail, found '17'",
    None,
)
THUMBNAIL_OPERATION: Final[dict[str, Any]] = {
    "responses": {
        200: {
            "description": "JPEG, longest side at most 320 px",
            "content": {"image/jpeg": {"schema": {"type": "string", "contentMediaType": "image/jpeg"}}},
            "headers": {
                name: {"description": text, "schema": {"type": "string"}}
                for name, text in (("ETag", "of this picture"), ("Cache-Control", "it never changes"))
            },
        },
        304: {"description": "The picture that If-None-Match names is still the one"},
        **problems({404: _NO_THUMBNAIL, 500: _INTERNAL, 501: _NONE, 503: STORE_GONE}),
    },
}
DETECTION_ID_HEADER: Final = "X-Detection-ID"


def add_store_openapi(app: FastAPI) -> None:
    """The components, the examples whole, and the header of ``/detect``."""

    def change(document: JsonObject) -> None:
        document["components"]["schemas"] |= {"StoredDetection": STORED_SCHEMA, "DetectionPage": PAGE_SCHEMA}
        paths = document["paths"]
        set_examples(
            paths,
            ("/detections", "get", EXAMPLE_PAGE),
            ("/detections/{detection_id}", "get", EXAMPLE_STORED),
        )
        for path in ("/detections/{detection_id}", "/detections/{detection_id}/thumbnail"):
            (one,) = paths[path]["get"]["parameters"]
            one["schema"] = DETECTION_ID_SCHEMA
        paths["/detect"]["post"]["responses"]["200"]["headers"] = {
            DETECTION_ID_HEADER: {
                "description": "under which the detection is stored; absent without a store",
                "schema": DETECTION_ID_SCHEMA,
            }
        }

    extend_openapi(app, change)
