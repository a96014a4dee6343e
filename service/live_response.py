"""Server-sent events to one client who holds a place among a bounded number of them."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncGenerator, Callable
from typing import Any, Final

from fastapi.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

SSE_MEDIA_TYPE: Final = "text/event-stream"


class LiveResponse(StreamingResponse):
    """Events for one who has taken a place; however the connection ends, the place is free at once.

    Args:
        parts: the stream's bytes.
        leave: gives the place back.
    """

    def __init__(self, parts: AsyncGenerator[bytes, None], *, leave: Callable[[], Any]) -> None:
        self._parts = parts
        self._leave = leave
        headers = {"X-Accel-Buffering": "no"}  # nginx would hold events back until it has many
        super().__init__(parts, media_type=SSE_MEDIA_TYPE, headers=headers)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            async with contextlib.aclosing(self._parts):
                await super().__call__(scope, receive, send)
        finally:
            self._leave()
