"""One call of a stream, however it was sent: through gate, turn, worker and store to its answer."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from typing import Any

from viflow_anomaly_service.models.table import ModelSet
from viflow_anomaly_service.parameters import STREAM_ID
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.service_core import ServiceCore
from viflow_anomaly_service.stage_times import StageClock
from viflow_anomaly_service.streams.table import LiveStream
from viflow_anomaly_service.streams.work import JudgedCall, Reading, StreamWork


def require_one_process(core: ServiceCore) -> None:
    """Nothing, if all frames of a stream reach the same process.

    Raises:
        Problem: 501 ``streams_need_one_process``.
    """
    if core.settings.workers > 1:
        detail = f"expected a service of one process (VIFLOW_WORKERS=1), found {core.settings.workers}: a stream's "
        raise Problem(501, code="streams_need_one_process", detail=detail + "frames would reach different ones")


def require_callable(core: ServiceCore, stream_id: str) -> ModelSet:
    """The models for a call, if one can be taken at all.

    Raises:
        Problem: 422 ``stream_id_invalid``, 501, 503.
    """
    require_one_process(core)
    require_stream_id(stream_id)
    return core.require_judging()


def require_stream_id(stream_id: str) -> None:
    """Nothing, if a stream can have this name.

    Raises:
        Problem: 422 ``stream_id_invalid``.
    """
    if STREAM_ID.fullmatch(stream_id) is None:
        detail = f"stream_id: expected 1 to 64 of A-Z a-z 0-9 . _ -, found {stream_id!r:.80}"
        raise Problem(422, code="stream_id_invalid", detail=detail, field="stream_id")


async def answer_call(
    core: ServiceCore,
    stream_id: str,
    models: ModelSet,
    *,
    receive: Callable[[], Awaitable[Reading]],
    while_connected: Callable[[Coroutine[Any, Any, bytes]], Awaitable[bytes]],
    clock: StageClock,
) -> bytes:
    """The answer's bytes.

    Args:
        models: as ``require_callable`` gave them.
        receive: called once there is a place for what is sent.
        while_connected: awaits its argument, and raises if the client goes away.
        clock: of the call; its log is told what the call came to.

    Raises:
        Problem: the call is refused, or something is wrong with it; the stream then stays where it was.
        ClientDisconnect: nobody waits for the answer any more.
    """
    async with core.gate.admitted(), core.streams.turn(stream_id) as stream:
        reading = await receive()
        work = StreamWork(
            models,
            reading,
            known=stream.begun,
            state=stream.state,
            settings=core.settings,
            metrics=core.metrics,
            clock=clock,
        )
        del reading  # the work alone holds what was sent, and lets go of it once it is decoded
        return await while_connected(_judged_and_kept(core, stream, work, clock))


async def _judged_and_kept(core: ServiceCore, stream: LiveStream, work: StreamWork, clock: StageClock) -> bytes:
    """Cancelled before the call is judged, nothing has happened; after that it is finished, whoever has gone."""
    judged = await core.gate.in_turn(core.pool, work, patience_s=core.settings.queue_timeout_s)
    finishing = asyncio.ensure_future(_kept(core, stream, judged))
    try:
        if core.keeper is None:
            return await asyncio.shield(finishing)
        return await clock.awaited("store", asyncio.shield(finishing))
    except asyncio.CancelledError:
        with contextlib.suppress(Problem):
            await finishing
        raise


def _show(core: ServiceCore, stream: LiveStream, judged: JudgedCall, ids: Sequence[str] | None) -> None:
    """The pairs of a call to whoever looks on, unless the stream was deleted meanwhile."""
    if not core.live.enabled or not judged.pairs or stream.gone:
        return
    rig = judged.step.state.rig
    report = None if rig is None else rig.report(judged.begun.stream.config.rig_estimate)
    for place, pair in enumerate(judged.pairs):
        stored = None if ids is None else ids[place]
        core.live.remember(stream.stream_id, stream.session_id, pair, detection_id=stored, rig=report)


async def _kept(core: ServiceCore, stream: LiveStream, judged: JudgedCall) -> bytes:
    """The stream advances once its detections are on the disk: a call that was refused can be sent again."""
    step, received = judged.step, judged.received
    core.streams.require_room(stream, step.state)
    noticed = core.events.desk.notice(stream, step.detections)
    ids = None
    if core.keeper is not None:
        pairs = list(zip(step.detections, judged.bodies, strict=True))
        ids = await core.keeper.keep(
            pairs,
            stream_id=stream.stream_id,
            session_id=stream.session_id,
            along=noticed.kept_along,
            thumbnails=judged.thumbnails,
        )
    begun = stream.begun is None
    core.streams.advance(stream, judged.begun, step)
    core.events.desk.took(noticed)
    _show(core, stream, judged, ids)
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
