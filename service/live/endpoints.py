"""Looking on: ``/live``, the recent pairs of streams with their pictures, ``/inspect``, and ``/detector``."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, Final, TypeVar

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse

from viflow_anomaly_service.detect_endpoint import JSON_MEDIA_TYPE, accepted_content_type
from viflow_anomaly_service.detector_pool import Job
from viflow_anomaly_service.live.detector_description import describe_detector
from viflow_anomaly_service.live.inspection_work import InspectionWork, UploadWork, json_object
from viflow_anomaly_service.live.openapi import (
    DETECTOR_OPERATION,
    EVENTS_OPERATION,
    INSPECT_OPERATION,
    LIVE_OPERATION,
    PAIRS_OPERATION,
    PICTURE_OPERATION,
    STREAM_EVENTS_OPERATION,
    TUNE_OPERATION,
    add_live_openapi,
)
from viflow_anomaly_service.live.pair_memory import UPLOADS, RememberedPair, StreamTally
from viflow_anomaly_service.live.pair_stream import pair_events, resume_after
from viflow_anomaly_service.live.pictures import PICTURES, PairPictures
from viflow_anomaly_service.live_response import LiveResponse
from viflow_anomaly_service.picture_files import MEDIA_TYPES
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.request_body import RequestBody, answered
from viflow_anomaly_service.service_core import ServiceCore
from viflow_anomaly_service.stage_times import StageClock
from viflow_anomaly_service.streams.calls import require_stream_id

MAX_TUNE_BYTES: Final = 64 * 1024

Result = TypeVar("Result")


def add_live(app: FastAPI, core: ServiceCore) -> None:
    """Add the endpoints; without remembered pairs (several processes, ``live_pairs`` 0) most are 501."""
    _add_pairs(app, core)
    _add_followers(app, core)
    _add_inspections(app, core)
    add_live_openapi(app)


def _add_pairs(app: FastAPI, core: ServiceCore) -> None:
    memory = core.live
    pictures = PairPictures(core.pool, core.gate, core.settings)

    @app.get("/live", operation_id="listLive", tags=["live"], **LIVE_OPERATION)
    async def list_live() -> JSONResponse:
        """Streams of which pairs are remembered, each with its newest pair's number and what it came to."""
        _require_memory(core)
        known = {stream.stream_id: stream.status() for stream in core.streams.begun()}
        listed = [_overview(known.get(name), name, tally, newest) for name, tally, newest in memory.streams()]
        return JSONResponse({"newest_number": memory.newest_number, "streams": listed})

    @app.get("/streams/{stream_id}/pairs", operation_id="listPairs", tags=["live"], **PAIRS_OPERATION)
    async def list_pairs(stream_id: str) -> Response:
        """The remembered pairs of a stream, newest first."""
        _require_memory(core)
        listed = ",".join(one.to_json() for one in memory.newest_first(stream_id))
        return Response(f'{{"pairs":[{listed}]}}', media_type=JSON_MEDIA_TYPE)

    @app.get(
        "/streams/{stream_id}/pairs/{number}/{picture}",
        operation_id="getPairPicture",
        tags=["live"],
        response_class=Response,
        **PICTURE_OPERATION,
    )
    async def get_picture(stream_id: str, number: str, picture: str) -> Response:
        """A frame of a pair, or a map of what was made of it, as PNG or JPEG."""
        _require_memory(core)
        name, _, suffix = picture.partition(".")
        if name not in PICTURES or suffix not in MEDIA_TYPES:
            detail = f"expected {', '.join(PICTURES)} as .png or .jpg, found {picture!r:.80}"
            raise Problem(404, code="picture_unknown", detail=detail)
        data = await pictures.picture(memory.require(stream_id, number), name, suffix)
        return Response(data, media_type=MEDIA_TYPES[suffix])


def _add_followers(app: FastAPI, core: ServiceCore) -> None:
    @app.get("/live/pairs", operation_id="followPairs", tags=["live"], **EVENTS_OPERATION)
    async def follow_all(request: Request) -> Response:
        """Every new pair of all streams, as server-sent events."""
        return _followed(core, request, None)

    @app.get("/streams/{stream_id}/live", operation_id="followStreamPairs", tags=["live"], **STREAM_EVENTS_OPERATION)
    async def follow_stream(request: Request, stream_id: str) -> Response:
        """Every new pair of one stream, as server-sent events."""
        return _followed(core, request, stream_id)


