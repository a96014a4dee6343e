"""A reader of Server-Sent Events, as a browser has one."""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import httpx
from scripted_detector import scripted_call


@dataclass
class EventStream:
    """What has arrived: (id, kind, data); ``comments`` counts signs of life."""

    messages: list[tuple[str | None, str, dict[str, Any]]] = field(default_factory=list)
    comments: int = 0
    opened: threading.Event = field(default_factory=threading.Event)
    ended: threading.Event = field(default_factory=threading.Event)
    response: httpx.Response | None = None

    @property
    def ids(self) -> list[str | None]:
        return [one[0] for one in self.messages]

    def read(self, client: httpx.Client, params: dict[str, str], headers: dict[str, str]) -> None:
        try:
            with client.stream("GET", "/events/live", params=params, headers=headers, timeout=60) as response:
                self.response = response
                fields: dict[str, str] = {}
                for line in response.iter_lines():
                    self._take(line, fields)
        except (httpx.HTTPError, httpx.StreamError):
            pass
        finally:
            self.ended.set()

    def _take(self, line: str, fields: dict[str, str]) -> None:
        name, _, value = line.partition(": ")
        if line.startswith(":"):
            self.comments += 1
        elif name == "retry":
            self.opened.set()
        elif line:
            fields[name] = value
        elif fields:
            self.messages.append((fields.get("id"), fields["event"], json.loads(fields["data"])))
            fields.clear()


@contextlib.contextmanager
def reading(base_url: str, *, last_event_id: str | None = None, stream_id: str | None = None) -> Iterator[EventStream]:
    """Connected until the block ends."""
    stream = EventStream()
    params = {} if stream_id is None else {"stream": stream_id}
    headers = {} if last_event_id is None else {"Last-Event-ID": last_event_id}
    with httpx.Client(base_url=base_url, trust_env=False) as client:
        thread = threading.Thread(target=stream.read, args=(client, params, headers))
        thread.start()
        try:
            assert stream.opened.wait(30)
            yield stream
        finally:
            _cut(stream)
            thread.join(30)
    assert not thread.is_alive()


def _cut(stream: EventStream) -> None:
    """End a connection that another thread reads from."""
    if stream.response is not None and not stream.ended.is_set():
        network = stream.response.extensions["network_stream"]
        socket_ = network.get_extra_info("socket")
        with contextlib.suppress(OSError):
            socket_.shutdown(2)


def play(client: httpx.Client, name: str, scores: list[float], *, first: int = 0) -> list[str]:
    """Post frames of these scores; the ids of the detections. The last frame begins no pair yet."""
    ids: list[str] = []
    for number, score in enumerate(scores, first):
        answer = client.post(f"/streams/{name}/frames", json=scripted_call(number, score))
        assert answer.status_code == 200, answer.text
        ids += answer.json()["detection_ids"] or []
    return ids
