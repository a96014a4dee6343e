"""The store itself, on SQLite and on PostgreSQL."""

from __future__ import annotations

import random
import sqlite3
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Barrier
from typing import Any

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from viflow_anomaly.errors import ConfigError
from viflow_anomaly_service.paging import Page
from viflow_anomaly_service.store import detection_store
from viflow_anomaly_service.store.detection_store import DetectionStore
from viflow_anomaly_service.store.engine import make_engine, migrate, store_url
from viflow_anomaly_service.store.failures import StoreError, store_failures
from viflow_anomaly_service.store.query import LABELS, DetectionFilter
from viflow_anomaly_service.store.record import ROW_BYTES, IdMaker, Record, stored_at_ns
from viflow_anomaly_service.store.tables import METADATA

NEW_ID = IdMaker()


@pytest.fixture
def store(empty_store_url: str) -> Iterator[DetectionStore]:
    opened = DetectionStore(empty_store_url)
    opened.open()
    yield opened
    opened.close()


def record(number: int = 0, *, body: str = '{"a":"Ä"}', **changes: object) -> Record:
    made = Record(NEW_ID(), number, number + 50, body, {"independent_motion": 0.5})
    return replace(made, **changes)  # type: ignore[arg-type]


def pages(store: DetectionStore, chosen: DetectionFilter, limit: int) -> list[list[str]]:
    found: list[list[str]] = []
    after, more = None, True
    while more:
        rows, more = store.page(Page(chosen, limit, after))
        found.append([row.id for row in rows])
        after = found[-1][-1] if found[-1] else None
    return found


def test_what_is_stored_is_read_again(store: DetectionStore) -> None:
    before_ns = time.time_ns()
    kept = record(stream_id="drone-7", session_id="s" * 32)
    store.add([kept, record()])
    found = store.get(kept.id)
    assert found is not None
    assert (found.id, found.stream_id, found.session_id, found.body) == (kept.id, "drone-7", "s" * 32, kept.body)
    assert stored_at_ns(kept.id) >= before_ns
    assert store.get("0" * 32) is None


def test_a_second_opening_changes_nothing(store: DetectionStore, empty_store_url: str) -> None:
    kept = record()
    store.add([kept])
    again = DetectionStore(empty_store_url)
    again.open()
    assert again.get(kept.id) is not None
    again.close()


def test_filters_and_paging_agree_with_plain_python(store: DetectionStore) -> None:
    chance = random.Random(4)  # noqa: S311
    records = []
    for _ in range(60):
        labels = chance.sample(LABELS, chance.randint(0, len(LABELS)))
        scores = {label: chance.choice([0.1, 0.5, 0.75]) for label in labels}
        stream = chance.choice([None, "a", "b"])
        records.append(record(chance.randint(-5, 5), top_scores=scores, stream_id=stream))
    store.add(records)
    for _ in range(60):
        chosen = DetectionFilter(
            stream=chance.choice([None, "a"]),
            from_ns=chance.choice([None, -3]),
            to_ns=chance.choice([None, 2]),
            label=chance.choice([None, *LABELS]),
            min_score=chance.choice([None, 0.5, 0.6]),
            order=chance.choice(["asc", "desc"]),
        )
        expected = [one.id for one in records if passes(one, chosen)]
        found = pages(store, chosen, chance.choice([1, 7, 100]))
        assert [one for page in found for one in page] == (expected if chosen.order == "asc" else expected[::-1]), (
            chosen
        )


def passes(one: Record, chosen: DetectionFilter) -> bool:
    scores = [score for label, score in one.top_scores.items() if chosen.label in (None, label)]
    return (
        chosen.stream in (None, one.stream_id)
        and (chosen.from_ns is None or one.source_timestamp_ns >= chosen.from_ns)
        and (chosen.to_ns is None or one.source_timestamp_ns < chosen.to_ns)
        and (chosen.label is None or bool(scores))
        and (chosen.min_score is None or max(scores, default=-1.0) >= chosen.min_score)
    )


def test_pages_are_stable_while_detections_come_and_go(store: DetectionStore) -> None:
    records = [record(number) for number in range(10)]
    store.add(records)
    first, more = store.page(Page(DetectionFilter(), 4))
    assert more
    store.add([record(99)])
    store.prune(max_age_s=None, max_bytes=6 * records[0].size_bytes)  # the six newest stay
    second, more = store.page(Page(DetectionFilter(), 4, first[-1].id))
    assert [row.id for row in (*first, *second)] == [one.id for one in records[:4:-1]]
    assert not more


