"""What the OpenAPI document says beyond what FastAPI derives: both request bodies, the problems, the schemas."""

from __future__ import annotations

from collections.abc import Iterable
from http import HTTPStatus
from typing import Any, Final

from fastapi import FastAPI
from pydantic.json_schema import models_json_schema

from viflow_anomaly.detection import load_detection_schema
from viflow_anomaly_service.access_openapi import REFUSALS, describe_access
from viflow_anomaly_service.examples import (
    EXAMPLE_DETECTION,
    EXAMPLE_FAULTS,
    example_form_request,
    example_json_request,
)
from viflow_anomaly_service.problems import PROBLEM_MEDIA_TYPE, Problem
from viflow_anomaly_service.schemas import DetectRequest, RequestRest, StampedImuPart

JsonObject = dict[str, Any]
Responses = dict[int | str, JsonObject]

_COMPONENTS: Final = "#/components/schemas/"
_FAULT_PROPERTIES: Final[JsonObject] = {
    "code": {"type": "string", "description": "stable name of the fault"},
    "detail": {"type": "string", "description": "what was expected, what was found"},
    "field": {"type": ["string", "null"], "description": "the input at fault, in dotted form"},
}
PROBLEM_SCHEMA: Final[JsonObject] = {
    "title": "Problem",
    "description": "RFC 9457 problem details",
    "type": "object",
    "properties": {
        "type": {"type": "string", "format": "uri-reference"},
        "title": {"type": "string"},
        "status": {"type": "integer"},
        **_FAULT_PROPERTIES,
        "request_id": {"type": "string", "description": "as in the X-Request-ID header and in the log"},
        "errors": {
            "type": "array",
            "description": "further faults of the same request",
            "items": {
                "type": "object",
                "properties": _FAULT_PROPERTIES,
                "required": ["code", "detail", "field"],
                "additionalProperties": False,
            },
        },
    },
    "required": ["type", "title", "status", "code", "detail", "request_id"],
    "additionalProperties": False,
}


def _reference(name: str) -> JsonObject:
    return {"$ref": _COMPONENTS + name}


def _answer(description: str, schema: JsonObject, example: Any, media_type: str = "application/json") -> JsonObject:
    return {"description": description, "content": {media_type: {"schema": schema, "example": example}}}


def _problems(statuses: Iterable[int]) -> Responses:
    responses: Responses = {}
    for status in statuses:
        code, detail, field = EXAMPLE_FAULTS[status]
        retry_after_s = 1 if status in (HTTPStatus.SERVICE_UNAVAILABLE, HTTPStatus.TOO_MANY_REQUESTS) else None
        example = Problem(status, code=code, detail=detail, field=field).body(request_id="drone7-000042")
        responses[status] = _answer(HTTPStatus(status).phrase, _reference("Problem"), example, PROBLEM_MEDIA_TYPE)
        if retry_after_s:
            responses[status]["headers"] = {
                "Retry-After": {"description": "seconds", "schema": {"type": "integer", "minimum": 1}}
            }
    return responses


def _status_answer(description: str, word: str) -> JsonObject:
    schema = {"type": "object", "properties": {"status": {"const": word}}, "required": ["status"]}
    return _answer(description, schema, {"status": word})


_FORM_SCHEMA: Final[JsonObject] = {
    "type": "object",
    "properties": {
        "source": {"type": "string", "format": "binary", "description": "PNG or JPEG, the earlier frame"},
        "target": {"type": "string", "format": "binary", "description": "PNG or JPEG, the later frame"},
        "imu": _reference("StampedImuPart"),
        "request": _reference("RequestRest"),
    },
    "required": ["source", "target", "imu"],
    "additionalProperties": False,
}


def detect_operation() -> JsonObject:
    """Keyword arguments of the ``/detect`` route: its answers and both kinds of request body."""
    image_encoding = {"contentType": "image/png, image/jpeg"}
    json_encoding = {"contentType": "application/json"}
    form = {
        "schema": _FORM_SCHEMA,
        "encoding": {
            "source": image_encoding,
            "target": image_encoding,
            "imu": json_encoding,
            "request": json_encoding,
        },
        "example": example_form_request(),
    }
    whole = {"schema": _reference("DetectRequest"), "example": example_json_request()}
    content = {"multipart/form-data": form, "application/json": whole}
    return {
        "responses": {
            200: _answer("The detection", _reference("Detection"), EXAMPLE_DETECTION),
            **_problems(EXAMPLE_FAULTS),
        },
        "openapi_extra": {"requestBody": {"required": True, "content": content}},
    }


HEALTH_RESPONSES: Final[Responses] = {200: _status_answer("Alive", "ok")}
READY_RESPONSES: Final[Responses] = {200: _status_answer("Ready", "ready"), **_problems([503])}
VERSION_RESPONSES: Final[Responses] = {
    200: _answer(
        "Versions",
        {
            "type": "object",
            "properties": {
                "version": {"type": "string"},
                "schema_version": {"type": "string"},
                "model": {"anyOf": [{"type": "null"}, {"type": "object"}]},
            },
            "required": ["version", "schema_version", "model"],
        },
        {"version": "0.1.0", "schema_version": "1.0", "model": EXAMPLE_DETECTION["model"]},
    )
}
METRICS_RESPONSES: Final[Responses] = {
    200: {
        "description": "Prometheus' text format, or OpenMetrics where the client accepts it",
        "content": {"text/plain": {"schema": {"type": "string"}}},
    }
}
SCHEMA_RESPONSES: Final[Responses] = {
    200: {"description": "JSON Schema", "content": {"application/schema+json": {"schema": {"type": "object"}}}}
}


def complete_openapi(app: FastAPI) -> None:
    """Make ``app.openapi()`` carry the component schemas that the operations refer to."""
    derive = app.openapi

    def openapi() -> JsonObject:
        if app.openapi_schema is None:
            document = derive()
            document.setdefault("components", {}).setdefault("schemas", {}).update(component_schemas())
            describe_access(document, _problems(REFUSALS))
            # FastAPI drops members that are null, which this example needs (track_id).
            answer = document["paths"]["/detect"]["post"]["responses"]["200"]["content"]["application/json"]
            answer["example"] = EXAMPLE_DETECTION
            app.openapi_schema = document
        return app.openapi_schema

    # FastAPI's documented way to extend the document.
    app.openapi = openapi  # type: ignore[method-assign]


def component_schemas() -> dict[str, JsonObject]:
    """Name -> JSON Schema of the request shapes, the problem and the detection with its parts."""
    _, requests = models_json_schema(
        [(shape, "validation") for shape in (DetectRequest, StampedImuPart, RequestRest)],
        ref_template=_COMPONENTS + "{model}",
    )
    detection = _with_component_references(load_detection_schema())
    parts: dict[str, JsonObject] = detection.pop("$defs", {})
    for keyword in ("$schema", "$id"):
        detection.pop(keyword, None)
    return {**requests["$defs"], "Problem": PROBLEM_SCHEMA, **parts, "Detection": detection}


def _with_component_references(node: Any) -> Any:
    """A copy in which ``#/$defs/X`` reads ``#/components/schemas/X``."""
    if isinstance(node, dict):
        return {
            key: value.replace("#/$defs/", _COMPONENTS) if key == "$ref" else _with_component_references(value)
            for key, value in node.items()
        }
    if isinstance(node, list):
        return [_with_component_references(item) for item in node]
    return node
