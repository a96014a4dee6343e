"""Headers that keep a browser from doing more with an answer than it should."""

from __future__ import annotations

from typing import Final

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

SECURITY_HEADERS: Final = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
NO_CONTENT_POLICY: Final = "default-src 'none'; frame-ancestors 'none'"
HTML_POLICY: Final = "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
"""For pages, which say themselves what they load (``/docs``: scripts of a public CDN)."""


class SecurityHeadersMiddleware:
    """Adds them to every answer; what an endpoint has set itself stays."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in SECURITY_HEADERS.items():
                    headers.setdefault(name, value)
                is_page = headers.get("content-type", "").startswith("text/html")
                headers.setdefault("Content-Security-Policy", HTML_POLICY if is_page else NO_CONTENT_POLICY)
            await send(message)

        await self.app(scope, receive, send_with_headers if scope["type"] == "http" else send)
