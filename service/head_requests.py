"""``HEAD``: what ``GET`` would answer, without its body."""

from __future__ import annotations

from starlette.types import ASGIApp, Message, Receive, Scope, Send


class _HeadSentError(Exception):
    """Nobody waits for the rest of the answer."""


class HeadMiddleware:
    """Asks the endpoints behind it as ``GET`` does, and ends their answer with its head: no stream is begun."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self.app(scope, receive, send)
            return

        async def send_head(message: Message) -> None:
            await send(message)
            await send({"type": "http.response.body", "body": b""})
            raise _HeadSentError

        scope["method"] = "GET"
        try:
            await self.app(scope, receive, send_head)
        except _HeadSentError:
            pass
        finally:
            scope["method"] = "HEAD"  # for the log
