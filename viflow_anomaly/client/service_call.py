"""One request of a client, before it is sent."""

from __future__ import annotations

from typing import Any, NamedTuple


class ServiceCall(NamedTuple):
    """Of one request.

    Attributes:
        files: the parts of a multipart body.
        timeout_s: longest silence, where it is not the client's.
    """

    method: str
    path: str
    files: dict[str, Any] | None = None
    timeout_s: float | None = None

    @property
    def options(self) -> dict[str, Any]:
        """What httpx is to be told beside method and path."""
        return {"files": self.files} | ({} if self.timeout_s is None else {"timeout": self.timeout_s})
