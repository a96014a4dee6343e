"""Events that no living process will end: each process says that it lives, and ends those of the dead."""

from __future__ import annotations

import asyncio
import logging
from typing import Final

from viflow_anomaly_service.events.event_store import EventStore
from viflow_anomaly_service.events.metrics import EventMetrics
from viflow_anomaly_service.events.store_log import StoreLog
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.store.keeper import ResultKeeper

logger = logging.getLogger(__name__)

HOLD_SECONDS: Final = 30.0
"""After which a process that says nothing is taken for dead."""
BEAT_SECONDS: Final = 5.0


async def watch_abandoned(events: EventStore, log: StoreLog, keeper: ResultKeeper, metrics: EventMetrics) -> None:
    """For ever; a store that fails meanwhile is asked again."""
    while True:
        try:
            if await keeper.read(events.holds_some):
                await keeper.change(events.hold_open)
            if await keeper.read(events.has_abandoned):
                ended = await keeper.change(events.end_abandoned)
                metrics.events.labels("end").inc(ended)
                logger.warning("events_of_dead_process_ended", extra={"count": ended})
                await log.look()
        except Problem as problem:
            logger.debug("events_not_watched", extra={"code": problem.code})
        except Exception:  # a fault of ours, which must not end the watch
            logger.exception("events_not_watched")
        await asyncio.sleep(BEAT_SECONDS)
