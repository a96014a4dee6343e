"""Events as they come, over Server-Sent Events: each reader goes through the log at its own pace."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncGenerator, AsyncIterator
from typing import Final

from viflow_anomaly_service.events.event_record import EventRecord
from viflow_anomaly_service.events.log import EventLog, LoggedEvent, Place
from viflow_anomaly_service.events.metrics import EventMetrics
from viflow_anomaly_service.problems import Problem

HEARTBEAT_SECONDS: Final = 15.0
READ_AT_ONCE: Final = 100
RECONNECT_MS: Final = 2000
HEARTBEAT: Final = b": \n\n"


class LiveReaders:
    """Bounds who reads.

    A reader holds no queue: it is read for from the log whenever its connection has taken what was sent, and whoever
    takes nothing for longer than a request may last is closed, and goes on later from the last id.

    Args:
        log: what is read.
        limit: readers at once.
        closing: set when the service stops: all streams end then, and none begins.
        metrics: told of them.
    """

    def __init__(self, log: EventLog, *, limit: int, closing: asyncio.Event, metrics: EventMetrics) -> None:
        self._log = log
        self._limit = limit
        self._metrics = metrics
        self._closing = closing
        self.present = 0

    async def begin(self, last_event_id: str | None) -> Place:
        """Where a reader begins, who holds a place until ``leave``.

        Raises:
            Problem: 503 ``shutting_down``, ``event_readers_full``, ``store_...``.
        """
        if self._closing.is_set():
            raise Problem(503, code="shutting_down", detail="The service is being shut down.", retry_after_s=1)
        if self.present >= self._limit:
            detail = f"expected at most {self._limit} readers of events at once, found one more"
            raise Problem(503, code="event_readers_full", detail=detail, retry_after_s=5)
        self.present += 1
        self._metrics.readers.inc()
        try:
            if last_event_id is None:
                return Place(await self._log.newest(), gap=False)
            return await self._log.place_of(last_event_id)
        except BaseException:
            self.leave()
            raise

    def leave(self) -> None:
        """A reader that has begun is gone."""
        self.present -= 1
        self._metrics.readers.dec()

    async def read(self, place: Place, stream_id: str | None) -> AsyncGenerator[bytes, None]:
        """The stream's bytes from a place on, until the service stops or the log fails."""
        yield f"retry: {RECONNECT_MS}\n\n".encode()
        if place.gap:
            yield _gap()
        with contextlib.suppress(Problem):  # the store fails: the reader comes back and is told why
            async for part in self._parts(place.seq, stream_id):
                yield part

    async def _parts(self, seq: int, stream_id: str | None) -> AsyncIterator[bytes]:
        while not self._closing.is_set():
            changed = self._log.changed
            found = await self._log.after(seq, READ_AT_ONCE)
            if found is None:
                seq = await self._oldest()
                yield _gap()
            elif found:
                seq = found[-1].seq
                if wanted := [one for one in found if stream_id in (None, one.event.stream_id)]:
                    yield b"".join(_message(one) for one in wanted)
            elif not await self._woken(changed):
                yield HEARTBEAT

    async def _oldest(self) -> int:
        """The place ahead of the oldest event that is still there."""
        return (await self._log.place_of("")).seq

    async def _woken(self, changed: asyncio.Event) -> bool:
        """Whether there is something to look at; False: it is time for a sign of life."""
        waits = [asyncio.ensure_future(one.wait()) for one in (changed, self._closing)]
        try:
            done, _ = await asyncio.wait(waits, timeout=HEARTBEAT_SECONDS, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for one in waits:
                one.cancel()
        return bool(done)


def _message(logged: LoggedEvent) -> bytes:
    event: EventRecord = logged.event
    return f"id: {event.event_id}\nevent: {event.kind}\ndata: {event.body}\n\n".encode()


def _gap() -> bytes:
    """Said where events may be missing; without an id, so that the reader's place stays where it was."""
    return f"event: gap\ndata: {json.dumps({'reason': 'not_kept'})}\n\n".encode()
