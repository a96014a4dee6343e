"""``/models``: which are loaded; another one loaded, made the default, let go."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse

from viflow_anomaly.pair_detector import LoadedWeights
from viflow_anomaly_service.models.named import MODEL_NAME, NAME_RULE
from viflow_anomaly_service.models.openapi import (
    LIST_OPERATION,
    LOAD_OPERATION,
    SWITCH_OPERATION,
    UNLOAD_OPERATION,
    add_models_openapi,
)
from viflow_anomaly_service.models.request import DefaultModel, ModelLoad, read_shape
from viflow_anomaly_service.models.table import LoadedModel, ModelSet
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.request_body import RequestBody, answered
from viflow_anomaly_service.service_core import ServiceCore


def add_models(app: FastAPI, core: ServiceCore) -> None:
    """Add the endpoints; with several processes those that change something answer 501."""

    @app.get("/models", operation_id="models", tags=["models"], **LIST_OPERATION)
    async def models() -> JSONResponse:
        """The networks of the default model (``models``), and all models by name (``loaded``)."""
        return JSONResponse(_described(core.models.require()))

    @app.post("/models/{name}/load", operation_id="loadModel", tags=["models"], **LOAD_OPERATION)
    async def load(request: Request, name: str) -> JSONResponse:
        """Load a model beside the others and put it in the place of its name; requests go on meanwhile."""
        body = RequestBody(request)
        async with answered(body):
            _require_one_process(core)
            if core.settings.model_dir is None:
                detail = "expected a service that was given a folder of models (VIFLOW_MODEL_DIR), found none"
                raise Problem(501, code="model_dir_missing", detail=detail)
            if MODEL_NAME.fullmatch(name) is None:
                detail = f"name: expected {NAME_RULE}, found {name!r:.80}"
                raise Problem(422, code="model_name_invalid", detail=detail, field="name")
            wanted = await read_shape(request, body, ModelLoad, core.settings)
            settings = wanted.model_in(core.settings.model_dir).applied_to(core.settings)
            loaded = await core.models.load(name, settings, sha256=wanted.sha256)
        return JSONResponse(_entry(loaded, core.models.require()))

    @app.put("/models/default", operation_id="switchModel", tags=["models"], **SWITCH_OPERATION)
    async def switch(request: Request) -> JSONResponse:
        """Make another model the default; streams that have begun keep theirs."""
        body = RequestBody(request)
        async with answered(body):
            _require_one_process(core)
            wanted = await read_shape(request, body, DefaultModel, core.settings)
            return JSONResponse(_described(core.models.switch(wanted.name)))

    @app.delete(
        "/models/{name}",
        operation_id="unloadModel",
        tags=["models"],
        status_code=204,
        response_class=Response,
        **UNLOAD_OPERATION,
    )
    async def unload(name: str) -> Response:
        """Let a model go; requests and streams that have begun with it keep it until they end."""
        _require_one_process(core)
        core.models.unload(name)
        return Response(status_code=204)

    add_models_openapi(app)


def _require_one_process(core: ServiceCore) -> None:
    if core.settings.workers > 1:
        detail = (
            f"expected a service of one process (VIFLOW_WORKERS=1), found {core.settings.workers}: the others would "
            "not be told; models of the configuration are in all of them"
        )
        raise Problem(501, code="models_need_one_process", detail=detail)


def _described(models: ModelSet) -> dict[str, Any]:
    weights = models.default.detector.loaded_weights
    return {
        "models": [_weights(one) for one in weights],
        "loaded": [_entry(one, models) for one in sorted(models.models, key=lambda one: one.name)],
    }


def _entry(model: LoadedModel, models: ModelSet) -> dict[str, Any]:
    return {
        "name": model.name,
        "version": model.version,
        "sha256": model.detector.model_info.sha256,
        "default": model.name == models.default_name,
        "loaded_at_ns": model.loaded_at_ns,
        "model": asdict(model.detector.model_info),
        "weights": [_weights(one) for one in model.detector.loaded_weights],
    }


def _weights(weights: LoadedWeights) -> dict[str, str | None]:
    values = weights._asdict()
    return {**{name: value for name, value in values.items() if name != "backend"}, **weights.backend._asdict()}
