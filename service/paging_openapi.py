"""What the OpenAPI document says of lists of stored things: their filters, pages and faults."""

from __future__ import annotations

from typing import Final

from viflow_anomaly_service.examples import EXAMPLE_FAULTS
from viflow_anomaly_service.openapi_parts import NANOSECONDS, Fault, JsonObject, closed_object, parameter, reference
from viflow_anomaly_service.paging import DEFAULT_LIMIT, ITEM_ID, MAX_CURSOR, MAX_LIMIT
from viflow_anomaly_service.parameters import ORDERS, STREAM_ID

NDJSON_MEDIA_TYPE: Final = "application/x-ndjson"
STREAM_ID_SCHEMA: Final[JsonObject] = {"type": "string", "pattern": f"^{STREAM_ID.pattern}$"}
ITEM_ID_SCHEMA: Final[JsonObject] = {"type": "string", "pattern": f"^{ITEM_ID.pattern}$"}
TIME_PARAMETERS: Final = [
    parameter("from_ns", NANOSECONDS, "source frame at this time or later (the camera's clock)"),
    parameter("to_ns", NANOSECONDS, "source frame before this time"),
]
INTERNAL: Final = EXAMPLE_FAULTS[500]
STORE_GONE: Final[Fault] = ("store_unavailable", "The store of detections is not usable: it cannot be reached.", None)
NO_STORE: Final[Fault] = ("store_not_configured", "expected a store (VIFLOW_STORE_URL), found none", None)


def stream_filter(description: str) -> JsonObject:
    return parameter("stream", STREAM_ID_SCHEMA, description)


def order_filter(description: str) -> JsonObject:
    return parameter("order", {"type": "string", "enum": list(ORDERS), "default": "desc"}, description)


def page_parameters(limit: str) -> list[JsonObject]:
    """``limit``, with this description, and ``cursor``."""
    limits = {"type": "integer", "minimum": 1, "maximum": MAX_LIMIT, "default": DEFAULT_LIMIT}
    cursor = {"type": "string", "maxLength": MAX_CURSOR}
    return [
        parameter("limit", limits, limit),
        parameter("cursor", cursor, "next_cursor of a page with the same filters"),
    ]


def page_schema(name: str, item: str, description: str, *, limited: bool = True) -> JsonObject:
    """A page of components ``item``, in its member ``name``; ``limited`` says that there are no more than asked for."""
    items: JsonObject = {"type": "array", "items": reference(item)}
    cursor = {"type": ["string", "null"], "description": "for the next page; null on the last one"}
    return closed_object(
        {name: items | {"maxItems": MAX_LIMIT} if limited else items, "next_cursor": cursor}, description=description
    )


def list_faults(wrong: Fault) -> dict[int, Fault]:
    """Of a list, by status; ``wrong`` is an example of a wrong parameter."""
    return {422: wrong, 500: INTERNAL, 501: NO_STORE, 503: STORE_GONE}


def lines_answer(item: str) -> JsonObject:
    """An export: a line for each."""
    return {
        "description": f"One {item} a line; an answer that breaks off is incomplete",
        "content": {NDJSON_MEDIA_TYPE: {"schema": {"type": "string"}}},
    }
