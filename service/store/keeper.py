"""Between the event loop and the store: commits in company, says whether it works, deletes what is too old."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator, Callable, Sequence
from functools import partial
from typing import Final, TypeVar

from prometheus_client import Counter, Gauge
from sqlalchemy.engine import Connection

from viflow_anomaly.detection import Detection
from viflow_anomaly_service.metrics import ServiceMetrics
from viflow_anomaly_service.paging import Page, cursor_of
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.store.age_clock import AgeClock, seconds_since_boot
from viflow_anomaly_service.store.detection_store import DetectionStore
from viflow_anomaly_service.store.failures import StoreError, store_error
from viflow_anomaly_service.store.query import DetectionFilter
from viflow_anomaly_service.store.record import IdMaker, Record, StoredDetection, record_of
from viflow_anomaly_service.store.store_threads import StoreThreads

logger = logging.getLogger(__name__)

Result = TypeVar("Result")
Along = Callable[[Connection], object]
"""What is kept in the transaction of some detections."""

COMMITTED_AT_ONCE: Final = 64
READERS: Final = 2
RETRY_SECONDS: Final = 1.0
RETRIES_A_PROBE: Final = 10
PRUNE_SECONDS: Final = 60.0
RETRY_AFTER_S: Final = 2


class StoreMetrics:
    """What Prometheus is told of a store."""

    def __init__(self, metrics: ServiceMetrics) -> None:
        registry = metrics.registry
        self.stored = Counter("viflow_stored_detections", "Detections that were committed", registry=registry)
        self.pruned = Counter("viflow_pruned_detections", "Stored detections that were deleted", registry=registry)
        self.failures = Counter("viflow_store_failures", "Failed calls of the store", ("code",), registry=registry)
        self.usable = Gauge(
            "viflow_store_usable_processes",
            "Processes that can write to the store",
            registry=registry,
            multiprocess_mode="livesum",
        )


class ResultKeeper:
    """Keeps detections in a store, and reads them back.

    One thread writes, all that waits then in one transaction; others read. A write that fails makes the keeper refuse
    until its watch has written something again, a second later at the earliest: without a restart, and without
    judging pairs whose detections could not stay.

    Args:
        store: where they are kept.
        settings: of the service; what is kept for how long.
        metrics: told of what is kept and what failed.
    """

    def __init__(self, store: DetectionStore, settings: ServiceSettings, metrics: ServiceMetrics) -> None:
        self._store = store
        self._settings = settings
        self._metrics = StoreMetrics(metrics)
        self._new_id = IdMaker()
        self._clock = AgeClock(time.time, seconds_since_boot)
        self._failure: StoreError | None = store_error("store_opening")
        self._waiting: list[tuple[list[Record], Along | None, asyncio.Future[None]]] = []
        self._committing: asyncio.Task[None] | None = None
        self._writer = StoreThreads(1, "store-write")
        self._readers = StoreThreads(READERS, "store-read")
        self._tasks: list[asyncio.Task[None]] = []

    @property
    def store(self) -> DetectionStore:
        """For parts that keep something beside the detections, by ``change`` and ``read``."""
        return self._store

    def start(self) -> None:
        """Open the store, and look after it; a store that cannot be opened is tried again later."""
        self._tasks = [asyncio.create_task(self._watch()), asyncio.create_task(self._prune_now_and_then())]

    async def close(self, *, within_s: float) -> None:
        """After the last request; a store that hangs for longer is left as it is, as if the process had been killed."""
        for task in self._tasks:
            task.cancel()
        try:
            async with asyncio.timeout(within_s):
                if self._committing is not None:
                    await self._committing
                await asyncio.get_running_loop().run_in_executor(self._writer, self._shut_down)
        except TimeoutError:
            logger.error("store_not_closed_in_time", extra={"store": self._store.place})  # noqa: TRY400 - says it all
        finally:
            self._writer.shutdown(wait=False, cancel_futures=True)

    def _shut_down(self) -> None:
        """The writer's last call, behind all others."""
        self._readers.shutdown(cancel_futures=True)
        self._store.close()

    def require_usable(self) -> None:
        """Nothing, if detections can be kept.

        Raises:
            Problem: 503 ``store_...``.
        """
        if self._failure is not None:
            raise store_problem(self._failure)

    async def keep(
        self,
        detections: list[tuple[Detection, str]],
        *,
        stream_id: str | None = None,
        session_id: str | None = None,
        along: Callable[[list[str]], Along | None] = lambda ids: None,
        thumbnails: Sequence[bytes | None] = (),
    ) -> list[str]:
        """The ids under which detections, each with its JSON, are kept; when this returns they are on the disk.

        Args:
            along: given the ids, what is kept with the detections, or not at all.
            thumbnails: one for each detection, or none at all.

        Raises:
            Problem: 503 ``store_...``: they were not kept, or nobody knows.
        """
        if not detections:
            return []
        self.require_usable()
        records = [
            record_of(detection, body, self._new_id(), stream_id=stream_id, session_id=session_id, thumbnail=thumbnail)
            for (detection, body), thumbnail in zip(detections, thumbnails or [None] * len(detections), strict=True)
        ]
        try:
            await self._committed(records, along([record.id for record in records]))
        except StoreError as err:
            raise store_problem(err) from err
        return [record.id for record in records]

    async def change(self, action: Callable[[], Result]) -> Result:
        """What ``action`` gives, which writes to the store's database.

        Raises:
            Problem: 503 ``store_...``: nothing was written, or nobody knows.
        """
        self.require_usable()
        results: list[Result] = []
        failure = await self._write(lambda: results.append(action()))
        if failure is not None:
            raise store_problem(failure) from failure
        return results[0]

    async def get(self, detection_id: str) -> StoredDetection | None:
        """A stored detection; None: there is none of this id (any more).

        Raises:
            Problem: 503 ``store_...``.
        """
        return await self.read(lambda: self._store.get(detection_id))

    async def thumbnail(self, detection_id: str) -> bytes | None:
        """The image file beside a detection; None: there is none (any more).

        Raises:
            Problem: 503 ``store_...``.
        """
        return await self.read(lambda: self._store.thumbnail(detection_id))

    async def page(self, request: Page[DetectionFilter]) -> tuple[list[StoredDetection], str | None]:
        """Detections, and the cursor behind them where there are more.

        Raises:
            Problem: 503 ``store_...``.
        """
        found, more = await self.read(lambda: self._store.page(request))
        return found, cursor_of(request.filter, found[-1].id) if more and found else None

    async def export(self, chosen: DetectionFilter, first: list[StoredDetection], *, rows: int) -> AsyncIterator[bytes]:
        """Everything that passes the filter, a line each, some at a time.

        Args:
            first: what ``page`` gave, so that a store that does not answer is a problem and no broken answer.
            rows: read at once.
        """
        found = first
        while found:
            yield "".join(f"{one.to_json()}\n" for one in found).encode()
            found, _ = await self.page(Page(chosen, rows, found[-1].id))

    async def _committed(self, records: list[Record], along: Along | None) -> None:
        """Once all of them are on the disk; else none is."""
        done: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.append((records, along, done))
        if self._committing is None or self._committing.done():
            self._committing = asyncio.create_task(self._commit())
        await done

    async def _commit(self) -> None:
        """Until nothing waits; what comes meanwhile goes together into the next transaction."""
        while self._waiting:
            batch, self._waiting = self._waiting[:COMMITTED_AT_ONCE], self._waiting[COMMITTED_AT_ONCE:]
            records = [record for together, _, _ in batch for record in together]
            along = [action for _, action, _ in batch if action is not None]
            failure: Exception | None
            try:
                failure = await self._write(partial(self._store.add, records, along))
            except Exception as err:  # a fault of ours: those who wait are told, those behind them are served
                failure = err
            for _, _, done in batch:
                if done.done():  # its client has gone
                    continue
                if failure is None:
                    done.set_result(None)
                else:
                    done.set_exception(failure)
            if failure is None:
                self._metrics.stored.inc(len(records))

    async def _write(self, action: Callable[[], object]) -> StoreError | None:
        """What was wrong with it, which is also what the keeper refuses with from now on."""
        failure: StoreError | None = None
        try:
            await asyncio.get_running_loop().run_in_executor(self._writer, action)
        except StoreError as err:
            failure = err
            self._count(err)
        if (failure and failure.code) != (self._failure and self._failure.code):
            event = "store_usable" if failure is None else "store_failed"
            level = logging.INFO if failure is None else logging.ERROR
            cause = None if failure is None else str(failure.__cause__)[:300]
            code = failure and failure.code
            logger.log(level, event, extra={"store": self._store.place, "code": code, "cause": cause})
        self._failure = failure
        self._metrics.usable.set(failure is None)
        return failure

    async def read(self, action: Callable[[], Result]) -> Result:
        """What ``action`` reads from the store's database.

        Raises:
            Problem: 503 ``store_...``.
        """
        if self._failure is not None and self._failure.code == "store_opening":
            raise store_problem(self._failure)
        try:
            return await asyncio.get_running_loop().run_in_executor(self._readers, action)
        except StoreError as err:
            self._count(err)
            raise store_problem(err) from err

    def _count(self, err: StoreError) -> None:
        self._metrics.failures.labels(err.code).inc()

    async def _watch(self) -> None:
        """Write now and then, so that a failure is known before a request meets it; often while there is one."""
        while True:
            try:
                await self._write(self._store.probe)
            except Exception:  # a fault of ours, which must not end the watch
                logger.exception("store_watch_failed")
            for _ in range(RETRIES_A_PROBE):
                await asyncio.sleep(RETRY_SECONDS)
                if self._failure is not None:
                    break

    async def _prune_now_and_then(self) -> None:
        age_s, size = self._settings.store_max_age_s, self._settings.store_max_bytes
        while True:
            if self._failure is None or self._failure.code == "store_full":
                by_age_s = age_s if self._clock.is_believed() else None
                try:
                    prune = partial(
                        self._store.prune,
                        max_age_s=by_age_s,
                        max_bytes=size,
                        thumbnail_max_bytes=self._settings.thumbnail_max_bytes,
                    )
                    deleted = await self.read(prune)
                except Problem as problem:
                    logger.warning("store_not_pruned", extra={"code": problem.code})
                except Exception:  # as above
                    logger.exception("store_not_pruned")
                else:
                    self._metrics.pruned.inc(deleted)
                    if deleted:
                        logger.info("store_pruned", extra={"detections": deleted})
            await asyncio.sleep(PRUNE_SECONDS)


def store_problem(err: StoreError) -> Problem:
    """503 with the code of what is wrong."""
    return Problem(503, code=err.code, detail=err.message, retry_after_s=RETRY_AFTER_S)
