"""A URL -> an engine whose transactions survive a power cut, and tables of the newest version."""

from __future__ import annotations

import math
import sqlite3
import time
from pathlib import Path
from typing import Any, Final

import sqlalchemy as sa
from alembic import command
from alembic.config import Config
from alembic.script import ScriptDirectory
from alembic.util.exc import CommandError
from sqlalchemy.engine import URL, Connection, Engine, make_url
from sqlalchemy.exc import ArgumentError

from viflow_anomaly.errors import ConfigError
from viflow_anomaly_service.store.failures import store_error

MIGRATIONS: Final = Path(__file__).parent / "migrations"
CONNECT_SECONDS: Final = 3
STATEMENT_SECONDS: Final = 10
CONNECTIONS: Final = 4
UNTIL: Final = "until"
"""Among what is known of an SQLite connection: on the monotonic clock, when its transaction takes too long."""
_STEPS_A_LOOK: Final = 100_000
_LOOK_AGAIN_SECONDS: Final = 0.01
_MIGRATION_LOCK: Final = 0x7669666C6F77  # any number that nobody else takes
_SQLITE_PRAGMAS: Final = (
    f"PRAGMA busy_timeout={STATEMENT_SECONDS * 1000}",
    "PRAGMA auto_vacuum=INCREMENTAL",  # takes effect in a new file only, and before anything else is written
    "PRAGMA journal_mode=WAL",
    "PRAGMA synchronous=FULL",  # a commit is on the disk, not in the system's cache
    "PRAGMA foreign_keys=ON",
)


def store_url(text: str) -> URL:
    """A URL that can be used; a path alone is an SQLite file.

    Raises:
        ConfigError: ``store_url_invalid``; the message holds no password.
    """
    try:
        url = make_url(text if "://" in text else f"sqlite:///{text}")
    except (ArgumentError, ValueError):
        raise _invalid("something else") from None  # its text holds the password
    if url.drivername in ("postgresql", "postgres", "postgresql+psycopg"):
        return url.set(drivername="postgresql+psycopg")
    if url.drivername != "sqlite":
        raise _invalid(f"the kind {url.drivername!r:.40}")
    if url.database in (None, "", ":memory:"):
        raise _invalid("no file")
    return url


def _invalid(found: str) -> ConfigError:
    return ConfigError(
        f"store_url: expected sqlite:////folder/file.db, a path, or postgresql://user@host/database, found {found}",
        code="store_url_invalid",
        field="store_url",
    )


def make_engine(url: URL) -> Engine:
    """Connects to nothing yet. Every wait has an end, so that a store that hangs is one that failed."""
    if url.drivername == "sqlite":
        engine = sa.create_engine(url, pool_size=CONNECTIONS, max_overflow=0, pool_timeout=STATEMENT_SECONDS)
        _own_sqlite_transactions(engine)
        return engine
    return sa.create_engine(
        url,
        pool_size=CONNECTIONS,
        max_overflow=0,
        pool_timeout=STATEMENT_SECONDS,
        pool_pre_ping=True,
        connect_args={
            "connect_timeout": CONNECT_SECONDS,
            "options": f"-c statement_timeout={STATEMENT_SECONDS}s -c lock_timeout={STATEMENT_SECONDS}s",
            "tcp_user_timeout": STATEMENT_SECONDS * 1000,
        },
    )


def _own_sqlite_transactions(engine: Engine) -> None:
    """Python's driver begins transactions late, which lets two writers fail where one should wait."""

    @sa.event.listens_for(engine, "connect")
    def on_connect(connection: Any, record: Any) -> None:
        connection.isolation_level = None
        for pragma in _SQLITE_PRAGMAS:
            _execute_when_free(connection, pragma)
        known = record.info
        connection.set_progress_handler(lambda: time.monotonic() > known.get(UNTIL, math.inf), _STEPS_A_LOOK)

    @sa.event.listens_for(engine, "begin")
    def on_begin(connection: Connection) -> None:
        connection.info[UNTIL] = time.monotonic() + STATEMENT_SECONDS
        writes = connection.get_execution_options().get("writes", False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")


def _execute_when_free(connection: sqlite3.Connection, pragma: str) -> None:
    """SQLite does not wait, as its busy_timeout says, where several connections turn a new file to WAL at once."""
    until = time.monotonic() + STATEMENT_SECONDS
    while True:
        try:
            connection.execute(pragma).close()
        except sqlite3.OperationalError as err:
            if not err.sqlite_errorname.startswith("SQLITE_BUSY") or time.monotonic() > until:
                raise
            time.sleep(_LOOK_AGAIN_SECONDS)
        else:
            return


def migrate(engine: Engine) -> None:
    """Bring the tables to the newest version, once however many processes start together.

    Raises:
        StoreError: ``store_schema_unknown``.
    """
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    with engine.connect().execution_options(writes=True) as connection, connection.begin():
        if engine.dialect.name == "postgresql":
            connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_MIGRATION_LOCK)))
            connection.execute(sa.text("SET LOCAL statement_timeout = 0"))  # a large table may take its time
        connection.info.pop(UNTIL, None)
        config.attributes["connection"] = connection
        try:
            if not _is_newest(connection, config):
                command.upgrade(config, "head")
        except CommandError as err:
            raise store_error("store_schema_unknown") from err


def _is_newest(connection: Connection, config: Config) -> bool:
    if not sa.inspect(connection).has_table("alembic_version"):
        return False
    found = connection.execute(sa.text("SELECT version_num FROM alembic_version")).scalars().all()
    return found == [ScriptDirectory.from_config(config).get_current_head()]
