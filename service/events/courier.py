"""Tells a sink of every event, in order, at least once; what it does not take is given up after many attempts."""

from __future__ import annotations

import asyncio
import logging
import random
import time
from contextlib import AbstractAsyncContextManager
from functools import partial
from typing import Final, Protocol

from viflow_anomaly_service.events.delivery_store import Delivery, DeliveryState, DeliveryStore
from viflow_anomaly_service.events.event_record import EventRecord
from viflow_anomaly_service.events.log import EventLog
from viflow_anomaly_service.events.metrics import EventMetrics
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.store.keeper import ResultKeeper
from viflow_anomaly_service.store.record import stored_at_ns

logger = logging.getLogger(__name__)

HOLD_SECONDS: Final = 20.0
"""For which a process keeps a sink to itself."""
RENEW_SECONDS: Final = 5.0
ATTEMPT_SECONDS: Final = 10.0
"""For one answer of a sink."""
SEND_SECONDS: Final = 12.0
"""For all that an event needs; ``HOLD_SECONDS - RENEW_SECONDS`` leaves some to note what came of it."""
LOOK_SECONDS: Final = 2.0
"""How soon what others have changed is seen: a dead letter that is to be sent again, a sink that is free."""
SETTLE_SECONDS: Final = 0.05
FIRST_WAIT_SECONDS: Final = 1.0
LONGEST_WAIT_SECONDS: Final = 300.0
READ_AT_ONCE: Final = 100


class DeliveryRefusedError(Exception):
    """The sink did not take an event: an attempt that counts. Its text tells the operator why, and holds no secret."""


class SinkUnreachableError(Exception):
    """There is no connection to the sink, or no longer."""


class Session(Protocol):
    """A sink that can be told things now."""

    @property
    def broken(self) -> asyncio.Event:
        """Set when the connection is no more."""

    async def send(self, event: EventRecord) -> None:
        """Once this returns the sink has the event.

        Raises:
            DeliveryRefusedError: it has not.
            SinkUnreachableError: the session is over.
        """


class Sink(Protocol):
    """Somebody who is told of events."""

    @property
    def name(self) -> str: ...

    def session(self) -> AbstractAsyncContextManager[Session]:
        """Connect.

        Raises:
            SinkUnreachableError: that is not possible now.
        """


