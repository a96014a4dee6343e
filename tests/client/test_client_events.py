"""Events as they happen, against a small server of server-sent events that breaks off where a test wants it."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Iterator
from contextlib import aclosing, contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import islice
from typing import Any

import pytest
from test_client import problem

from viflow_anomaly.client import (
    AsyncClient,
    Client,
    LiveEvent,
    RetryPolicy,
    ServiceBusyError,
    ServiceFaultError,
    ServiceRefusedError,
    ServiceUnreachableError,
)
from viflow_anomaly.client.live_events import MAX_EVENT_CHARACTERS, EventLines

QUICK = RetryPolicy(attempts=3, first_wait_s=0.01, longest_wait_s=0.5)
Answer = tuple[int, dict[str, str], bytes]


def event_text(number: int, kind: str = "alarm") -> bytes:
    return f"id: e{number}\nevent: {kind}\ndata: {json.dumps({'number': number})}\n\n".encode()


@dataclass
class EventServer:
    """Each connection gets the next answer; those of 200 are events in the order of their numbers, then it breaks."""

    answers: list[Answer | list[bytes]]
    url: str = ""
    asked: list[tuple[str, dict[str, str]]] = field(default_factory=list)


@contextmanager
def event_server(*answers: Answer | list[bytes]) -> Iterator[EventServer]:
    state = EventServer(list(answers))

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            state.asked.append((self.path, {name.lower(): value for name, value in self.headers.items()}))
            answer = state.answers.pop(0) if len(state.answers) > 1 else state.answers[0]
            if isinstance(answer, tuple):
                status, headers, content = answer
                self.send_response(status)
                for name, value in {"Content-Length": str(len(content)), **headers}.items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(content)
                return
            self.send_response(200)
            self.send_header("Content-Type", "text/event-stream; charset=utf-8")
            self.send_header("Transfer-Encoding", "chunked")
            self.end_headers()
            for chunk in answer:
                self.wfile.write(f"{len(chunk):x}\r\n".encode() + chunk + b"\r\n")
            self.close_connection = True  # and no last chunk: it broke

        def log_message(self, *arguments: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    state.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield state
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def follow(url: str, count: int, **options: Any) -> list[LiveEvent]:
    with Client(url, retries=QUICK, api_key="vfa_a_b") as client:
        return list(islice(client.follow_events(**options), count))


def follow_async(url: str, count: int, **options: Any) -> list[LiveEvent]:
    async def collect() -> list[LiveEvent]:
        found = []
        async with AsyncClient(url, retries=QUICK) as client, aclosing(client.follow_events(**options)) as events:
            async for event in events:
                found.append(event)
                if len(found) == count:
                    break
        return found

    return asyncio.run(collect())


@pytest.mark.parametrize("ask", [follow, follow_async])
def test_events_go_on_across_broken_connections(ask: Any) -> None:
    first = [b": hello\n\n", event_text(1), event_text(2), b"id: e3\ndata: {"]  # the third is not whole
    with event_server(first, problem(503, "overloaded"), [event_text(3), event_text(4)]) as server:
        found = ask(server.url, 4, filters={"kind": "alarm"})
    assert found == [LiveEvent(f"e{number}", "alarm", {"number": number}) for number in range(1, 5)]
    assert [headers.get("last-event-id") for _, headers in server.asked] == [None, "e2", "e2"]
    assert {path for path, _ in server.asked} == {"/events/live?kind=alarm"}
    assert server.asked[0][1]["accept"] == "text/event-stream"


def test_it_begins_after_a_known_event_and_shows_its_key() -> None:
    with event_server([event_text(8)]) as server:
        assert [event.event_id for event in follow(server.url, 1, after="e7")] == ["e8"]
    assert server.asked[0][1]["last-event-id"] == "e7"
    assert server.asked[0][1]["authorization"] == "Bearer vfa_a_b"


@pytest.mark.parametrize("ask", [follow, follow_async])
def test_it_gives_up_where_nothing_comes(ask: Any) -> None:
    with event_server([]) as server:
        with pytest.raises(ServiceUnreachableError):
            ask(server.url, 1)
        assert len(server.asked) == 3
    with pytest.raises(ServiceUnreachableError):
        ask(server.url, 1)
    with event_server(problem(503, "overloaded")) as server, pytest.raises(ServiceBusyError):
        ask(server.url, 1)


@pytest.mark.parametrize("ask", [follow, follow_async])
def test_a_refusal_is_told_at_once(ask: Any) -> None:
    with event_server(problem(403, "scope_missing")) as server:
        with pytest.raises(ServiceRefusedError) as caught:
            ask(server.url, 1)
        assert (caught.value.code, len(server.asked)) == ("scope_missing", 1)
    with event_server((200, {"Content-Type": "text/html"}, b"<html>")) as server, pytest.raises(ServiceFaultError):
        ask(server.url, 1)
    with event_server((204, {}, b"")) as server:  # the standard's word for: do not come again
        assert ask(server.url, 1) == []


@pytest.mark.parametrize("data", [b"data: {\n\n", b"data: [1]\n\n", b"data:\n\n", b"data: " + b"[" * 99_999 + b"\n\n"])
def test_what_is_no_event_is_told(data: bytes) -> None:
    with event_server([data]) as server, pytest.raises(ServiceFaultError) as caught:
        follow(server.url, 1)
    assert caught.value.code == "service_answer_unreadable"


# --- lines


WHOLE = (
    '\ufeff: c\r\nid: 1\r\nevent: a\r\ndata: {"x":\r\ndata: "\u2028ü"}\r\n\r\nretry: 1500\r\r\ndata: {}\n\n'
).encode()
FOUND = [LiveEvent("1", "a", {"x": "\u2028ü"}), LiveEvent("1", "message", {})]


@pytest.mark.parametrize("step", [1, 2, 3, 7, len(WHOLE)])
def test_any_cut_gives_the_same_events(step: int) -> None:
    lines = EventLines()
    found = [event for start in range(0, len(WHOLE), step) for event in lines.feed(WHOLE[start : start + step])]
    assert found == FOUND
    assert (lines.last_id, lines.retry_s) == ("1", 1.5)


def test_a_gap_has_the_id_of_the_event_before() -> None:
    lines = EventLines("e1")
    found = list(lines.feed(b'event: gap\ndata: {"reason": "not_kept"}\n\n' + event_text(9)))
    assert found == [LiveEvent("e1", "gap", {"reason": "not_kept"}), LiveEvent("e9", "alarm", {"number": 9})]


def test_an_id_alone_moves_on_and_one_with_nul_does_not() -> None:
    lines = EventLines("0")
    assert list(lines.feed(b"id: 5\n\n")) == []
    assert lines.last_id == "5"
    assert list(lines.feed(b"id: 6\0\ndata: {}\n\nretry: soon\n\n")) == [LiveEvent("5", "message", {})]
    assert lines.retry_s is None


@pytest.mark.parametrize("line", [b"%s", b"data: %s\n"])
def test_an_event_without_end_is_given_up(line: bytes) -> None:
    block, lines = b"x" * (1024 * 1024), EventLines()

    def feed() -> None:
        for _ in range(MAX_EVENT_CHARACTERS // len(block) + 2):
            list(lines.feed(line % block))

    with pytest.raises(ValueError, match="without end"):
        feed()
