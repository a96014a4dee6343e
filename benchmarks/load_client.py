"""Sends one ready-made HTTP request again and again and says what came back; the standard library alone, to stay light.

Closed loop: every client sends as soon as it has its answer. Open loop (``--rate``): requests fall due at random
moments (exponential gaps) whether or not earlier ones were answered, and the time counts from the moment due.

    python benchmarks/load_client.py 8000 request.bin --clients 16 --seconds 10 --rate 25
"""

from __future__ import annotations

import argparse
import json
import random
import socket
import threading
import time
from collections import Counter
from pathlib import Path

TIMEOUT_S = 60.0


class Connection:
    """One keep-alive connection that reconnects when the server closed it."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._socket: socket.socket | None = None

    def ask(self, request: bytes) -> int:
        """The status of the answer, which is read to its end; 0: none came."""
        for fresh in (self._socket is None, True):
            try:
                return self._exchange(request)
            except (OSError, ValueError):
                self.close()
                if fresh:
                    return 0
        return 0

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = None

    def _exchange(self, request: bytes) -> int:
        if self._socket is None:
            self._socket = socket.create_connection(("127.0.0.1", self._port), timeout=TIMEOUT_S)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.sendall(request)
        head, body = b"", b""
        while b"\r\n\r\n" not in head:
            head += self._received()
        head, _, body = head.partition(b"\r\n\r\n")
        lines = head.lower().split(b"\r\n")
        length = next(int(line.split(b":")[1]) for line in lines if line.startswith(b"content-length:"))
        size = len(body)
        while size < length:
            size += len(self._received())
        if b"connection: close" in lines:
            self.close()
        return int(head.split(b" ", 2)[1])

    def _received(self) -> bytes:
        assert self._socket is not None  # noqa: S101
        chunk = self._socket.recv(65536)
        if not chunk:
            raise ConnectionError("closed")
        return chunk


class Load:
    """What all clients share."""

    def __init__(self, port: int, request: bytes, *, due: list[float] | None, until: float, count: int | None) -> None:
        self._port = port
        self._request = request
        self._due = due
        self._until = until
        self._left = count
        self._next = 0
        self._lock = threading.Lock()
        self.answers: list[tuple[float, float, int]] = []
        """When it fell due (seconds from the start), seconds until the answer, status."""

    def turn(self, began: float) -> float | None:
        """When the next request falls due; None: there is none."""
        with self._lock:
            if self._due is not None:
                if self._next >= len(self._due):
                    return None
                self._next += 1
                return began + self._due[self._next - 1]
            if self._left is not None:
                self._left -= 1
                if self._left < 0:
                    return None
            now = time.perf_counter()
            return now if now < began + self._until else None

    def client(self, began: float, *, reconnect: bool) -> None:
        connection = Connection(self._port)
        while (due := self.turn(began)) is not None:
            if (ahead := due - time.perf_counter()) > 0:
                time.sleep(ahead)
            status = connection.ask(self._request)
            taken = time.perf_counter() - due
            with self._lock:
                self.answers.append((due - began, taken, status))
            if reconnect:
                connection.close()
        connection.close()


def due_times(rate: float, seconds: float, seed: int) -> list[float]:
    moments = random.Random(seed)  # noqa: S311
    times, now = [], 0.0
    while (now := now + moments.expovariate(rate)) < seconds:
        times.append(now)
    return times


def main() -> None:
    parser = argparse.ArgumentParser(description="Send one request many times.")
    parser.add_argument("port", type=int)
    parser.add_argument("request", type=Path, help="the bytes to send: head and body")
    parser.add_argument("--clients", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=1e9)
    parser.add_argument("--requests", type=int, help="closed loop: end after so many")
    parser.add_argument("--rate", type=float, help="open loop: requests a second")
    parser.add_argument("--reconnect", action="store_true", help="a new connection for every request")
    arguments = parser.parse_args()
    due = None if arguments.rate is None else due_times(arguments.rate, arguments.seconds, seed=1)
    load = Load(
        arguments.port,
        arguments.request.read_bytes(),
        due=due,
        until=arguments.seconds,
        count=arguments.requests,
    )
    began = time.perf_counter()
    clients = [
        threading.Thread(target=load.client, args=(began,), kwargs={"reconnect": arguments.reconnect})
        for _ in range(arguments.clients)
    ]
    for client in clients:
        client.start()
    for client in clients:
        client.join()
    took = time.perf_counter() - began
    statuses = Counter(str(status) for _, _, status in load.answers)
    print(json.dumps({"seconds": took, "statuses": statuses, "answers": load.answers}))


if __name__ == "__main__":
    main()
