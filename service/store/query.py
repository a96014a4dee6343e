"""What a client may ask of the stored detections: filters, and a cursor that goes on where a page ended."""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import re
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal, get_args

from viflow_anomaly.regions import RegionLabel
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.schemas import INT64_MAX

DEFAULT_LIMIT: Final = 100
MAX_LIMIT: Final = 1000
MAX_CURSOR: Final = 512
LABELS: Final[tuple[str, ...]] = get_args(RegionLabel)
STREAM_ID: Final = re.compile(r"[A-Za-z0-9._-]{1,64}", re.ASCII)
DETECTION_ID: Final = re.compile(r"[0-9a-f]{32}", re.ASCII)
Order = Literal["desc", "asc"]
ORDERS: Final[tuple[str, ...]] = get_args(Order)
FILTER_NAMES: Final = ("stream", "from_ns", "to_ns", "label", "min_score", "order")
_INTEGER: Final = re.compile(r"-?\d{1,19}", re.ASCII)
_NUMBER: Final = re.compile(r"\d(\.\d{1,16})?", re.ASCII)


@dataclass(frozen=True)
class DetectionFilter:
    """Which detections, in which order; None does not filter.

    Attributes:
        stream: of this stream.
        from_ns, to_ns: source frame at or after, and before, in camera time.
        label, min_score: with a region of this label, or of any, that has at least this score.
        order: by the time of storing, newest ("desc") or oldest first.
    """

    stream: str | None = None
    from_ns: int | None = None
    to_ns: int | None = None
    label: str | None = None
    min_score: float | None = None
    order: Order = "desc"


@dataclass(frozen=True)
class PageRequest:
    """One page of what passes the filter, behind the detection ``after``."""

    filter: DetectionFilter
    limit: int = DEFAULT_LIMIT
    after: str | None = None


def read_filter(parameters: list[tuple[str, str]]) -> DetectionFilter:
    """The filter of an export.

    Raises:
        Problem: 422 with the parameter at fault.
    """
    return _filter(_once(parameters, FILTER_NAMES))


def read_page(parameters: list[tuple[str, str]]) -> PageRequest:
    """A page's filter, size and place.

    Raises:
        Problem: 422 with the parameter at fault; ``cursor_invalid`` also for a cursor of another filter.
    """
    given = _once(parameters, (*FILTER_NAMES, "limit", "cursor"))
    chosen = _filter(given)
    limit = _integer(given, "limit", 1, MAX_LIMIT)
    cursor = given.get("cursor")
    after = None if cursor is None else _after(cursor, chosen)
    return PageRequest(chosen, DEFAULT_LIMIT if limit is None else limit, after)


def cursor_of(chosen: DetectionFilter, last_id: str) -> str:
    """Opaque text from which the page behind ``last_id`` is found again."""
    text = json.dumps([1, _digest(chosen), last_id], separators=(",", ":"))
    return base64.urlsafe_b64encode(text.encode()).decode().rstrip("=")


def require_detection_id(text: str) -> str:
    """The id as it is.

    Raises:
        Problem: 404 ``detection_not_found`` for what cannot be one.
    """
    if DETECTION_ID.fullmatch(text) is None:
        raise detection_not_found(text)
    return text


def detection_not_found(text: str) -> Problem:
    return Problem(404, code="detection_not_found", detail=f"expected the id of a stored detection, found {text!r:.80}")


def thumbnail_not_found(text: str) -> Problem:
    detail = f"expected the id of a stored detection with a thumbnail, found {text!r:.80}"
    return Problem(404, code="thumbnail_not_found", detail=detail)


def _filter(given: dict[str, str]) -> DetectionFilter:
    from_ns = _integer(given, "from_ns", -INT64_MAX - 1, INT64_MAX)
    to_ns = _integer(given, "to_ns", -INT64_MAX - 1, INT64_MAX)
    if from_ns is not None and to_ns is not None and to_ns <= from_ns:
        raise _wrong("to_ns", f"a time later than from_ns={from_ns}", str(to_ns))
    stream, score = given.get("stream"), given.get("min_score")
    if stream is not None and STREAM_ID.fullmatch(stream) is None:
        raise _wrong("stream", "1 to 64 of A-Z a-z 0-9 . _ -", stream)
    if score is not None and (_NUMBER.fullmatch(score) is None or float(score) > 1):
        raise _wrong("min_score", "a number from 0 to 1", score)
    return DetectionFilter(
        stream=stream,
        from_ns=from_ns,
        to_ns=to_ns,
        label=_choice(given, "label", LABELS),
        min_score=None if score is None else float(score),
        order="asc" if _choice(given, "order", ORDERS) == "asc" else "desc",
    )


def _once(parameters: list[tuple[str, str]], known: tuple[str, ...]) -> dict[str, str]:
    given: dict[str, str] = {}
    for name, value in parameters:
        if name not in known:
            detail = f"expected the parameters {', '.join(known)}, found {name!r:.80}"
            raise Problem(422, code="parameter_unknown", detail=detail, field=name[:80])
        if name in given:
            detail = f"{name}: expected it once, found it twice"
            raise Problem(422, code="parameter_invalid", detail=detail, field=name)
        given[name] = value
    return given


def _integer(given: dict[str, str], name: str, least: int, most: int) -> int | None:
    text = given.get(name)
    if text is None:
        return None
    if _INTEGER.fullmatch(text) is None or not least <= int(text) <= most:
        raise _wrong(name, f"an integer from {least} to {most}", text)
    return int(text)


def _choice(given: dict[str, str], name: str, choices: tuple[str, ...]) -> str | None:
    text = given.get(name)
    if text is not None and text not in choices:
        raise _wrong(name, " or ".join(choices), text)
    return text


def _wrong(name: str, expected: str, found: str) -> Problem:
    detail = f"{name}: expected {expected}, found {found!r:.80}"
    return Problem(422, code="parameter_invalid", detail=detail, field=name)


def _after(cursor: str, chosen: DetectionFilter) -> str:
    padded = cursor[:MAX_CURSOR] + "=" * (-len(cursor) % 4)
    try:
        value: Any = json.loads(base64.b64decode(padded, altchars=b"-_", validate=True))
        version, digest, last_id = value
    except (binascii.Error, ValueError, TypeError) as err:
        raise _wrong_cursor("something else") from err
    if version != 1 or not isinstance(last_id, str) or DETECTION_ID.fullmatch(last_id) is None:
        raise _wrong_cursor("something else")
    if digest != _digest(chosen):
        raise _wrong_cursor("one of other filters")
    return last_id


def _wrong_cursor(found: str) -> Problem:
    detail = f"cursor: expected the next_cursor of a page with the same filters, found {found}"
    return Problem(422, code="cursor_invalid", detail=detail, field="cursor")


def _digest(chosen: DetectionFilter) -> str:
    return hashlib.sha256(json.dumps(asdict(chosen), sort_keys=True).encode()).hexdigest()[:16]
