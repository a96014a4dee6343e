from __future__ import annotations

from collections.abc import Iterator

import pytest
from rule_detector import RuleDetector
from service_world import LiveServer, live_server


@pytest.fixture(scope="module")
def server() -> Iterator[LiveServer]:
    """One live service with a detector that answers by rule, shared by the tests of a module."""
    with live_server(lambda settings: RuleDetector()) as running:
        yield running
