"""Pages of a list of stored things, and the cursor that goes on where a page ended."""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import re
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from viflow_anomaly_service.parameters import integer_parameter
from viflow_anomaly_service.problems import Problem

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

DEFAULT_LIMIT: Final = 100
MAX_LIMIT: Final = 1000
MAX_CURSOR: Final = 512
ITEM_ID: Final = re.compile(r"[0-9a-f]{32}", re.ASCII)
"""Of stored detections and of events alike."""
PAGE_PARAMETERS: Final = ("limit", "cursor")
Filter = TypeVar("Filter", bound="DataclassInstance")


@dataclass(frozen=True)
class Page(Generic[Filter]):
    """One page of what passes the filter, behind the thing with the id ``after``."""

    filter: Filter
    limit: int = DEFAULT_LIMIT
    after: str | None = None


def page_of(given: dict[str, str], chosen: Filter) -> Page[Filter]:
    """The page of ``PAGE_PARAMETERS``.

    Raises:
        Problem: 422 with the parameter at fault; ``cursor_invalid`` also for a cursor of another filter.
    """
    cursor, limit = given.get("cursor"), integer_parameter(given, "limit", 1, MAX_LIMIT)
    after = None if cursor is None else _place_of(cursor, chosen)
    return Page(chosen, DEFAULT_LIMIT if limit is None else limit, after)


def cursor_of(chosen: DataclassInstance, last_id: str) -> str:
    """Opaque text from which the page behind ``last_id`` is found again."""
    text = json.dumps([1, _digest(chosen), last_id], separators=(",", ":"))
    return base64.urlsafe_b64encode(text.encode()).decode().rstrip("=")


def _place_of(cursor: str, chosen: DataclassInstance) -> str:
    """The id behind which a page begins."""
    padded = cursor[:MAX_CURSOR] + "=" * (-len(cursor) % 4)
    try:
        value: Any = json.loads(base64.b64decode(padded, altchars=b"-_", validate=True))
        version, digest, last_id = value
    except (binascii.Error, ValueError, TypeError) as err:
        raise _wrong_cursor("something else") from err
    if version != 1 or not isinstance(last_id, str) or ITEM_ID.fullmatch(last_id) is None:
        raise _wrong_cursor("something else")
    if digest != _digest(chosen):
        raise _wrong_cursor("one of other filters")
    return last_id


def _wrong_cursor(found: str) -> Problem:
    detail = f"cursor: expected the next_cursor of a page with the same filters, found {found}"
    return Problem(422, code="cursor_invalid", detail=detail, field="cursor")


def _digest(chosen: DataclassInstance) -> str:
    return hashlib.sha256(json.dumps(asdict(chosen), sort_keys=True).encode()).hexdigest()[:16]
