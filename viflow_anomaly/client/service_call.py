"""One request of a client, before it is sent."""

from __future__ import annotations

from typing import Any, NamedTuple


class ServiceCall(NamedTuple):
    """``files``: the parts of a multipart body."""

    method: str
    path: str
    files: dict[str, Any] | None = None
