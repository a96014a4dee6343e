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
from viflow_anomaly_service.store.query import LABELS

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
        "id": ITEM_ID_SCHEMA,
        "stored_at_ns": {**NANOSECONDS, "description": "Unix time"},
        "stream_id": {"anyOf": [STREAM_ID_SCHEMA, OR_NULL], "description": "null for POST /detect"},
        "session_id": {
            "anyOf": [{"type": "string"}, OR_NULL],
            "description": "of the stream; track_ids of one session name the same things",
        },
        "detection": reference("Detection"),
    },
    description="A detection that was stored",
)
PAGE_SCHEMA: Final = page_schema("detections", "StoredDetection", "Some stored detections")
_WRONG: Final[Fault] = ("parameter_invalid", "limit: expected an integer from 1 to 1000, found '0'", "limit")
_UNKNOWN: Final[Fault] = ("detection_not_found", "expected the id of a stored detection, found '17'", None)

_FILTERS: Final = [
    stream_filter("detections of this stream"),
    *TIME_PARAMETERS,
    parameter("label", {"type": "string", "enum": list(LABELS)}, "with a region of this label"),
    parameter(
        "min_score",
        {"type": "number", "minimum": 0, "maximum": 1},
        "with a region, of the label if one is given, that has at least this score",
    ),
    order_filter("newest or oldest stored first"),
]
_LIST_FAULTS: Final = list_faults(_WRONG)
_PAGE_ANSWER: Final = answer("A page", reference("DetectionPage"), EXAMPLE_PAGE)
_ONE_ANSWER: Final = answer("The detection", reference("StoredDetection"), EXAMPLE_STORED)

PAGE_OPERATION: Final[dict[str, Any]] = {
    "responses": {200: _PAGE_ANSWER, **problems(_LIST_FAULTS)},
    "openapi_extra": {
        "parameters": [*_FILTERS, *page_parameters("most detections of a page; large ones make it end earlier")]
    },
}
EXPORT_OPERATION: Final[dict[str, Any]] = {
    "responses": {200: lines_answer("StoredDetection"), **problems(_LIST_FAULTS)},
    "openapi_extra": {"parameters": _FILTERS},
}
GET_OPERATION: Final[dict[str, Any]] = {
    "responses": {200: _ONE_ANSWER, **problems({404: _UNKNOWN, 500: INTERNAL, 501: NO_STORE, 503: STORE_GONE})},
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
        **problems({404: _NO_THUMBNAIL, 500: INTERNAL, 501: NO_STORE, 503: STORE_GONE}),
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
            one["schema"] = ITEM_ID_SCHEMA
        paths["/detect"]["post"]["responses"]["200"]["headers"] = {
            DETECTION_ID_HEADER: {
                "description": "under which the detection is stored; absent without a store",
                "schema": ITEM_ID_SCHEMA,
            }
        }

    extend_openapi(app, change)