def test_large_detections_make_smaller_pages(store: DetectionStore, monkeypatch: pytest.MonkeyPatch) -> None:
    records = [record(body="x" * 1000) for _ in range(5)]
    store.add(records)
    monkeypatch.setattr(detection_store, "PAGE_BYTES", 2 * (1000 + ROW_BYTES))
    found = pages(store, DetectionFilter(order="asc"), 5)
    assert found == [[one.id for one in records[k : k + 2]] for k in (0, 2, 4)]
    monkeypatch.setattr(detection_store, "PAGE_BYTES", 1)
    assert [len(ids) for ids in pages(store, DetectionFilter(), 5)] == [1] * 5


def test_old_detections_are_deleted_with_all_that_is_theirs(store: DetectionStore, empty_store_url: str) -> None:
    old_id = f"{time.time_ns() - 10**11:016x}" + "0" * 16
    old, new = record(id=old_id), record()
    store.add([old, new])
    assert store.prune(max_age_s=1000, max_bytes=None) == 0
    assert store.prune(max_age_s=50, max_bytes=None) == 1
    assert [row.id for row in store.page(Page(DetectionFilter()))[0]] == [new.id]
    engine = make_engine(store_url(empty_store_url))
    with engine.begin() as connection:
        assert connection.execute(sa.text("SELECT count(*) FROM detection_labels")).scalar_one() == 1
    engine.dispose()


def test_the_oldest_are_deleted_when_there_is_too_much(store: DetectionStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(detection_store, "DELETED_AT_ONCE", 3)
    records = [record(body="x" * 100) for _ in range(20)]
    store.add(records)
    limit = 7 * (100 + ROW_BYTES)
    assert store.prune(max_age_s=None, max_bytes=limit + 50) == 13
    assert store.prune(max_age_s=None, max_bytes=limit) == 0
    assert [row.id for row in store.page(Page(DetectionFilter(order="asc")))[0]] == [one.id for one in records[13:]]
    assert store.prune(max_age_s=None, max_bytes=1) == 7


def test_a_pruned_file_becomes_smaller(tmp_path: Path) -> None:
    path = tmp_path / "detections.db"
    store = DetectionStore(str(path))
    store.add([record(body="x" * 4000) for _ in range(500)])
    store.close()  # the journal goes into the file
    before = path.stat().st_size
    store.prune(max_age_s=None, max_bytes=100_000)
    store.close()
    assert path.stat().st_size < before / 2


def test_a_row_takes_about_what_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "detections.db"
    store = DetectionStore(str(path))
    records = [record(body="x" * 200, stream_id="drone-7", session_id="s" * 32) for _ in range(5000)]
    store.add(records)
    store.close()
    assert path.stat().st_size < 1.1 * sum(one.size_bytes for one in records)


def test_all_of_a_batch_is_stored_or_nothing(store: DetectionStore) -> None:
    kept, twice = record(), record()
    store.add([kept])
    with pytest.raises(StoreError):
        store.add([twice, replace(kept)])
    assert store.get(twice.id) is None


def test_the_migrations_make_the_tables_of_the_code(empty_store_url: str) -> None:
    engine = make_engine(store_url(empty_store_url))
    migrate(engine)
    with engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), METADATA) == []
    engine.dispose()


def test_many_open_an_empty_store_at_once(empty_store_url: str) -> None:
    stores = [DetectionStore(empty_store_url) for _ in range(4)]

    def open_and_add(one: DetectionStore) -> None:
        one.open()
        one.add([record()])

    with ThreadPoolExecutor(4) as threads:
        list(threads.map(open_and_add, stores))
    assert len(stores[0].page(Page(DetectionFilter()))[0]) == 4
    for one in stores:
        one.close()


def test_many_connect_to_a_new_file_at_once(tmp_path: Path) -> None:
    """SQLite refuses a second change to WAL at once, whatever its busy_timeout; a few in a hundred meet."""
    for attempt in range(20):
        engines = [make_engine(store_url(str(tmp_path / f"{attempt}.db"))) for _ in range(8)]
        together = Barrier(len(engines))

        def mode_of(engine: sa.Engine, together: Barrier = together) -> Any:
            together.wait()
            with engine.connect() as connection:
                return connection.execute(sa.text("PRAGMA journal_mode")).scalar_one()

        with ThreadPoolExecutor(len(engines)) as threads:
            assert list(threads.map(mode_of, engines)) == ["wal"] * len(engines)
        for engine in engines:
            engine.dispose()


