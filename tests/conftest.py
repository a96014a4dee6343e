"""Settings of the whole suite: property tests are reproducible and have no deadline on a busy machine; what takes long
and is the same for several tests is made once in a process."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest
from hypothesis import settings
from traced_once import traced_once

settings.register_profile("suite", deadline=None, derandomize=True)
settings.load_profile("suite")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell's background job is deaf to Ctrl-C, and so would be every process that a test interrupts.
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def _exports_traced_once() -> Iterator[None]:
    with traced_once():
        yield
