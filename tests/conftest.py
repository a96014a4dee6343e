"""Settings of the whole suite: property tests are reproducible and have no deadline on a busy machine."""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("suite", deadline=None, derandomize=True)
settings.load_profile("suite")
