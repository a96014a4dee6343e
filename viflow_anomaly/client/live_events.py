"""``GET /events/live``: server-sent events as values, across connections that break (WHATWG HTML, section 9.2)."""

from __future__ import annotations

import codecs
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from viflow_anomaly.client.retry_policy import Attempts, RetryPolicy
from viflow_anomaly.client.service_errors import ServiceError, ServiceFaultError

EVENTS_PATH: Final = "/events/live"
EVENT_STREAM: Final = "text/event-stream"
MAX_EVENT_CHARACTERS: Final = 4 * 1024 * 1024
_LINE_END: Final = re.compile(r"\r\n|\n|\r(?!\Z)")
"""A carriage return at the end may be half of one."""


@dataclass(frozen=True)
class LiveEvent:
    """One event.

    Attributes:
        event_id: under which it is stored; what follows it is had with ``after=event_id``. Of a ``gap``: of the event
            before it, "" where there was none.
        kind: what happened: ``start``, ``update``, ``end``; or ``gap``, which is none itself: ahead of the next one
            some may be missing, because the service has deleted them.
        data: the event itself; of a ``gap`` its ``reason``.
    """

    event_id: str
    kind: str
    data: dict[str, Any]


class EventLines:
    """Bytes as they come -> events; remembers the last id and the wait that the service asks for.

    Attributes:
        last_id: of the newest event, "" where there was none.
        retry_s: as the service said last, None: it did not.
    """

    def __init__(self, last_id: str = "") -> None:
        self.last_id = last_id
        self.retry_s: float | None = None
        self.restart()

    def restart(self) -> None:
        """Another connection: what was begun on the last one is void."""
        self._decoder = codecs.getincrementaldecoder("utf-8-sig")("replace")
        self._rest = ""
        self._id = self.last_id
        self._kind = ""
        self._data: list[str] = []
        self._characters = 0

    def feed(self, chunk: bytes) -> Iterator[LiveEvent]:
        """The events that end in this chunk.

        Raises:
            ValueError: one is no JSON object, or larger than ``MAX_EVENT_CHARACTERS``.
        """
        *lines, self._rest = _LINE_END.split(self._rest + self._decoder.decode(chunk))
        if len(self._rest) > MAX_EVENT_CHARACTERS:
            raise ValueError("an event without end")
        for line in lines:
            if line:
                self._take(line)
            elif (event := self._ended()) is not None:
                yield event

    def _take(self, line: str) -> None:
        name, _, value = line.partition(":")
        value = value.removeprefix(" ")
        if name == "data":
            self._characters += len(value)
            if self._characters > MAX_EVENT_CHARACTERS:
                raise ValueError("an event without end")
            self._data.append(value)
        elif name == "event":
            self._kind = value
        elif name == "id" and "\0" not in value:
            self._id = value
        elif name == "retry" and value.isascii() and value.isdecimal():
            self.retry_s = int(value[:9]) / 1000

    def _ended(self) -> LiveEvent | None:
        text, kind = "\n".join(self._data), self._kind or "message"
        has_data = bool(self._data)
        self._kind, self._data, self._characters = "", [], 0
        self.last_id = self._id
        if not has_data:
            return None
        data = json.loads(text)
        if not isinstance(data, dict):
            raise ValueError("data that is no JSON object")  # noqa: TRY004 - as json's own
        return LiveEvent(self._id, kind, data)


class Following:
    """The state of ``follow_events`` between connections."""

    def __init__(self, url: str, policy: RetryPolicy, *, after: str | None, filters: Mapping[str, str] | None) -> None:
        self._url = url
        self._policy = policy
        self._attempts = Attempts(policy)
        self._lines = EventLines(after or "")
        self.parameters = dict(filters or {})

    def headers(self) -> dict[str, str]:
        """Of the next connection."""
        self._lines.restart()
        resumed = {"Last-Event-ID": self._lines.last_id} if self._lines.last_id else {}
        return {"Accept": EVENT_STREAM, "Cache-Control": "no-store", **resumed}

    def require_events(self, headers: Mapping[str, str]) -> None:
        """Nothing, where the answer is a stream of events; ServiceFaultError elsewhere."""
        found = headers.get("content-type", "").partition(";")[0].strip()
        if found != EVENT_STREAM:
            raise self._unreadable(f"{found or 'no'!r:.80} content")

    def events_in(self, chunk: bytes) -> Iterator[LiveEvent]:
        """What a chunk ends; a connection that brings something starts the attempts anew."""
        self._attempts = Attempts(self._policy)
        try:
            yield from self._lines.feed(chunk)
        except (ValueError, RecursionError) as err:
            raise self._unreadable(str(err)[:200]) from err

    def wait_after(self, error: ServiceError) -> float:
        """Seconds before the next connection; raises ``error`` when it is not worth one."""
        return max(self._attempts.wait_after(error), min(self._lines.retry_s or 0.0, self._policy.longest_wait_s))

    def _unreadable(self, found: str) -> ServiceFaultError:
        return ServiceFaultError(
            f"{self._url}: expected a stream of events, found {found}", code="service_answer_unreadable", status=200
        )
