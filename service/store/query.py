"""What a client may ask of the stored detections: filters, and a cursor that goes on where a page ended."""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import re
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

from viflow_anomaly.regions import RegionLabel
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.schemas import INT64_MAX

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

DEFAULT_LIMIT: Final = 100
MAX_LIMIT: Final = 1000
MAX_CURSOR: Final = 512
LABELS: Final[tuple[str, ...]] = get_args(RegionLabel)
STREAM_ID: Final = re.compile(r"(?!\.{1,2}$)[A-Za-z0-9._-]{1,64}", re.ASCII)
"""Not what stands for a folder in a path: browsers fold it away."""
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
    return _filter(parameters_once(parameters, FILTER_NAMES))


def read_page(parameters: list[tuple[str, str]]) -> PageRequest:
    """A page's filter, size and place.

    Raises:
        Problem: 422 with the parameter at fault; ``cursor_invalid`` also for a cursor of another filter.
    """
    given = parameters_once(parameters, (*FILTER_NAMES, "limit", "cursor"))
    chosen = _filter(given)
    limit = integer_parameter(given, "limit", 1, MAX_LIMIT)
    cursor = given.get("cursor")
    after = None if cursor is None else place_of_cursor(cursor, chosen)
    return PageRequest(chosen, DEFAULT_LIMIT if limit is None else limit, after)


def cursor_of(chosen: DataclassInstance, last_id: str) -> str:
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
    from_ns, to_ns = time_parameters(given)
    score = given.get("min_score")
    if score is not None and (_NUMBER.fullmatch(score) is None or float(score) > 1):
        raise wrong_parameter("min_score", "a number from 0 to 1", score)
    return DetectionFilter(
        stream=stream_parameter(given, "stream"),
        from_ns=from_ns,
        to_ns=to_ns,
        label=choice_parameter(given, "label", LABELS),
        min_score=None if score is None else float(score),
        order="asc" if choice_parameter(given, "order", ORDERS) == "asc" else "desc",
    )


def time_parameters(given: dict[str, str]) -> tuple[int | None, int | None]:
    """``from_ns`` and ``to_ns``.

    Raises:
        Problem: 422 ``parameter_invalid``.
    """
    from_ns = integer_parameter(given, "from_ns", -INT64_MAX - 1, INT64_MAX)
    to_ns = integer_parameter(given, "to_ns", -INT64_MAX - 1, INT64_MAX)
    if from_ns is not None and to_ns is not None and to_ns <= from_ns:
        raise wrong_parameter("to_ns", f"a time later than from_ns={from_ns}", str(to_ns))
    return from_ns, to_ns


def stream_parameter(given: dict[str, str], name: str) -> str | None:
    """The id of a stream.

    Raises:
        Problem: 422 ``parameter_invalid``.
    """
    stream = given.get(name)
    if stream is not None and STREAM_ID.fullmatch(stream) is None:
        raise wrong_parameter(name, "1 to 64 of A-Z a-z 0-9 . _ -", stream)
    return stream


def parameters_once(parameters: list[tuple[str, str]], known: tuple[str, ...]) -> dict[str, str]:
    """The parameters by name.

    Raises:
        Problem: 422 ``parameter_unknown``, or ``parameter_invalid`` for one that is there twice.
    """
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


def integer_parameter(given: dict[str, str], name: str, least: int, most: int) -> int | None:
    text = given.get(name)
    if text is None:
        return None
    if _INTEGER.fullmatch(text) is None or not least <= int(text) <= most:
        raise wrong_parameter(name, f"an integer from {least} to {most}", text)
    return int(text)


def choice_parameter(given: dict[str, str], name: str, choices: tuple[str, ...]) -> str | None:
    text = given.get(name)
    if text is not None and text not in choices:
        raise wrong_parameter(name, " or ".join(choices), text)
    return text


def wrong_parameter(name: str, expected: str, found: str) -> Problem:
    detail = f"{name}: expected {expected}, found {found!r:.80}"
    return Problem(422, code="parameter_invalid", detail=detail, field=name)


def place_of_cursor(cursor: str, chosen: DataclassInstance) -> str:
    """The id behind which a page begins.

    Raises:
        Problem: 422 ``cursor_invalid``.
    """
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


def _digest(chosen: DataclassInstance) -> str:
    return hashlib.sha256(json.dumps(asdict(chosen), sort_keys=True).encode()).hexdigest()[:16]
