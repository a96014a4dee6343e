"""``POST /detect``: in through the gate, upload, wait for a worker, answer."""

from __future__ import annotations

from typing import Final

from fastapi import FastAPI, Request, Response

from viflow_anomaly_service.detection_work import DetectionWork
from viflow_anomaly_service.openapi import detect_operation
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.request_body import RequestBody, answered
from viflow_anomaly_service.service_core import ServiceCore
from viflow_anomaly_service.stage_times import StageClock
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
    settings, models = core.settings, core.require_judging()
    content_type = accepted_content_type(request)
    clock = StageClock(core.metrics)
    async with core.gate.admitted():
        upload = body.read(max_bytes=settings.max_body_bytes, timeout_s=settings.body_timeout_s)
        with clock.told_to(request.scope):
            data = await clock.awaited("upload", upload)
            work = DetectionWork(models, data, content_type, settings=settings, metrics=core.metrics, clock=clock)
            del data  # the work alone holds it, and lets go of it once it is decoded
            return await body.while_connected(_judged_and_kept(core, work, clock))


async def _judged_and_kept(core: ServiceCore, work: DetectionWork, clock: StageClock) -> tuple[bytes, dict[str, str]]:
    """With a store there is no answer before its commit."""
    answer = await core.gate.in_turn(core.pool, work, patience_s=core.settings.queue_timeout_s)
    if core.keeper is None or work.detection is None:
        return answer, {}
    keeping = core.keeper.keep([(work.detection, answer.decode())], thumbnails=[work.thumbnail])
    (kept_as,) = await clock.awaited("store", keeping)
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
