"""Between streams and the log of events: what detections come to, and the end of everything that has begun."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Final

from viflow_anomaly.detection import Detection
from viflow_anomaly_service.events.event_record import EventRecord, record_of
from viflow_anomaly_service.events.event_rules import EndReason, EventRules, EventState, TrackEvent, end_all, step
from viflow_anomaly_service.events.log import EventLog
from viflow_anomaly_service.events.metrics import EventMetrics
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.store.record import IdMaker

if TYPE_CHECKING:
    from sqlalchemy.engine import Connection

    from viflow_anomaly_service.streams.table import LiveStream

logger = logging.getLogger(__name__)

RETRY_SECONDS: Final = 1.0


@dataclass
class Noticed:
    """What the detections of one call come to; nothing has happened yet.

    Attributes:
        told: the events, each with the place of its detection among those of the call.
        records: the same, once it is known under which ids the detections are kept.
        written: those of them that the commit of the detections wrote; None: nothing was written with them.
    """

    stream: LiveStream
    state: EventState
    told: list[tuple[int, TrackEvent]]
    held_back: int
    log: EventLog
    new_id: IdMaker
    records: list[EventRecord] = field(default_factory=list)
    written: Sequence[EventRecord] | None = None

    def kept_along(self, detection_ids: list[str]) -> Callable[[Connection], object] | None:
        """What ``ResultKeeper.keep`` is to keep with the detections."""
        self.name(detection_ids)
        write = self.log.part_of_commit(self.records)
        return None if write is None else partial(self._write, write)

    def _write(self, write: Callable[[Connection], Sequence[EventRecord]], connection: Connection) -> None:
        self.written = write(connection)

    def name(self, detection_ids: Sequence[str] | None) -> None:
        """Make the records; None: the detections are kept nowhere."""
        self.records = [
            record_of(
                event,
                event_id=self.new_id(),
                stream_id=self.stream.stream_id,
                session_id=self.stream.session_id,
                detection_id=None if detection_ids is None else detection_ids[place],
            )
            for place, event in self.told
        ]


class EventDesk:
    """Makes events of the detections of streams, and sees to it that each that begins also ends.

    Args:
        rules: when events begin and end.
        log: where they are kept.
        metrics: told of them.
    """

    def __init__(self, rules: EventRules, log: EventLog, metrics: EventMetrics) -> None:
        self._rules = rules
        self._log = log
        self._metrics = metrics
        self._new_id = IdMaker()
        self._ends: deque[tuple[Noticed, EndReason]] = deque()
        self._some_end = asyncio.Event()

    @property
    def log(self) -> EventLog:
        return self._log

    def notice(self, stream: LiveStream, detections: Sequence[Detection]) -> Noticed:
        """What the detections of a call, in time order, come to."""
        state, told, held_back = stream.events, [], 0
        for place, detection in enumerate(detections):
            state, events, held = step(self._rules, state, detection)
            told += [(place, event) for event in events]
            held_back += held
        return Noticed(stream, state, told, held_back, self._log, self._new_id)

    def took(self, noticed: Noticed) -> None:
        """The detections are kept, where there is a store: what was noticed is so from now on."""
        stream = noticed.stream
        if len(noticed.records) != len(noticed.told):
            noticed.name(None)
        stream.events = noticed.state
        self._metrics.held_back.inc(noticed.held_back)
        self._metrics.count(self._log.took(noticed.records if noticed.written is None else noticed.written))
        if stream.gone:  # it was forgotten while the call was at work
            self.end(stream, "stream_deleted")

    def end(self, stream: LiveStream, reason: EndReason) -> None:
        """A stream is no more: what is open in it ends, as soon as that can be kept."""
        told = [(0, event) for event in end_all(stream.events, reason)]
        stream.events = EventState()
        if stream.begun is None:
            return  # nothing was begun
        ending = Noticed(stream, stream.events, told, 0, self._log, self._new_id)
        ending.name(None)
        self._ends.append((ending, reason))
        self._some_end.set()

    async def watch(self) -> None:
        """Keep the ends of streams that were forgotten, however often that takes."""
        while True:
            await self._some_end.wait()
            self._some_end.clear()
            while self._ends:
                try:
                    await self._keep_end()
                except Problem as problem:
                    logger.warning("event_ends_wait", extra={"code": problem.code})
                    await asyncio.sleep(RETRY_SECONDS)
                except Exception:  # a fault of ours: the next process ends these, once this one is no more
                    logger.exception("event_ends_failed")
                    self._ends.popleft()

    async def close(self, streams: Sequence[LiveStream], *, until: float) -> None:
        """The service stops: once no call is at work, and ``watch`` has ended.

        Args:
            until: in the event loop's time; what is not kept then is ended by the next process.
        """
        for stream in streams:
            self.end(stream, "service_stopped")
        try:
            async with asyncio.timeout_at(until):
                while self._ends:
                    await self._keep_end()
        except (Problem, TimeoutError):
            logger.warning("event_ends_left", extra={"streams": len(self._ends)})
        except Exception:  # a fault of ours, which must not keep the rest from being closed
            logger.exception("event_ends_left")

    async def _keep_end(self) -> None:
        ending, reason = self._ends[0]
        self._metrics.count(await self._log.end(ending.stream.session_id, reason, ending.records))
        self._ends.popleft()
