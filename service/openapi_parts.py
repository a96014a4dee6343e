"""Building blocks of the OpenAPI document for the parts that add endpoints beside ``/detect``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from http import HTTPStatus
from typing import Any, Final

from fastapi import FastAPI

from viflow_anomaly_service.problems import PROBLEM_MEDIA_TYPE, Problem

JsonObject = dict[str, Any]
Fault = tuple[str, str, str | None]
"""An example of a problem: code, detail, field."""

COMPONENTS: Final = "#/components/schemas/"
NANOSECONDS: Final[JsonObject] = {"type": "integer", "format": "int64"}
OR_NULL: Final = {"type": "null"}


def reference(name: str) -> JsonObject:
    return {"$ref": COMPONENTS + name}


def answer(description: str, schema: JsonObject, example: Any, media_type: str = "application/json") -> JsonObject:
    content = {"schema": schema} if example is None else {"schema": schema, "example": example}
    return {"description": description, "content": {media_type: content}}


def closed_object(properties: JsonObject, *, optional: tuple[str, ...] = (), description: str = "") -> JsonObject:
    """An object with these members and no others."""
    required = [name for name in properties if name not in optional]
    schema = {"type": "object", "properties": properties, "required": required, "additionalProperties": False}
    return {"description": description, **schema} if description else schema


def problems(faults: Mapping[int, Fault]) -> dict[int | str, JsonObject]:
    """Answers by status, each with its example; those of 503 say when to try again."""
    responses: dict[int | str, JsonObject] = {}
    for status, (code, detail, field) in faults.items():
        example = Problem(status, code=code, detail=detail, field=field).body(request_id="drone7-000042")
        responses[status] = answer(HTTPStatus(status).phrase, reference("Problem"), example, PROBLEM_MEDIA_TYPE)
        if status == HTTPStatus.SERVICE_UNAVAILABLE:
            header = {"description": "seconds", "schema": {"type": "integer", "minimum": 1}}
            responses[status]["headers"] = {"Retry-After": header}
    return responses


def parameter(name: str, schema: JsonObject, description: str, *, place: str = "query") -> JsonObject:
    return {"name": name, "in": place, "required": place == "path", "schema": schema, "description": description}


def set_examples(paths: JsonObject, *examples: tuple[str, str, Any]) -> None:
    """Whole ones, as (path, method, example of the answer 200): FastAPI leaves out of its own what is null."""
    for path, method, example in examples:
        paths[path][method]["responses"]["200"]["content"]["application/json"]["example"] = example


def extend_openapi(app: FastAPI, change: Callable[[JsonObject], None]) -> None:
    """Let ``change`` work on the document once, when it is made.

    FastAPI drops members that are null from examples; ``change`` is where they come back.
    """
    derive = app.openapi

    def openapi() -> JsonObject:
        if app.openapi_schema is None:
            document = derive()
            change(document)
            app.openapi_schema = document
        return app.openapi_schema

    # FastAPI's documented way to extend the document.
    app.openapi = openapi  # type: ignore[method-assign]