def _add_inspections(app: FastAPI, core: ServiceCore) -> None:
    @app.post(
        "/streams/{stream_id}/pairs/{number}/inspect", operation_id="inspectPair", tags=["live"], **TUNE_OPERATION
    )
    async def inspect_pair(request: Request, stream_id: str, number: str) -> Response:
        """What a remembered pair would be judged under other options, and what decided."""
        _require_memory(core)
        remembered, body = core.live.require(stream_id, number), RequestBody(request)
        async with answered(body):
            return Response(await _inspected(core, body, remembered), media_type=JSON_MEDIA_TYPE)

    @app.post("/inspect", operation_id="inspect", tags=["live"], **INSPECT_OPERATION)
    async def inspect(request: Request) -> Response:
        """A pair as for ``/detect``, looked at closely and remembered, so that its pictures can be asked for."""
        _require_memory(core)
        body = RequestBody(request)
        async with answered(body):
            return Response(await _uploaded(core, request, body), media_type=JSON_MEDIA_TYPE)

    @app.get("/detector", operation_id="getDetector", tags=["live"], **DETECTOR_OPERATION)
    async def get_detector() -> JSONResponse:
        """What pairs are judged under: configuration, the limits of its region settings, calibration, model cards."""
        return JSONResponse(await asyncio.to_thread(describe_detector, core.models.require().default))


def _require_memory(core: ServiceCore) -> None:
    if core.settings.workers > 1:
        detail = f"expected a service of one process (VIFLOW_WORKERS=1), found {core.settings.workers}: a stream's "
        raise Problem(501, code="streams_need_one_process", detail=detail + "pairs would be remembered in one of them")
    if not core.live.enabled:
        raise Problem(501, code="live_off", detail="expected a service that remembers pairs, found VIFLOW_LIVE_PAIRS=0")


def _overview(
    status: dict[str, Any] | None, stream_id: str, tally: StreamTally, newest: RememberedPair
) -> dict[str, Any]:
    hours = tally.footage_s / 3600.0
    return {
        "stream_id": stream_id,
        "session_id": newest.session_id,
        "active": status is not None,
        "newest_number": newest.number,
        "newest_at_ns": newest.received_at_ns,
        "remembered_pairs": len(tally.numbers),
        "judged_pairs": tally.pairs,
        "abstained_pairs": tally.abstained,
        "footage_s": round(tally.footage_s, 3),
        "alarms": tally.alarms,
        "alarms_per_hour": round(tally.alarms / hours, 2) if hours > 0 else None,
        "faults": {} if status is None else status["faults"],
    }


def _followed(core: ServiceCore, request: Request, stream_id: str | None) -> Response:
    _require_memory(core)
    if stream_id is not None and stream_id != UPLOADS:
        require_stream_id(stream_id)  # one that has not begun yet is waited for
    core.gate.require_open()
    memory = core.live
    after = resume_after(request, memory.newest_number)
    memory.enter()
    events = pair_events(memory, core.gate, after=after, stream_id=stream_id)
    return LiveResponse(events, leave=memory.leave)


async def _inspected(core: ServiceCore, body: RequestBody, remembered: RememberedPair) -> bytes:
    settings = core.settings
    async with core.gate.admitted(looking_on=True):
        data = await body.read(max_bytes=MAX_TUNE_BYTES, timeout_s=settings.body_timeout_s)
        return await _in_turn(core, body, InspectionWork(remembered, data, settings))


async def _uploaded(core: ServiceCore, request: Request, body: RequestBody) -> bytes:
    settings, models = core.settings, core.models.require()
    content_type, clock = accepted_content_type(request), StageClock(core.metrics)
    async with core.gate.admitted(looking_on=True):
        upload = body.read(max_bytes=settings.max_body_bytes, timeout_s=settings.body_timeout_s)
        with clock.told_to(request.scope):
            data = await clock.awaited("upload", upload)
            work = UploadWork(models, data, content_type, settings=settings, metrics=core.metrics, clock=clock)
            del data  # the work alone holds it
            members, judged = await _in_turn(core, body, work)
    remembered = core.live.remember(UPLOADS, "", judged)
    core.live.ended(UPLOADS)  # its model may have been let go meanwhile
    return json_object({"stream_id": f'"{UPLOADS}"', "number": str(remembered.number), **members})


async def _in_turn(core: ServiceCore, body: RequestBody, work: Callable[[Job[Result]], Result]) -> Result:
    """The work's result, unless the client goes first or no worker comes in time."""
    turn = core.gate.in_turn(core.pool, work, patience_s=core.settings.queue_timeout_s)
    return await body.while_connected(turn)
