"""Damaged bytes over real sockets: a server with the service's own connections, and a client that keeps no rules."""

from __future__ import annotations

import contextlib
import json
import random
import socket
import threading
import time
from typing import Self

import uvicorn
from fastapi import FastAPI
from fuzzing.images import mutated
from fuzzing.requests import bad_request

from viflow_anomaly_service.connection_guard import guarded_protocol
from viflow_anomaly_service.settings import ServiceSettings

START_S = 30.0


class WireServer:
    """The application on a free port of the loopback interface, in a thread of this process."""

    def __init__(self, app: FastAPI, settings: ServiceSettings) -> None:
        protocol = guarded_protocol(settings)
        config = uvicorn.Config(app, port=0, http=protocol, ws="none", lifespan="on", log_config=None, access_log=False)
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run)

    @property
    def port(self) -> int:
        return int(self._server.servers[0].sockets[0].getsockname()[1])

    def __enter__(self) -> Self:
        self._thread.start()
        deadline = time.monotonic() + START_S
        while not self._server.started:
            if time.monotonic() > deadline:
                raise SystemExit("error: the server did not start")
            time.sleep(0.01)
        return self

    def __exit__(self, *_: object) -> None:
        self._server.should_exit = True
        self._thread.join(START_S)


def damaged_wire(rng: random.Random) -> tuple[str, bytes]:
    """A whole request as bytes, its head, its framing or all of it wrong; and by which rule."""
    request = bad_request(rng)
    lines = [name + b": " + value for name, value in request.headers]
    if not any(name == b"content-length" for name, _ in request.headers):
        lines.append(b"content-length: %d" % len(request.body))
    head = b"\r\n".join(
        (request.method.encode() + b" " + request.path + b" HTTP/1.1", b"host: x", b"connection: close", *lines)
    )
    body = request.body
    kind = rng.choice(("head", "head", "cut short", "chunked", "length", "as it is"))
    if kind == "head":
        head = mutated(rng, head)
    elif kind == "cut short":
        body = body[: rng.randrange(len(body) + 1)]
    elif kind == "chunked":
        head = head.replace(b"content-length:", b"transfer-encoding: chunked\r\nx-length:")
        size = rng.choice((b"%x" % len(body), b"%x" % (len(body) // 2), b"-1", b"f" * 30, b"", b"0x10", b"10;a=b"))
        body = size + b"\r\n" + body + rng.choice((b"\r\n0\r\n\r\n", b"\r\n", b"", b"\r\n0\r\na: b\r\n\r\n"))
    elif kind == "length":
        wrong = rng.choice((b"-1", b"+5", b"1e3", b"9" * 30, b"0", b"%d" % (len(body) + 1), b"5, 5", b" 7 "))
        head = head.replace(b"content-length: %d" % len(body), b"content-length: " + wrong)
    return f"wire: {kind}", head + b"\r\n\r\n" + body


def ask_wire(port: int, data: bytes, hang_s: float) -> tuple[str, str, str, float]:
    """Send, and read until the server ends the connection: status, problem code, what is wrong, seconds."""
    started = time.perf_counter()
    received = b""
    with socket.create_connection(("127.0.0.1", port), timeout=hang_s) as connection:
        with contextlib.suppress(OSError):  # it was closed meanwhile; there may be an answer all the same
            connection.sendall(data)
        try:
            while chunk := connection.recv(65536):
                received += chunk
        except TimeoutError:
            return "none", "", f"the connection stayed open for {hang_s:g} s", time.perf_counter() - started
        except OSError:
            pass
    return *_read(received), time.perf_counter() - started


def _read(received: bytes) -> tuple[str, str, str]:
    if not received:
        return "closed", "", ""
    head, _, body = received.partition(b"\r\n\r\n")
    words = head.split(b" ", 2)
    if not head.startswith(b"HTTP/1.1 ") or not words[1].isdigit():
        return "none", "", f"no HTTP answer: {received[:80]!r}"
    status, code = int(words[1]), ""
    if b"application/problem+json" in head and body:
        code = str(json.loads(body.partition(b"HTTP/1.1 ")[0])["code"])
    fine = status < 500 or (status == 503 and b"retry-after" in head.lower()) or status == 501
    return str(status), code, "" if fine else f"{status} {code}"
