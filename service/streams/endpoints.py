"""``/streams``: frames and samples in, tracked detections out; what streams there are; an end to one."""

from __future__ import annotations

from functools import partial

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse

from viflow_anomaly_service.detect_endpoint import JSON_MEDIA_TYPE, accepted_content_type
from viflow_anomaly_service.request_body import RequestBody, answered
from viflow_anomaly_service.service_core import ServiceCore
from viflow_anomaly_service.stage_times import StageClock
from viflow_anomaly_service.streams.calls import answer_call, require_callable, require_one_process
from viflow_anomaly_service.streams.openapi import (
    DELETE_OPERATION,
    FRAMES_OPERATION,
    LIST_OPERATION,
    STATUS_OPERATION,
    add_streams_openapi,
)
from viflow_anomaly_service.streams.request import read_input
from viflow_anomaly_service.streams.sockets import add_stream_sockets
from viflow_anomaly_service.streams.work import Reading


def add_streams(app: FastAPI, core: ServiceCore) -> None:
    """Add the endpoints; with several processes they answer 501."""

    @app.post("/streams/{stream_id}/frames", operation_id="addFrame", tags=["streams"], **FRAMES_OPERATION)
    async def add_frame(request: Request, stream_id: str) -> Response:
        """A frame, IMU samples or both; the detections of the pairs that can be judged now."""
        body = RequestBody(request)
        async with answered(body):
            models = require_callable(core, stream_id)
            content_type, settings = accepted_content_type(request), core.settings
            clock = StageClock(core.metrics)

            async def receive() -> Reading:
                upload = body.read(max_bytes=settings.max_body_bytes, timeout_s=settings.body_timeout_s)
                return partial(read_input, await clock.awaited("upload", upload), content_type, settings)

            with clock.told_to(request.scope):
                answer = await answer_call(
                    core, stream_id, models, receive=receive, while_connected=body.while_connected, clock=clock
                )
        return Response(answer, media_type=JSON_MEDIA_TYPE)

    @app.get("/streams", operation_id="listStreams", tags=["streams"], **LIST_OPERATION)
    async def list_streams() -> JSONResponse:
        """All streams that are remembered, by name."""
        require_one_process(core)
        return JSONResponse({"streams": [stream.status() for stream in core.streams.begun()]})

    @app.get("/streams/{stream_id}", operation_id="getStream", tags=["streams"], **STATUS_OPERATION)
    async def get_stream(stream_id: str) -> JSONResponse:
        """What a stream has received and remembers."""
        require_one_process(core)
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
        require_one_process(core)
        core.streams.forget(core.streams.require(stream_id))
        core.live.forget(stream_id)
        return Response(status_code=204)

    add_stream_sockets(app, core)
    add_streams_openapi(app)
