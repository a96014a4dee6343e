"""What the OpenAPI document says of models."""

from __future__ import annotations

from typing import Any, Final

from fastapi import FastAPI
from pydantic.json_schema import models_json_schema

from viflow_anomaly_service.examples import EXAMPLE_FAULTS, SOURCE_NS
from viflow_anomaly_service.models.named import MODEL_NAME
from viflow_anomaly_service.models.request import DefaultModel, ModelLoad
from viflow_anomaly_service.openapi_parts import (
    COMPONENTS,
    NANOSECONDS,
    Fault,
    JsonObject,
    answer,
    closed_object,
    extend_openapi,
    problems,
    reference,
)

_TEXT: Final = {"type": "string"}
_SHA256: Final = {"type": "string", "pattern": "^[0-9a-f]{64}$", "description": "of the file of weights"}
_WEIGHTS: Final[JsonObject] = closed_object(
    {
        "role": {"enum": ["network", "evidence_head"]},
        "name": _TEXT,
        "version": _TEXT,
        "sha256": _SHA256,
        "preset": {"type": ["string", "null"], "description": "structure of the network; null for a head"},
        "runtime": {"type": "string", "description": "torch, openvino or onnxruntime"},
        "device": _TEXT,
        "precision": {"type": "string", "description": "f32, bf16 or int8"},
    }
)
_NAME: Final = {"type": "string", "pattern": f"^{MODEL_NAME.pattern}$"}
_LOADED: Final[JsonObject] = closed_object(
    {
        "name": {**_NAME, "description": "by which requests ask for it"},
        "version": {"type": "string", "description": "of its weights; requests may ask for name@version"},
        "sha256": _SHA256,
        "default": {"type": "boolean", "description": "answers those that ask for none"},
        "loaded_at_ns": {**NANOSECONDS, "description": "Unix time"},
        "model": closed_object({"name": _TEXT, "version": _TEXT, "sha256": _SHA256}, description="as in detections"),
        "weights": {"type": "array", "items": reference("ModelWeights"), "minItems": 1},
    },
    description="A model that requests can ask for",
)
_LIST: Final[JsonObject] = closed_object(
    {
        "models": {
            "type": "array",
            "items": reference("ModelWeights"),
            "minItems": 1,
            "description": "of the default model: its network and, where one takes part, its evidence head",
        },
        "loaded": {"type": "array", "items": reference("LoadedModel"), "minItems": 1, "description": "all, by name"},
    }
)
_EXAMPLE_WEIGHTS: Final[JsonObject] = {
    "role": "network",
    "name": "viflow-calibrated",
    "version": "2",
    "sha256": "0" * 64,
    "preset": "calibrated",
    "runtime": "openvino",
    "device": "cpu",
    "precision": "f32",
}
_EXAMPLE: Final[JsonObject] = {
    "name": "default",
    "version": "2",
    "sha256": "0" * 64,
    "default": True,
    "loaded_at_ns": SOURCE_NS,
    "model": {"name": "viflow-calibrated", "version": "2", "sha256": "0" * 64},
    "weights": [_EXAMPLE_WEIGHTS],
}
_EXAMPLE_LIST: Final = {"models": [_EXAMPLE_WEIGHTS], "loaded": [_EXAMPLE]}
_NOT_READY: Final[Fault] = ("model_loading", "The model is still being loaded.", None)
_ONE_PROCESS: Final[Fault] = (
    "models_need_one_process",
    "expected a service of one process (VIFLOW_WORKERS=1), found 4: the others would not be told; models of the "
    "configuration are in all of them",
    None,
)
_UNKNOWN: Final[Fault] = ("model_unknown", "name: expected one of default, night, found 'day'", "name")
_CORRUPT: Final[Fault] = (
    "checkpoint_corrupt",
    "expected a model that can be loaded, found a fault (checkpoint_corrupt); the service's log says more",
    "checkpoint",
)
_MISMATCH: Final[Fault] = (
    "model_checksum_mismatch",
    f"sha256: expected the weights {'1' * 64}, found {'0' * 64}",
    "sha256",
)
_IS_DEFAULT: Final[Fault] = (
    "model_is_default",
    "expected another model than the default, found 'day'; switch the default first",
    None,
)
_NOT_FOUND: Final[Fault] = ("model_not_found", "expected a model that is loaded, found 'day'", None)
_BODY_FAULTS: Final = {status: EXAMPLE_FAULTS[status] for status in (400, 408, 413, 415)}
_ALWAYS: Final = {500: EXAMPLE_FAULTS[500], 503: _NOT_READY}
_CHANGING: Final = {**_ALWAYS, 501: _ONE_PROCESS}


def _operation(good: JsonObject, faults: dict[int, Fault], body: str | None = None, example: Any = None) -> JsonObject:
    operation: JsonObject = {"responses": {200: good, **problems(dict(sorted(faults.items())))}}
    if body is not None:
        content = {"application/json": {"schema": reference(body), "example": example}}
        operation["openapi_extra"] = {"requestBody": {"required": True, "content": content}}
    return operation


LIST_OPERATION: Final = _operation(answer("Models", reference("ModelList"), _EXAMPLE_LIST), _ALWAYS)
LOAD_OPERATION: Final = _operation(
    answer("Loaded", reference("LoadedModel"), _EXAMPLE | {"name": "day", "default": False}),
    {**_BODY_FAULTS, **_CHANGING, 409: _MISMATCH, 422: _CORRUPT},
    "ModelLoad",
    {"checkpoint": "day/network.safetensors", "sha256": "0" * 64},
)
SWITCH_OPERATION: Final = _operation(
    answer("Switched", reference("ModelList"), _EXAMPLE_LIST),
    {**_BODY_FAULTS, **_CHANGING, 422: _UNKNOWN},
    "DefaultModel",
    {"name": "day"},
)
UNLOAD_OPERATION: Final[JsonObject] = {
    "responses": {204: {"description": "Let go"}, **problems({404: _NOT_FOUND, 409: _IS_DEFAULT, **_CHANGING})}
}


def add_models_openapi(app: FastAPI) -> None:
    """The components and the name's pattern."""

    def change(document: JsonObject) -> None:
        shapes = [(shape, "validation") for shape in (ModelLoad, DefaultModel)]
        _, requests = models_json_schema(shapes, ref_template=COMPONENTS + "{model}")  # type: ignore[arg-type]
        document["components"]["schemas"] |= {
            **requests["$defs"],
            "ModelWeights": _WEIGHTS,
            "LoadedModel": _LOADED,
            "ModelList": _LIST,
        }
        for path in ("/models/{name}/load", "/models/{name}"):
            for operation in document["paths"][path].values():
                (name,) = operation["parameters"]
                name["schema"] = _NAME

    extend_openapi(app, change)
