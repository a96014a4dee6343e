"""The HTTP service: endpoints around one :class:`AnomalyDetector`. It holds no logic that the library lacks."""

from __future__ import annotations

import asyncio
import importlib.metadata
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from http import HTTPStatus
from typing import Any, Final

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse
from starlette.requests import ClientDisconnect

from viflow_anomaly.detection import SCHEMA_VERSION, load_detection_schema
from viflow_anomaly.pair_detector import PairDetector
from viflow_anomaly_service.admission import AdmissionGate
from viflow_anomaly_service.detection_request import answer_request
from viflow_anomaly_service.detector_slot import DetectorSlot
from viflow_anomaly_service.openapi import (
    HEALTH_RESPONSES,
    READY_RESPONSES,
    SCHEMA_RESPONSES,
    VERSION_RESPONSES,
    complete_openapi,
    detect_operation,
)
from viflow_anomaly_service.problems import Problem, install_problem_handlers
from viflow_anomaly_service.request_body import RequestBody
from viflow_anomaly_service.request_log import RequestLogMiddleware
from viflow_anomaly_service.settings import ServiceSettings, load_settings

JSON_MEDIA_TYPE: Final = "application/json"
FORM_MEDIA_TYPE: Final = "multipart/form-data"
VERSION: Final = importlib.metadata.version("viflow-anomaly")

DetectorLoader = Callable[[ServiceSettings], PairDetector]


def load_bundled_or_configured(settings: ServiceSettings) -> PairDetector:
    """The detector that the settings name; sets how many threads the network and OpenCV use in this process.

    Raises:
        CheckpointError: the checkpoint cannot be used.
        ConfigError: the calibration cannot be read, or was made with something else.
    """
    import cv2  # noqa: PLC0415 - heavy, and needed only once a server really starts

    from viflow_anomaly.alarm_calibration import calibrated  # noqa: PLC0415
    from viflow_anomaly.detector import AnomalyDetector  # noqa: PLC0415

    cv2.setNumThreads(settings.threads)
    detector = AnomalyDetector.from_checkpoint(
        settings.checkpoint,
        config=settings.detector,
        device=settings.device,
        runtime=settings.runtime,
        threads=settings.threads,
        evidence_head=settings.evidence_head,
        precision=settings.precision,
        network_precision=settings.network_precision,
    )
    return calibrated(detector, settings.calibration)


def create_app(
    settings: ServiceSettings | None = None,
    *,
    load_detector: DetectorLoader = load_bundled_or_configured,
    on_load_failure: Callable[[Exception], Any] = lambda err: None,
) -> FastAPI:
    """An application whose detector is loaded in a thread when it starts.

    Args:
        settings: from the environment when not given.
        load_detector: makes the detector; called once, outside the event loop.
        on_load_failure: told when that raised; ``/readyz`` then stays at 503.

    Raises:
        ConfigError: ``config_invalid``, an environment variable that cannot be used.
    """
    settings = settings or load_settings()
    slot = DetectorSlot(lambda: load_detector(settings), on_failure=on_load_failure)
    workers = ThreadPoolExecutor(max_workers=settings.max_concurrent, thread_name_prefix="detect")

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        loading = asyncio.create_task(slot.fill())
        yield
        loading.cancel()
        workers.shutdown(wait=True, cancel_futures=True)

    app = FastAPI(
        title="viflow-anomaly",
        version=VERSION,
        summary="Finds independent motion in what a moving camera sees",
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        lifespan=lifespan,
        redirect_slashes=False,
    )
    app.add_middleware(RequestLogMiddleware)
    install_problem_handlers(app)
    _add_information(app, slot)
    _add_detect(app, slot, settings, workers)
    complete_openapi(app)
    return app


def _add_information(app: FastAPI, slot: DetectorSlot) -> None:
    @app.get("/healthz", operation_id="healthz", tags=["state"], responses=HEALTH_RESPONSES)
    async def healthz() -> JSONResponse:
        """The process is alive, whether or not the model is loaded."""
        return JSONResponse({"status": "ok"})

    @app.get("/readyz", operation_id="readyz", tags=["state"], responses=READY_RESPONSES)
    async def readyz() -> JSONResponse:
        """The model is loaded and ``/detect`` will answer."""
        slot.require()
        return JSONResponse({"status": "ready"})

    @app.get("/version", operation_id="version", tags=["state"], responses=VERSION_RESPONSES)
    async def version() -> JSONResponse:
        """Which software and which weights answer; ``model`` is null until they are loaded."""
        model = None
        if slot.detector is not None:
            info = slot.detector.model_info
            model = {"name": info.name, "version": info.version, "sha256": info.sha256}
        return JSONResponse({"version": VERSION, "schema_version": SCHEMA_VERSION, "model": model})

    @app.get(
        f"/schemas/detection-{SCHEMA_VERSION}.json",
        operation_id="detectionSchema",
        tags=["detection"],
        responses=SCHEMA_RESPONSES,
    )
    async def detection_schema() -> JSONResponse:
        """JSON Schema of a detection."""
        return JSONResponse(load_detection_schema(), media_type="application/schema+json")


def _add_detect(app: FastAPI, slot: DetectorSlot, settings: ServiceSettings, workers: ThreadPoolExecutor) -> None:
    gate = AdmissionGate(
        max_concurrent=settings.max_concurrent,
        max_queued=settings.max_queued,
        queue_timeout_s=settings.queue_timeout_s,
    )

    app.state.gate = gate

    @app.post("/detect", operation_id="detect", tags=["detection"], **detect_operation())
    async def detect(request: Request) -> Response:
        """Regions of independent motion in the source image of one pair, highest score first."""
        body = RequestBody(request)
        try:
            detector = slot.require()
            content_type = _accepted_content_type(request)
            async with gate.admitted():
                data = await body.read(max_bytes=settings.max_body_bytes, timeout_s=settings.body_timeout_s)
                async with gate.turn():
                    if await request.is_disconnected():
                        raise ClientDisconnect
                    answer = await asyncio.get_running_loop().run_in_executor(
                        workers, answer_request, detector, data, content_type, settings
                    )
        except Problem as problem:
            if problem.status != HTTPStatus.REQUEST_TIMEOUT:
                await body.discard()
            problem.closes_connection = not body.finished
            raise
        return Response(answer, media_type=JSON_MEDIA_TYPE)


def _accepted_content_type(request: Request) -> str:
    """The Content-Type header.

    Raises:
        Problem: 415 ``media_type_unsupported`` or ``content_encoding_unsupported``.
    """
    header = request.headers.get("content-type", "")
    if header.partition(";")[0].strip().lower() not in (JSON_MEDIA_TYPE, FORM_MEDIA_TYPE):
        raise Problem(
            415,
            code="media_type_unsupported",
            detail=f"expected Content-Type {FORM_MEDIA_TYPE} or {JSON_MEDIA_TYPE}, found {header or 'none'!r:.80}",
            field="Content-Type",
        )
    encoding = request.headers.get("content-encoding", "identity")
    if encoding.lower() != "identity":
        raise Problem(
            415,
            code="content_encoding_unsupported",
            detail=f"expected a body without Content-Encoding, found {encoding!r:.80}",
            field="Content-Encoding",
        )
    return header