class Courier:
    """Delivers to one sink, while no other process does.

    Args:
        sink: who is told.
        deliveries: what waits.
        log: rings when events come.
        keeper: runs what blocks.
        metrics: told of every attempt.
        attempts: after which an event is given up.
        chance: of the waits between attempts.
    """

    def __init__(
        self,
        sink: Sink,
        *,
        deliveries: DeliveryStore,
        log: EventLog,
        keeper: ResultKeeper,
        metrics: EventMetrics,
        attempts: int,
        chance: random.Random,
    ) -> None:
        self._sink = sink
        self._deliveries = deliveries
        self._log = log
        self._keeper = keeper
        self._metrics = metrics
        self._attempts = attempts
        self._chance = chance
        self._held_until = 0.0

    async def run(self) -> None:
        """For ever; whatever fails is tried again."""
        failures = 0
        while True:
            wait_s = LOOK_SECONDS
            try:
                if await self._hold():
                    async with self._sink.session() as session:
                        failures = 0
                        await self._deliver(session)
            except SinkUnreachableError as err:
                failures += 1
                wait_s = min(self._wait_s(failures), 10 * LOOK_SECONDS)
                self._metrics.deliveries.labels(self._sink.name, "unreachable").inc()
                logger.warning("event_sink_unreachable", extra={"sink": self._sink.name, "cause": str(err)[:200]})
            except Problem as problem:
                logger.debug("event_courier_waits", extra={"sink": self._sink.name, "code": problem.code})
            except Exception:  # a fault of ours, which must not end the courier
                logger.exception("event_courier_failed", extra={"sink": self._sink.name})
            await asyncio.sleep(wait_s)

    async def settle(self) -> None:
        """Until nothing waits for the sink any more, or another process is the one that delivers.

        Raises:
            Problem: 503 ``store_...``.
        """
        while time.monotonic() < self._held_until:
            backlog = await self._keeper.read(partial(self._deliveries.backlog, self._sink.name))
            if not backlog.pending:
                return
            await asyncio.sleep(SETTLE_SECONDS)

    async def release(self) -> None:
        """Let another process go on at once, after ``run`` was cancelled."""
        if time.monotonic() < self._held_until:
            await self._keeper.change(partial(self._deliveries.release, self._sink.name))

    async def _hold(self) -> bool:
        """Whether there is time for an attempt in which no other process makes one."""
        if time.monotonic() > self._held_until - HOLD_SECONDS + RENEW_SECONDS:
            asked = time.monotonic()
            held = await self._keeper.change(partial(self._deliveries.hold, self._sink.name, HOLD_SECONDS))
            self._held_until = asked + HOLD_SECONDS if held else 0.0
        return time.monotonic() + SEND_SECONDS < self._held_until

    async def _deliver(self, session: Session) -> None:
        """While the session lasts and this process is the one that delivers."""
        while not session.broken.is_set() and await self._hold():
            changed = self._log.changed
            waiting = await self._keeper.read(partial(self._deliveries.pending, self._sink.name, READ_AT_ONCE))
            await self._observe()
            due_s = LOOK_SECONDS
            for delivery in waiting:
                due_s = _due_s(delivery)
                if due_s > 0 or session.broken.is_set() or not await self._hold():
                    break
                if not await self._attempt(session, delivery):
                    break
            else:
                due_s = 0.0 if waiting else LOOK_SECONDS
            if due_s > 0:
                await _first(changed, session.broken, timeout_s=min(due_s, LOOK_SECONDS))

    async def _attempt(self, session: Session, delivery: Delivery) -> bool:
        """Tell the sink once, and note what came of it; whether the next event's turn has come."""
        attempts, state, error, wait_s = delivery.attempts + 1, _DELIVERED, None, 0.0
        try:
            await _sent(session, delivery.event)
        except (DeliveryRefusedError, SinkUnreachableError) as err:
            # A connection that ends with an event on its way may end because of it: a broker's answer to what is too
            # large, say. It counts, or that event would hold up all others for ever.
            state, error, wait_s = "pending", str(err), self._wait_s(attempts)
            if attempts >= self._attempts:
                state = "dead"
        if state == "dead":
            logger.error("event_delivery_dead", extra={"sink": self._sink.name, "event_id": delivery.event.event_id})
        self._metrics.deliveries.labels(self._sink.name, "refused" if state == "pending" else state).inc()
        note = partial(
            self._deliveries.note,
            delivery,
            state,
            attempts=attempts,
            next_attempt_ns=time.time_ns() + round(wait_s * 1e9),
            error=error,
        )
        await self._keeper.change(note)
        return state != "pending"

    async def _observe(self) -> None:
        backlog = await self._keeper.read(partial(self._deliveries.backlog, self._sink.name))
        name = self._sink.name
        self._metrics.pending.labels(name).set(backlog.pending)
        self._metrics.dead.labels(name).set(backlog.dead)
        oldest = backlog.oldest_event_id
        age_s = 0.0 if oldest is None else (time.time_ns() - stored_at_ns(oldest)) / 1e9
        self._metrics.oldest_s.labels(name).set(max(age_s, 0.0))

    def _wait_s(self, attempts: int) -> float:
        """Twice as long each time, and never the same for all."""
        longest = min(LONGEST_WAIT_SECONDS, FIRST_WAIT_SECONDS * 2.0 ** min(attempts - 1, 16))
        return longest * self._chance.uniform(0.5, 1.0)


_DELIVERED: DeliveryState = "delivered"


async def _sent(session: Session, event: EventRecord) -> None:
    """As ``Session.send``, but never for longer than the sink is held."""
    try:
        async with asyncio.timeout(SEND_SECONDS):
            await session.send(event)
    except TimeoutError:
        raise DeliveryRefusedError(f"not taken within {SEND_SECONDS:g} s") from None


def _due_s(delivery: Delivery) -> float:
    """Seconds until the next attempt; what waits longer than anything may was noted by a clock that was ahead."""
    due_s = (delivery.next_attempt_ns - time.time_ns()) / 1e9
    return due_s if due_s <= LONGEST_WAIT_SECONDS else 0.0


async def _first(*events: asyncio.Event, timeout_s: float) -> None:
    """Until one of the events is set, or the time is over."""
    waits = [asyncio.ensure_future(one.wait()) for one in events]
    try:
        await asyncio.wait(waits, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for one in waits:
            one.cancel()
