"""``GET /models``: which weights are loaded, and what computes them."""

from __future__ import annotations

from typing import Any, Final

from fastapi import FastAPI
from fastapi.responses import JSONResponse

from viflow_anomaly.pair_detector import LoadedWeights
from viflow_anomaly_service.openapi import READY_RESPONSES
from viflow_anomaly_service.service_core import ServiceCore

_TEXT: Final = {"type": "string"}
_MODEL: Final[dict[str, Any]] = {
    "title": "Model",
    "type": "object",
    "properties": {
        "role": {"enum": ["network", "evidence_head"]},
        "name": _TEXT,
        "version": _TEXT,
        "sha256": {"type": "string", "pattern": "^[0-9a-f]{64}$", "description": "of the file of weights"},
        "preset": {"type": ["string", "null"], "description": "structure of the network; null for a head"},
        "runtime": {"type": "string", "description": "torch, openvino or onnxruntime"},
        "device": _TEXT,
        "precision": {"type": "string", "description": "f32, bf16 or int8"},
    },
    "required": ["role", "name", "version", "sha256", "preset", "runtime", "device", "precision"],
    "additionalProperties": False,
}
_SCHEMA: Final[dict[str, Any]] = {
    "title": "Models",
    "type": "object",
    "properties": {"models": {"type": "array", "items": _MODEL, "minItems": 1}},
    "required": ["models"],
    "additionalProperties": False,
}
_COMPUTED: Final = {"runtime": "openvino", "device": "cpu", "precision": "f32"}
_EXAMPLE: Final[dict[str, Any]] = {
    "models": [
        {"role": "network", "name": "viflow-calibrated", "version": "2", "sha256": "0" * 64, "preset": "calibrated"}
        | _COMPUTED,
    ]
}


def add_models(app: FastAPI, core: ServiceCore) -> None:
    """Add the endpoint."""
    content = {"application/json": {"schema": _SCHEMA, "example": _EXAMPLE}}
    answers: dict[int | str, dict[str, Any]] = {**READY_RESPONSES, 200: {"description": "Models", "content": content}}

    @app.get("/models", operation_id="models", tags=["state"], responses=answers)
    async def models() -> JSONResponse:
        """The network and, where one takes part, the evidence head."""
        return JSONResponse({"models": [_described(weights) for weights in core.slot.require().loaded_weights]})


def _described(weights: LoadedWeights) -> dict[str, str | None]:
    values = weights._asdict()
    return {**{name: value for name, value in values.items() if name != "backend"}, **weights.backend._asdict()}
