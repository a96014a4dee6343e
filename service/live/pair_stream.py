"""New pairs as server-sent events: resumed by number, kept alive by comments, ended with the service."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from typing import Final

from fastapi import Request

from viflow_anomaly_service.admission import AdmissionGate
from viflow_anomaly_service.live.pair_memory import PairMemory
from viflow_anomaly_service.problems import Problem

LOOK_SECONDS: Final = 0.5
"""How soon an ending service lets its followers go."""
BEATS_BETWEEN: Final = 20
"""Looks without an event before a comment tells both ends that the connection lives."""
HELLO: Final = b"retry: 1000\n: following\n\n"


def resume_after(request: Request, newest: int) -> int:
    """The number a client has last seen: header ``Last-Event-ID``, or parameter ``after``; else the newest.

    An empty header is none: so the standard of server-sent events says that nothing was seen yet.
    One that is still to come is of a process whose clock was ahead: such a client is told everything.

    Raises:
        Problem: 422 ``parameter_unknown``, ``parameter_invalid``.
    """
    for name in request.query_params:
        if name != "after":
            raise Problem(422, code="parameter_unknown", detail=f"expected after, found {name!r:.80}", field=name[:80])
    place, text = "Last-Event-ID", request.headers.get("last-event-id")
    if not text:
        place, text = "after", request.query_params.get("after")
    if text is None:
        return newest
    if not (text.isascii() and text.isdecimal() and len(text) <= 20):
        detail = f"{place}: expected the number of a pair, found {text!r:.40}"
        raise Problem(422, code="parameter_invalid", detail=detail, field=place)
    return int(text) if int(text) <= newest else 0


async def pair_events(
    memory: PairMemory, gate: AdmissionGate, *, after: int, stream_id: str | None
) -> AsyncGenerator[bytes, None]:
    """Events from a number on, until the client goes or the service ends."""
    yield HELLO
    silent = 0
    while not gate.closed:
        found, after = memory.numbers_after(after, stream_id), memory.newest_number
        for number in found:
            if event := _event(memory, number):
                yield event
                await asyncio.sleep(0)
        silent = 0 if found else silent + 1
        if silent >= BEATS_BETWEEN:
            silent = 0
            yield b": alive\n\n"
        if memory.newest_number == after:
            await memory.wait(LOOK_SECONDS)


def _event(memory: PairMemory, number: int) -> bytes:
    """Nothing of a pair that has gone since; apart, because who yields would hold its images while the client reads."""
    one = memory.find(number)
    return b"" if one is None else f"id: {number}\nevent: pair\ndata: {one.to_json()}\n\n".encode()
