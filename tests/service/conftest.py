from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from postgres_server import PostgresServer, postgres_server
from rule_detector import RuleDetector
from service_world import LiveServer, live_server


@pytest.fixture(scope="module")
def server() -> Iterator[LiveServer]:
    """One live service with a detector that answers by rule, shared by the tests of a module."""
    with live_server(lambda settings: RuleDetector()) as running:
        yield running


@pytest.fixture(scope="session")
def postgres() -> Iterator[PostgresServer]:
    """A PostgreSQL for all tests; each takes a database of its own. Who stops it starts it again."""
    with postgres_server() as running:
        yield running


@pytest.fixture(params=["sqlite", "postgresql"])
def empty_store_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """A store without tables, of either kind."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'detections.db'}"
    postgres: PostgresServer = request.getfixturevalue("postgres")
    return postgres.new_database()
