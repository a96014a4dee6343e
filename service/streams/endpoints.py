"""``/streams``: frames and samples in, tracked detections out; what streams there are; an end to one."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from http import HTTPStatus

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse

from viflow_anomaly_service.detect_endpoint import JSON_MEDIA_TYPE, accepted_content_type
from viflow_anomaly_service.detector_pool import DeadlinePassedError
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.request_body import RequestBody
from viflow_anomaly_service.request_log import log_fields
from viflow_anomaly_service.service_core import ServiceCore
from viflow_anomaly_service.stage_times import StageTime, stage_times
from viflow_anomaly_service.store.query import STREAM_ID
from viflow_anomaly_service.streams.openapi import (
    DELETE_OPERATION,
    FRAMES_OPERATION,
    LIST_OPERATION,
    STATUS_OPERATION,
    add_streams_openapi,
)
from viflow_anomaly_service.streams.table import LiveStream
from viflow_anomaly_service.streams.work import JudgedCall, StreamWork


def add_streams(app: FastAPI, core: ServiceCore) -> None:
    """Add the endpoints; with several processes they answer 501."""

    @app.post("/streams/{stream_id}/frames", operation_id="addFrame", tags=["streams"], **FRAMES_OPERATION)
    async def add_frame(request: Request, stream_id: str) -> Response:
        """A frame, IMU samples or both; the detections of the pairs that can be judged now."""
        body = RequestBody(request)
        try:
            answer = await _answer(core, request, body, stream_id)
        except Problem as problem:
            if problem.status != HTTPStatus.REQUEST_TIMEOUT:
                await body.discard()
            problem.closes_connection = not body.finished
            raise
        return Response(answer, media_type=JSON_MEDIA_TYPE)

    @app.get("/streams", operation_id="listStreams", tags=["streams"], **LIST_OPERATION)
    async def list_streams() -> JSONResponse:
        """All streams that are remembered, by name."""
        _require_one_process(core)
        return JSONResponse({"streams": [stream.status() for stream in core.streams.begun()]})

    @app.get("/streams/{stream_id}", operation_id="getStream", tags=["streams"], **STATUS_OPERATION)
    async def get_stream(stream_id: str) -> JSONResponse:
        """What a stream has received and remembers."""
        _require_one_process(core)
        return JSONResponse(core.streams.require(stream_id).status())

    @app.delete(
        "/streams/{stream_id}",
        operation_id="deleteStream",
        tags=["streams"],
        status_code=204,
        response_class=Response,
        **DELETE_OPERATION,
    )
    async def delete_stream(stream_id: str) -> Response:
        """Forget a stream: the next frame of this name begins another one."""
        _require_one_process(core)
        core.streams.forget(core.streams.require(stream_id))
        return Response(status_code=204)

    add_streams_openapi(app)


def _require_one_process(core: ServiceCore) -> None:
    if core.settings.workers > 1:
        detail = f"expected a service of one process (VIFLOW_WORKERS=1), found {core.settings.workers}: a stream's "
        raise Problem(501, code="streams_need_one_process", detail=detail + "frames would reach different ones")


async def _answer(core: ServiceCore, request: Request, body: RequestBody, stream_id: str) -> bytes:
    """The answer's bytes.

    Raises:
        Problem: the request is refused, or something is wrong with it; the stream then stays where it was.
        ClientDisconnect: nobody waits for the answer any more.
    """
    _require_one_process(core)
    if STREAM_ID.fullmatch(stream_id) is None:
        detail = f"stream_id: expected 1 to 64 of A-Z a-z 0-9 . _ -, found {stream_id!r:.80}"
        raise Problem(422, code="stream_id_invalid", detail=detail, field="stream_id")
    core.gate.require_open()
    try:
        detector = core.slot.require()
    except Problem:
        core.metrics.shed.labels("not_ready").inc()
        raise
    if detector.motor_source is not None:
        raise Problem(501, code="streams_motor_unsupported", detail="expected a model without motor input, found one")
    if core.keeper is not None:
        core.keeper.require_usable()  # before a pair is judged for nothing
    content_type, settings = accepted_content_type(request), core.settings
    async with core.gate.admitted(), core.streams.turn(stream_id) as stream:
        started = time.perf_counter()
        data = await body.read(max_bytes=settings.max_body_bytes, timeout_s=settings.body_timeout_s)
        uploaded_s = time.perf_counter() - started
        core.metrics.observe_stage("upload", uploaded_s)
        stages = stage_times(request.scope)
        stages.append(StageTime.until_now("upload", uploaded_s))
        known = None if stream.setup is None or stream.stream is None else (stream.setup, stream.stream)
        work = StreamWork(
            detector,
            data,
            content_type,
            known=known,
            state=stream.state,
            settings=settings,
            metrics=core.metrics,
        )
        del data  # the work alone holds it, and lets go of it once it is decoded
        try:
            return await body.while_connected(_judged_and_kept(core, stream, work))
        except DeadlinePassedError as err:
            raise core.gate.shed("deadline", f"no turn came within {settings.queue_timeout_s:g} s") from err
        finally:
            stages.extend(work.stages)
            log_fields(request.scope).update(work.log)


async def _judged_and_kept(core: ServiceCore, stream: LiveStream, work: StreamWork) -> bytes:
    """Cancelled before the call is judged, nothing has happened; after that it is finished, whoever has gone."""
    judged = await core.pool.run(work, within_s=core.settings.queue_timeout_s)
    started = time.perf_counter()
    finishing = asyncio.ensure_future(_kept(core, stream, judged))
    try:
        answer = await asyncio.shield(finishing)
    except asyncio.CancelledError:
        with contextlib.suppress(Problem):
            await finishing
        raise
    if core.keeper is not None:
        stored_s = time.perf_counter() - started
        core.metrics.observe_stage("store", stored_s)
        work.stages.append(StageTime.until_now("store", stored_s))
    return answer


async def _kept(core: ServiceCore, stream: LiveStream, judged: JudgedCall) -> bytes:
    """The stream advances once its detections are on the disk: a call that was refused can be sent again."""
    step, received = judged.step, judged.received
    core.streams.require_room(stream, step.state)
    ids = None
    if core.keeper is not None:
        pairs = list(zip(step.detections, judged.bodies, strict=True))
        ids = await core.keeper.keep(
            pairs, stream_id=stream.stream_id, session_id=stream.session_id, thumbnails=judged.thumbnails
        )
    begun = stream.setup is None
    core.streams.advance(stream, judged.setup, judged.stream, step)
    if received.frame is not None:
        stream.received_frames += 1
    if received.imu is not None:
        stream.received_imu_samples += len(received.imu.timestamps_ns)
    head = json.dumps(
        {
            "stream_id": stream.stream_id,
            "session_id": stream.session_id,
            "begun": begun,
            "waiting_frames": max(len(step.state.frames) - 1, 0),
            "faults": [{"code": fault.code, "message": fault.message} for fault in step.faults],
            "detection_ids": ids,
        },
        separators=(",", ":"),
    )
    return f'{head[:-1]},"detections":[{",".join(judged.bodies)}]}}'.encode()
