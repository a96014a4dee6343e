"""Somebody who is posted events, answers as a test wants, and can go away and come back on the same port."""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


@dataclass(frozen=True)
class Received:
    headers: dict[str, str]
    body: bytes
    answered: int

    @property
    def event(self) -> dict[str, Any]:
        return dict(json.loads(self.body))


@dataclass
class WebhookReceiver:
    """Everything that was posted, in its order; ``status_of`` decides the answer."""

    status_of: Callable[[dict[str, Any]], int] = lambda event: 204
    received: list[Received] = field(default_factory=list)
    port: int = 0
    _server: ThreadingHTTPServer | None = None
    _thread: threading.Thread | None = None

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/hook/token"

    def taken(self) -> list[dict[str, Any]]:
        """The events that were answered 2xx, each once, as a receiver keeps them that looks at their id."""
        kept = {one.event["event_id"]: one.event for one in self.received if 200 <= one.answered < 300}
        return list(kept.values())

    def start(self) -> None:
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                status = receiver.status_of(json.loads(body))
                receiver.received.append(Received(dict(self.headers), body, status))
                with contextlib.suppress(OSError):  # the sender has been killed
                    self.send_response(status)
                    if 300 <= status < 400:
                        self.send_header("Location", receiver.url)
                    self.send_header("Content-Length", "0")
                    self.end_headers()

            def log_message(self, format: str, *values: Any) -> None:  # noqa: A002 - its name in the parent
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", self.port), Handler)
        self._server.daemon_threads = True
        self.port = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,))
        self._thread.start()

    def stop(self) -> None:
        if self._server is not None and self._thread is not None:
            self._server.shutdown()
            self._server.server_close()
            self._thread.join(20)
            self._server = self._thread = None


@contextlib.contextmanager
def webhook_receiver(status_of: Callable[[dict[str, Any]], int] = lambda event: 204) -> Iterator[WebhookReceiver]:
    receiver = WebhookReceiver(status_of)
    receiver.start()
    try:
        yield receiver
    finally:
        receiver.stop()


@contextlib.contextmanager
def endless_receiver() -> Iterator[str]:
    """The URL of somebody who says 200 and then goes on talking."""

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(200)
            self.end_headers()
            with contextlib.suppress(OSError):
                while True:
                    self.wfile.write(b"." * 65536)

        def log_message(self, format: str, *values: Any) -> None:  # noqa: A002 - its name in the parent
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, args=(0.05,))
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join(20)
