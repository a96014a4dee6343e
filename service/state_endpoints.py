"""What the service says of itself: alive, ready, which versions, how it fares. None of it waits for a worker."""

from __future__ import annotations

import asyncio
import importlib.metadata
from typing import Final

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse

from viflow_anomaly.detection import SCHEMA_VERSION, load_detection_schema
from viflow_anomaly_service.openapi import (
    HEALTH_RESPONSES,
    METRICS_RESPONSES,
    READY_RESPONSES,
    SCHEMA_RESPONSES,
    VERSION_RESPONSES,
)
from viflow_anomaly_service.service_core import ServiceCore

VERSION: Final = importlib.metadata.version("viflow-anomaly")


def add_state(app: FastAPI, core: ServiceCore) -> None:
    """Add the endpoints."""

    @app.get("/healthz", operation_id="healthz", tags=["state"], responses=HEALTH_RESPONSES)
    async def healthz() -> JSONResponse:
        """The process is alive, whether or not the model is loaded."""
        return JSONResponse({"status": "ok"})

    @app.get("/readyz", operation_id="readyz", tags=["state"], responses=READY_RESPONSES)
    async def readyz() -> JSONResponse:
        """The model is loaded and warm, and ``/detect`` will answer."""
        core.gate.require_open()
        core.models.require()
        if core.keeper is not None:
            core.keeper.require_usable()
        return JSONResponse({"status": "ready"})

    @app.get("/version", operation_id="version", tags=["state"], responses=VERSION_RESPONSES)
    async def version() -> JSONResponse:
        """Which software and which weights answer; ``model`` is null until they are loaded."""
        model = None
        if (models := core.models.current) is not None:
            info = models.default.detector.model_info
            model = {"name": info.name, "version": info.version, "sha256": info.sha256}
        return JSONResponse({"version": VERSION, "schema_version": SCHEMA_VERSION, "model": model})

    @app.get("/metrics", operation_id="metrics", tags=["state"], responses=METRICS_RESPONSES, response_class=Response)
    async def metrics(request: Request) -> Response:
        """Counts, times by stage and state, for Prometheus; of all worker processes together."""
        accept = request.headers.get("accept", "")
        content, media_type = await asyncio.to_thread(core.metrics.exposition, accept)
        return Response(content, media_type=media_type)

    @app.get(
        f"/schemas/detection-{SCHEMA_VERSION}.json",
        operation_id="detectionSchema",
        tags=["detection"],
        responses=SCHEMA_RESPONSES,
    )
    async def detection_schema() -> JSONResponse:
        """JSON Schema of a detection."""
        return JSONResponse(load_detection_schema(), media_type="application/schema+json")
