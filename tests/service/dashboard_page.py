"""A real headless Chromium for the dashboard's tests; whatever a page complains of fails the test."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

CHROMIUM = Path("/usr/bin/chromium")
SCREENSHOTS = "DASHBOARD_SCREENSHOTS"
PATIENCE_MS = 30_000
_ANY_BLOB = re.compile("^blob:")

needs_chromium = pytest.mark.skipif(not CHROMIUM.exists(), reason="needs Debian's chromium: apt-get install chromium")
expect.set_options(timeout=PATIENCE_MS)


@contextlib.contextmanager
def running_browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=["--no-sandbox"])
        yield browser
        browser.close()


@contextlib.contextmanager
def watched_page(
    browser: Browser, address: str, *, expected_complaints: tuple[str, ...] = (), **options: Any
) -> Iterator[Page]:
    """A page at ``/``; no error in its console, no violation of its policy, no request that leaves the service."""
    context = browser.new_context(**{"viewport": {"width": 1440, "height": 900}, "reduced_motion": "reduce"} | options)
    context.set_default_timeout(PATIENCE_MS)
    page = context.new_page()
    complaints: list[str] = []
    addresses: list[str] = []
    page.on("console", lambda said: complaints.append(said.text) if said.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: addresses.append(request.url))
    page.goto(f"{address}/")
    yield page
    context.close()
    unexpected = [text for text in complaints if not any(known in text for known in expected_complaints)]
    foreign = [url for url in addresses if not url.startswith((f"{address}/", f"blob:{address}/"))]
    if unexpected or foreign:
        pytest.fail(f"expected a quiet page that asks its own service, found {unexpected} {foreign}")


def shot(page: Page, name: str, folder: Path, *, whole: bool = False) -> None:
    """Keep a picture of the page, where ``DASHBOARD_SCREENSHOTS`` says or with the test's own files."""
    chosen = Path(os.environ.get(SCREENSHOTS, folder))
    chosen.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=chosen / f"{name}.png", full_page=whole)


def held_still(page: Page) -> None:
    """The pictures that are wanted have come."""
    for place in ("#picture", "#map"):
        expect(page.locator(f"{place} img")).to_have_attribute("src", _ANY_BLOB)
        expect(page.locator(place)).not_to_have_attribute("aria-busy", "true")
