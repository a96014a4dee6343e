"""The dashboard's files: read once, served with an ETag and a policy that lets the page load nothing from elsewhere."""

from __future__ import annotations

import hashlib
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Final, NamedTuple

from fastapi import FastAPI, Request, Response

from viflow_anomaly_service.problems import Problem

MEDIA_TYPES: Final = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".json": "application/json",
    ".jpg": "image/jpeg",
}
FOLDERS: Final = {"static": "", "sample": "sample-"}
"""Folder -> what its files' names begin with in the address."""
PAGE: Final = "index.html"
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' blob:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'; object-src 'none'"
)
"""Pictures come with the key in a header, so that the page shows them from memory (``blob:``)."""


class StaticFile(NamedTuple):
    """One file, ready to be sent."""

    content: bytes
    media_type: str
    etag: str


def add_dashboard(app: FastAPI) -> None:
    """Add the page and its files; they are the same for everybody and hold no data."""
    found = read_files()

    @app.get("/", include_in_schema=False)
    async def page(request: Request) -> Response:
        return _sent(found[PAGE], request)

    @app.get("/dashboard/{name}", include_in_schema=False)
    async def file(request: Request, name: str) -> Response:
        if name not in found:
            raise Problem(404, code="not_found", detail=f"expected a file of the dashboard, found {name!r:.80}")
        return _sent(found[name], request)


def read_files() -> dict[str, StaticFile]:
    """Every file of the dashboard by its name in the address."""
    package = files("viflow_anomaly_service.dashboard")
    return {
        prefix + entry.name: _read(entry, suffix)
        for folder, prefix in FOLDERS.items()
        for entry in (package / folder).iterdir()
        if (suffix := "." + entry.name.rpartition(".")[2]) in MEDIA_TYPES
    }


def _read(entry: Traversable, suffix: str) -> StaticFile:
    content = entry.read_bytes()
    return StaticFile(content, MEDIA_TYPES[suffix], f'"{hashlib.sha256(content).hexdigest()[:32]}"')


def _sent(file: StaticFile, request: Request) -> Response:
    headers = {"ETag": file.etag, "Cache-Control": "no-cache", "Content-Security-Policy": POLICY}
    if request.headers.get("if-none-match") == file.etag:
        return Response(status_code=304, headers=headers)
    return Response(file.content, media_type=file.media_type, headers=headers)