def test_tables_of_a_later_version_are_left_alone(empty_store_url: str) -> None:
    engine = make_engine(store_url(empty_store_url))
    migrate(engine)
    with engine.execution_options(writes=True).begin() as connection:
        connection.execute(sa.text("UPDATE alembic_version SET version_num = '9999'"))
    engine.dispose()
    store = DetectionStore(empty_store_url)
    with pytest.raises(StoreError, match="later version") as caught:
        store.open()
    store.close()
    assert caught.value.code == "store_schema_unknown"


def test_a_file_that_was_taken_away_is_made_anew(tmp_path: Path) -> None:
    path = tmp_path / "detections.db"
    store = DetectionStore(str(path))
    store.add([record()])
    for one in tmp_path.iterdir():
        one.unlink()
    kept = record()
    store.add([kept])
    store.close()
    again = DetectionStore(str(path))
    assert again.get(kept.id) is not None
    again.close()


@pytest.mark.parametrize(
    ("statement", "code"),
    [("PRAGMA query_only=ON", "store_read_only"), ("PRAGMA max_page_count=1", "store_full")],
)
def test_what_sqlite_says_has_a_code(tmp_path: Path, statement: str, code: str) -> None:
    engine = make_engine(store_url(str(tmp_path / "x.db")))
    migrate(engine)
    with engine.connect() as connection:
        raw = connection.connection.cursor()
        raw.execute(statement)
        with pytest.raises(StoreError) as caught, store_failures():
            raw.execute("INSERT INTO store_probe VALUES (2, ?)", ("x" * 100_000,))
    assert caught.value.code == code
    engine.dispose()


def test_no_database_and_no_folder_have_codes(tmp_path: Path) -> None:
    (tmp_path / "x.db").write_bytes(b"this is text, and long enough not to be taken for an empty database" * 20)
    for path, code in ((tmp_path / "x.db", "store_corrupt"), (tmp_path / "no" / "x.db", "store_unavailable")):
        with pytest.raises(StoreError) as caught:
            DetectionStore(str(path)).open()
        assert caught.value.code == code
        assert str(tmp_path) not in caught.value.message


def test_a_writer_waits_for_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = DetectionStore(str(tmp_path / "x.db"))
    store.open()
    monkeypatch.setattr("viflow_anomaly_service.store.engine._SQLITE_PRAGMAS", ("PRAGMA busy_timeout=50",))
    store.close()
    with sqlite3.connect(tmp_path / "x.db", isolation_level=None) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreError) as caught:
            store.add([record()])
        assert caught.value.code == "store_busy"
        other.execute("ROLLBACK")
    other.close()
    store.add([record()])
    store.close()


def test_a_search_that_takes_too_long_ends(store: DetectionStore, monkeypatch: pytest.MonkeyPatch) -> None:
    endless = "WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n) SELECT count(*) FROM n"
    monkeypatch.setattr("viflow_anomaly_service.store.engine.STATEMENT_SECONDS", 1)
    engine = make_engine(store._url)
    with engine.connect() as connection, pytest.raises(StoreError) as caught, store_failures():
        connection.execute(sa.text(endless))
    assert caught.value.code == "store_busy"
    engine.dispose()
    store.add([record()])


@pytest.mark.parametrize(
    "text",
    ["mysql://u:secret@h/d", "sqlite://", "sqlite:///:memory:", "postgresql://u:secret@h:port/d", "http://x", ""],
)
def test_urls_that_cannot_be_used_are_refused_without_their_password(text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        store_url(text)
    assert (caught.value.code, caught.value.field) == ("store_url_invalid", "store_url")
    assert "secret" not in str(caught.value)


def test_urls_that_can_be_used() -> None:
    assert store_url("/a/b.db").database == "/a/b.db"
    assert store_url("sqlite:////a/b.db").database == "/a/b.db"
    assert store_url("postgresql://u@h/d").drivername == "postgresql+psycopg"
    assert "secret" not in DetectionStore("postgresql://u:secret@h/d").place


def test_ids_rise_and_are_many() -> None:
    make = IdMaker()
    with ThreadPoolExecutor(4) as threads:
        parts = list(threads.map(lambda _: [make() for _ in range(500)], range(4)))
    assert all(part == sorted(part) for part in parts)
    assert len({one for part in parts for one in part}) == 2000
