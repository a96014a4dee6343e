"""Detections in a database. Every call blocks, and belongs into a thread; every one is a transaction of its own."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from viflow_anomaly_service.paging import Page
from viflow_anomaly_service.store.engine import UNTIL, make_engine, migrate, store_url
from viflow_anomaly_service.store.failures import store_error, store_failures
from viflow_anomaly_service.store.query import DetectionFilter
from viflow_anomaly_service.store.record import Record, StoredDetection, first_id_at
from viflow_anomaly_service.store.tables import DETECTIONS, EVENTS, LABELS, PROBE, THUMBNAILS

logger = logging.getLogger(__name__)

PAGE_BYTES: Final = 8 * 1024 * 1024
DELETED_AT_ONCE: Final = 500
_VACUUMED_PAGES: Final = 1000
_PROBE_PADDING: Final = 4096
_READ: Final = (DETECTIONS.c.id, DETECTIONS.c.stream_id, DETECTIONS.c.session_id, DETECTIONS.c.body)


class DetectionStore:
    """One database; opened by ``open``, and again after its file was taken away.

    Args:
        url: see ``store_url``.

    Raises:
        ConfigError: ``store_url_invalid``.
    """

    def __init__(self, url: str) -> None:
        self._url = store_url(url)
        self._engine = make_engine(self._url)
        self._opening = threading.Lock()
        self._file: tuple[int, int] | None = None

    @property
    def place(self) -> str:
        """For the log: the URL without its password."""
        return self._url.render_as_string(hide_password=True)

    def open(self) -> None:
        """Make the tables, or bring them up to date; cheap where nothing is to be done.

        Raises:
            StoreError: as all calls here: see ``failures``.
        """
        with self._opening, store_failures():
            if self._engine.dialect.name == "sqlite" and (self._file is None or self._found_file() != self._file):
                self._engine.dispose()  # connections to a file that was deleted go on writing to it, for nobody
                if self._file is not None:
                    logger.error("store_file_replaced", extra={"store": self.place})
                self._file = None
                self._require_writable_folder()
                migrate(self._engine)
                self._file = self._found_file()
            elif self._file is None:
                migrate(self._engine)
                self._file = (0, 0)

    def close(self) -> None:
        self._engine.dispose()

    def add(self, records: Sequence[Record], along: Sequence[Callable[[Connection], object]] = ()) -> None:
        """All of them, or none; when this returns they are on the disk.

        Args:
            along: called in the same transaction, behind the detections.
        """
        rows = [
            {
                "id": record.id,
                "stream_id": record.stream_id,
                "session_id": record.session_id,
                "source_timestamp_ns": record.source_timestamp_ns,
                "target_timestamp_ns": record.target_timestamp_ns,
                "size_bytes": record.size_bytes,
                "body": record.body,
            }
            for record in records
        ]
        labels = [
            {"detection_id": record.id, "label": label, "top_score": score}
            for record in records
            for label, score in record.top_scores.items()
        ]
        thumbnails = [
            {"detection_id": record.id, "size_bytes": len(record.thumbnail), "image": record.thumbnail}
            for record in records
            if record.thumbnail is not None
        ]
        self.open()
        with self.transaction(writes=True) as connection:
            if rows:
                connection.execute(sa.insert(DETECTIONS), rows)
            if labels:
                connection.execute(sa.insert(LABELS), labels)
            if thumbnails:
                connection.execute(sa.insert(THUMBNAILS), thumbnails)
            for action in along:
                action(connection)

    @contextlib.contextmanager
    def transaction(self, *, writes: bool = False) -> Iterator[Connection]:
        """Committed when the block ends well.

        Raises:
            StoreError: whatever the database says against it.
        """
        with store_failures(), self._engine.execution_options(writes=writes).begin() as connection:
            yield connection

    def probe(self) -> None:
        """Write something, to see whether that works."""
        self.open()
        padding = f"{time.time_ns():020d}".ljust(_PROBE_PADDING, ".")
        with self.transaction(writes=True) as connection:
            if not connection.execute(sa.update(PROBE).where(PROBE.c.id == 1).values(padding=padding)).rowcount:
                connection.execute(sa.insert(PROBE).values(id=1, padding=padding))

    def get(self, detection_id: str) -> StoredDetection | None:
        with self.transaction() as connection:
            row = connection.execute(sa.select(*_READ).where(DETECTIONS.c.id == detection_id)).one_or_none()
        return None if row is None else StoredDetection(*row)

    def thumbnail(self, detection_id: str) -> bytes | None:
        """The image file that is kept beside a detection."""
        found = sa.select(THUMBNAILS.c.image).where(THUMBNAILS.c.detection_id == detection_id)
        with self.transaction() as connection:
            image: bytes | None = connection.execute(found).scalar_one_or_none()
        return image

    def page(self, request: Page[DetectionFilter]) -> tuple[list[StoredDetection], bool]:
        """The detections of a page, and whether there are more; fewer than its limit where their JSON is large."""
        falling = request.filter.order == "desc"
        by = DETECTIONS.c.id.desc() if falling else DETECTIONS.c.id.asc()
        found = sa.select(DETECTIONS.c.id, DETECTIONS.c.size_bytes).where(*_conditions(request.filter))
        if request.after is not None:
            found = found.where(DETECTIONS.c.id < request.after if falling else DETECTIONS.c.id > request.after)
        with self.transaction() as connection:
            sized = connection.execute(found.order_by(by).limit(request.limit + 1)).all()
            ids = _fitting([(row.id, row.size_bytes) for row in sized[: request.limit]])
            rows = connection.execute(sa.select(*_READ).where(DETECTIONS.c.id.in_(ids)).order_by(by)).all()
        return [StoredDetection(*row) for row in rows], len(ids) < len(sized)

    def prune(self, *, max_age_s: float | None, max_bytes: int | None, thumbnail_max_bytes: int | None = None) -> int:
        """Delete what is too old, then the oldest of what is too much; the number of detections that are gone.

        Thumbnails that are too much go alone: their detections stay.

        In many short transactions, so that nobody who stores waits for long.
        """
        self.open()
        deleted = 0
        too_old = None if max_age_s is None else first_id_at(time.time_ns() - round(max_age_s * 1e9))
        too_much = None if max_bytes is None else self._first_kept(DETECTIONS.c.id, DETECTIONS.c.size_bytes, max_bytes)
        for first_kept in (too_old, too_much):
            deleted += self._delete_before(DETECTIONS.c.id, first_kept)
            self._delete_before(EVENTS.c.event_id, first_kept)  # of their time; deliveries go with their events
        thumbnails = 0
        if thumbnail_max_bytes is not None:
            column = THUMBNAILS.c.detection_id
            thumbnails = self._delete_before(
                column, self._first_kept(column, THUMBNAILS.c.size_bytes, thumbnail_max_bytes)
            )
        if (deleted or thumbnails) and self._engine.dialect.name == "sqlite":
            with store_failures(), contextlib.closing(self._engine.raw_connection()) as connection:
                connection.info.pop(UNTIL, None)
                # executescript runs it to its end; execute would free one page
                connection.cursor().executescript(f"PRAGMA incremental_vacuum({_VACUUMED_PAGES})")
        return deleted

    def _first_kept(self, ids: sa.Column[Any], size: sa.Column[Any], max_bytes: int) -> str | None:
        """The id before which all is too much; None: nothing is."""
        total_so_far = sa.func.sum(size).over(order_by=ids.desc()).label("total")
        running = sa.select(ids.label("id"), total_so_far).subquery()
        kept = sa.select(sa.func.min(running.c.id)).where(running.c.total <= max_bytes)
        with self.transaction() as connection:
            total = connection.execute(sa.select(sa.func.sum(size))).scalar_one() or 0
            if total <= max_bytes:
                return None
            first: str | None = connection.execute(kept).scalar_one()
        return first_id_at(time.time_ns()) if first is None else first

    def _delete_before(self, ids: sa.Column[Any], first_kept: str | None) -> int:
        deleted = 0
        while first_kept is not None:
            old = sa.select(ids).where(ids < first_kept).order_by(ids)
            old = old.limit(DELETED_AT_ONCE).with_for_update(skip_locked=True)  # another replica deletes the rest
            with self.transaction(writes=True) as connection:
                found = list(connection.execute(old).scalars())
                connection.execute(sa.delete(ids.table).where(ids.in_(found)))
            deleted += len(found)
            if len(found) < DELETED_AT_ONCE:
                break
        return deleted

    def _require_writable_folder(self) -> None:
        """SQLite itself would say no more than that it cannot open its file."""
        folder = Path(str(self._url.database)).absolute().parent
        if folder.is_dir() and not os.access(folder, os.W_OK):
            raise store_error("store_read_only")

    def _found_file(self) -> tuple[int, int] | None:
        """Which file there is under the name; None where there is none."""
        try:
            status = os.stat(str(self._url.database))  # noqa: PTH116 - no Path is at hand
        except FileNotFoundError:
            return None
        return status.st_dev, status.st_ino


def _conditions(chosen: DetectionFilter) -> list[Any]:
    conditions: list[Any] = []
    if chosen.stream is not None:
        conditions.append(DETECTIONS.c.stream_id == chosen.stream)
    if chosen.from_ns is not None:
        conditions.append(DETECTIONS.c.source_timestamp_ns >= chosen.from_ns)
    if chosen.to_ns is not None:
        conditions.append(DETECTIONS.c.source_timestamp_ns < chosen.to_ns)
    if chosen.label is not None or chosen.min_score is not None:
        region = sa.select(LABELS.c.label).where(LABELS.c.detection_id == DETECTIONS.c.id)
        if chosen.label is not None:
            region = region.where(LABELS.c.label == chosen.label)
        if chosen.min_score is not None:
            region = region.where(LABELS.c.top_score >= chosen.min_score)
        conditions.append(region.exists())
    return conditions


def _fitting(sized: list[tuple[str, int]]) -> list[str]:
    """The first ids whose JSON stays within a page; one at least, where there is one."""
    ids: list[str] = []
    total = 0
    for one, size in sized:
        total += size
        if ids and total > PAGE_BYTES:
            break
        ids.append(one)
    return ids
