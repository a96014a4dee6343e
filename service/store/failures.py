"""What can be wrong with a store, in words that a client and an operator can act on."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from viflow_anomaly.errors import ViflowError

# Beginning of SQLite's error name -> our code; PostgreSQL's SQLSTATE -> our code.
_SQLITE: Final = {
    "SQLITE_FULL": "store_full",
    "SQLITE_IOERR_WRITE": "store_full",
    "SQLITE_READONLY": "store_read_only",
    "SQLITE_BUSY": "store_busy",
    "SQLITE_LOCKED": "store_busy",
    "SQLITE_INTERRUPT": "store_busy",
    "SQLITE_CORRUPT": "store_corrupt",
    "SQLITE_NOTADB": "store_corrupt",
}
_POSTGRESQL: Final = {"53100": "store_full", "25006": "store_read_only", "57014": "store_busy", "55P03": "store_busy"}
_TOLD: Final = {
    "store_full": "there is no space left for it",
    "store_read_only": "it cannot be written to",
    "store_busy": "it did not answer in time",
    "store_corrupt": "its file is damaged or no SQLite database",
    "store_unavailable": "it cannot be reached",
    "store_schema_unknown": "a later version of this software has changed its tables",
    "store_opening": "it is still being opened",
}


class StoreError(ViflowError):
    """The store cannot do what it was asked; ``code`` is one of ``store_...``, the cause goes to the log only."""


def store_error(code: str) -> StoreError:
    """The error for a code: its text names no path and no host, because clients read it."""
    return StoreError(f"The store of detections is not usable: {_TOLD[code]}.", code=code)


@contextmanager
def store_failures() -> Iterator[None]:
    """What SQLAlchemy, the drivers and the file system raise inside becomes a ``StoreError``."""
    try:
        yield
    except (SQLAlchemyError, sqlite3.Error, OSError) as err:
        raise store_error(_code_of(err)) from err


def _code_of(err: Exception) -> str:
    if isinstance(err, PoolTimeoutError):
        return "store_busy"
    cause = getattr(err, "orig", None) or err
    name = getattr(cause, "sqlite_errorname", None) or ""
    known = next((code for start, code in _SQLITE.items() if name.startswith(start)), None)
    return known or _POSTGRESQL.get(getattr(cause, "sqlstate", None) or "", "store_unavailable")
