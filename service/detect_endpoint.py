"""``POST /detect``: in through the gate, upload, wait for a worker, answer."""

from __future__ import annotations

import time
from typing import Final

from fastapi import FastAPI, Request, Response

from viflow_anomaly_service.detection_work import DetectionWork
from viflow_anomaly_service.detector_pool import DeadlinePassedError
from viflow_anomaly_service.openapi import detect_operation
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.request_body import RequestBody, answered
from viflow_anomaly_service.request_log import log_fields
from viflow_anomaly_service.service_core import ServiceCore
from viflow_anomaly_service.stage_times import StageTime, stage_times
from viflow_anomaly_service.store.openapi import DETECTION_ID_HEADER

JSON_MEDIA_TYPE: Final = "application/json"
FORM_MEDIA_TYPE: Final = "multipart/form-data"


def add_detect(app: FastAPI, core: ServiceCore) -> None:
    """Add the endpoint."""

    @app.post("/detect", operation_id="detect", tags=["detection"], **detect_operation())
    async def detect(request: Request) -> Response:
        """Regions of independent motion in the source image of one pair, highest score first."""
        body = RequestBody(request)
        async with answered(body):
            answer, headers = await _answer(core, request, body)
        return Response(answer, media_type=JSON_MEDIA_TYPE, headers=headers)


async def _answer(core: ServiceCore, request: Request, body: RequestBody) -> tuple[bytes, dict[str, str]]:
    """The answer's bytes, and its headers beyond the usual ones.

    Raises:
        Problem: the request is refused, or something is wrong with it.
        ClientDisconnect: nobody waits for the answer any more.
    """
    settings = core.settings
    core.gate.require_open()
    try:
        models = core.models.require()
    except Problem:
        core.metrics.shed.labels("not_ready").inc()
        raise
    if core.keeper is not None:
        core.keeper.require_usable()  # before a pair is judged for nothing
    content_type = accepted_content_type(request)
    async with core.gate.admitted():
        started = time.perf_counter()
        data = await body.read(max_bytes=settings.max_body_bytes, timeout_s=settings.body_timeout_s)
        uploaded_s = time.perf_counter() - started
        core.metrics.observe_stage("upload", uploaded_s)
        stages = stage_times(request.scope)
        stages.append(StageTime.until_now("upload", uploaded_s))
        work = DetectionWork(models, data, content_type, settings=settings, metrics=core.metrics)
        del data  # the work alone holds it, and lets go of it once it is decoded
        try:
            return await body.while_connected(_judged_and_kept(core, work))
        except DeadlinePassedError as err:
            raise core.gate.shed("deadline", f"no turn came within {settings.queue_timeout_s:g} s") from err
        finally:
            stages.extend(work.stages)
            log_fields(request.scope).update(work.log, upload_ms=round(uploaded_s * 1e3, 3))


async def _judged_and_kept(core: ServiceCore, work: DetectionWork) -> tuple[bytes, dict[str, str]]:
    """With a store there is no answer before its commit."""
    answer = await core.pool.run(work, within_s=core.settings.queue_timeout_s)
    if core.keeper is None or work.detection is None:
        return answer, {}
    started = time.perf_counter()
    (kept_as,) = await core.keeper.keep([(work.detection, answer.decode())], thumbnails=[work.thumbnail])
    stored_s = time.perf_counter() - started
    core.metrics.observe_stage("store", stored_s)
    work.stages.append(StageTime.until_now("store", stored_s))
    return answer, {DETECTION_ID_HEADER: kept_as}


def accepted_content_type(request: Request) -> str:
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
