"""The body of one request, read with a limit that holds while it arrives."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Coroutine
from http import HTTPStatus
from typing import Any, Final, TypeVar

from starlette.requests import ClientDisconnect, Request

from viflow_anomaly_service.problems import Problem

DISCARD_SECONDS: Final = 2.0

Result = TypeVar("Result")


class RequestBody:
    """Reads or discards what a client sends; holds at most the limit in memory.

    Attributes:
        finished: all of it has arrived, or the client has gone.
    """

    def __init__(self, request: Request) -> None:
        self._request = request
        self._started = False
        self.finished = False

    async def read(self, *, max_bytes: int, timeout_s: float) -> bytes:
        """The whole body.

        Args:
            max_bytes: limit, applied to Content-Length before anything is read and to the bytes as they come.
            timeout_s: longest upload.

        Raises:
            Problem: 413 ``body_too_large``, 408 ``body_timeout``.
            ClientDisconnect: the client went away.
        """
        announced = self._request.headers.get("content-length", "")
        if announced.isdecimal() and int(announced[:20]) > max_bytes:
            raise _too_large(max_bytes, f"{announced[:20]} announced")
        chunks: list[bytes] = []
        size = 0
        try:
            async with asyncio.timeout(timeout_s):
                while not self.finished:
                    chunk = await self._next_chunk()
                    size += len(chunk)
                    if size > max_bytes:
                        raise _too_large(max_bytes, "more")
                    chunks.append(chunk)
        except TimeoutError as err:
            detail = f"expected the whole body within {timeout_s:g} s, found {size} bytes of it"
            raise Problem(408, code="body_timeout", detail=detail) from err
        return b"".join(chunks)

    async def while_connected(self, work: Coroutine[Any, Any, Result]) -> Result:
        """The result of ``work``, which is cancelled when the client goes away; only after the whole body was read.

        Raises:
            ClientDisconnect: the client went away first.
        """
        return await unless_gone(work, self._left())

    async def _left(self) -> None:
        while (await self._request.receive())["type"] != "http.disconnect":
            pass

    async def discard(self) -> None:
        """Swallow the rest for a moment: a client that is still sending would else see a reset, not the answer.

        A client that asked first (``Expect: 100-continue``) and was not told to go on is not sending.
        """
        if not self._started and "expect" in self._request.headers:
            return
        with contextlib.suppress(TimeoutError, ClientDisconnect):
            async with asyncio.timeout(DISCARD_SECONDS):
                while not self.finished:
                    await self._next_chunk()

    async def _next_chunk(self) -> bytes:
        self._started = True
        message = await self._request.receive()
        if message["type"] == "http.disconnect":
            self.finished = True
            raise ClientDisconnect
        self.finished = not message.get("more_body", False)
        chunk: bytes = message.get("body", b"")
        return chunk


async def unless_gone(work: Coroutine[Any, Any, Result], gone: Coroutine[Any, Any, Any]) -> Result:
    """The result of ``work``, which is cancelled when ``gone`` ends first.

    Raises:
        ClientDisconnect: it did.
    """
    working, leaving = asyncio.ensure_future(work), asyncio.ensure_future(gone)
    try:
        await asyncio.wait({working, leaving}, return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            raise ClientDisconnect
        return working.result()
    finally:
        for task in (working, leaving):
            task.cancel()
        # Until the cancelled work has left the line: what holds its place may be given away after that only.
        await asyncio.wait({working, leaving})


@contextlib.asynccontextmanager
async def answered(body: RequestBody) -> AsyncIterator[None]:
    """A refusal inside is one that the client can read: what it still sends is swallowed before."""
    try:
        yield
    except Problem as problem:
        if problem.status != HTTPStatus.REQUEST_TIMEOUT:
            await body.discard()
        problem.closes_connection = not body.finished
        raise


def _too_large(max_bytes: int, found: str) -> Problem:
    return Problem(413, code="body_too_large", detail=f"expected a body of at most {max_bytes} bytes, found {found}")
