"""An HTTP answer -> its body, or the error that it stands for."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any, Final

from viflow_anomaly.client.service_errors import (
    ServiceBusyError,
    ServiceError,
    ServiceFaultError,
    ServiceRefusedError,
)

_MAX_TEXT: Final = 500
_BUSY: Final = frozenset({429, 502, 503, 504})


def body_of(status: int, headers: Mapping[str, str], body: bytes, *, url: str) -> bytes:
    """The body of a good answer.

    Raises:
        ServiceError: a child that names what the service said.
    """
    if status in (200, 204):
        return body
    problem = _problem(headers, body)
    if problem is not None and status >= 400:
        raise _error_of(problem, status, headers, url)
    if status in _BUSY:  # a proxy in front of it
        raise ServiceBusyError(
            f"{url}: expected an answer of a viflow-anomaly service, found status {status}",
            code="service_unavailable",
            status=status,
            retry_after_s=retry_after_s(headers),
        )
    raise ServiceFaultError(
        f"{url}: expected an answer of a viflow-anomaly service, found status {status} and no problem document",
        code="service_answer_unreadable",
        status=status,
    )


def _error_of(problem: dict[str, Any], status: int, headers: Mapping[str, str], url: str) -> ServiceError:
    kind: type[ServiceError] = ServiceFaultError if status >= 500 else ServiceRefusedError
    if status in _BUSY:
        kind = ServiceBusyError
    field, request_id = problem.get("field"), problem.get("request_id")
    return kind(
        f"{url}: {status}: {problem['detail']}"[:_MAX_TEXT],
        code=problem["code"],
        field=field if isinstance(field, str) else None,
        status=status,
        request_id=request_id if isinstance(request_id, str) else None,
        retry_after_s=retry_after_s(headers),
    )


def _problem(headers: Mapping[str, str], body: bytes) -> dict[str, Any] | None:
    if headers.get("content-type", "").partition(";")[0].strip() != "application/problem+json":
        return None
    try:
        problem = json.loads(body)
    except (ValueError, RecursionError):
        return None
    whole = isinstance(problem, dict) and all(isinstance(problem.get(name), str) for name in ("code", "detail"))
    return problem if whole else None


def object_of(body: bytes, *, url: str) -> dict[str, Any]:
    """The JSON object of a good answer.

    Raises:
        ServiceFaultError: ``service_answer_unreadable``.
    """
    try:
        found = json.loads(body)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise ServiceFaultError(
            f"{url}: expected a JSON object, found {len(body)} bytes that are none",
            code="service_answer_unreadable",
            status=200,
        )
    return found


def retry_after_s(headers: Mapping[str, str]) -> float | None:
    """``Retry-After`` in seconds, given as such or as a date; None: absent or neither."""
    text = headers.get("retry-after", "").strip()
    if text.isascii() and text.isdecimal():
        return float(text[:12])
    try:
        then = parsedate_to_datetime(text)
    except ValueError:
        return None
    then = then if then.tzinfo else then.replace(tzinfo=UTC)
    seconds = (then - datetime.now(UTC)).total_seconds()
    return max(0.0, math.ceil(seconds))
