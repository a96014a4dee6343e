"""Parameters of a query, each checked by itself: what is asked of lists of stored things."""

from __future__ import annotations

import re
from typing import Final, Literal, get_args

from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.schemas import INT64_MAX

STREAM_ID: Final = re.compile(r"(?!\.{1,2}$)[A-Za-z0-9._-]{1,64}", re.ASCII)
"""Not what stands for a folder in a path: browsers fold it away."""
Order = Literal["desc", "asc"]
ORDERS: Final[tuple[str, ...]] = get_args(Order)
_INTEGER: Final = re.compile(r"-?\d{1,19}", re.ASCII)
_SHARE: Final = re.compile(r"\d(\.\d{1,16})?", re.ASCII)


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
    """An integer in these limits; raises Problem 422 ``parameter_invalid``, as do those that follow."""
    text = given.get(name)
    if text is None:
        return None
    if _INTEGER.fullmatch(text) is None or not least <= int(text) <= most:
        raise wrong_parameter(name, f"an integer from {least} to {most}", text)
    return int(text)


def share_parameter(given: dict[str, str], name: str) -> float | None:
    """A number in 0..1."""
    text = given.get(name)
    if text is None:
        return None
    if _SHARE.fullmatch(text) is None or float(text) > 1:
        raise wrong_parameter(name, "a number from 0 to 1", text)
    return float(text)


def choice_parameter(given: dict[str, str], name: str, choices: tuple[str, ...]) -> str | None:
    text = given.get(name)
    if text is not None and text not in choices:
        raise wrong_parameter(name, " or ".join(choices), text)
    return text


def stream_parameter(given: dict[str, str], name: str) -> str | None:
    """The id of a stream."""
    stream = given.get(name)
    if stream is not None and STREAM_ID.fullmatch(stream) is None:
        raise wrong_parameter(name, "1 to 64 of A-Z a-z 0-9 . _ -", stream)
    return stream


def time_parameters(given: dict[str, str]) -> tuple[int | None, int | None]:
    """``from_ns`` and ``to_ns``, the second later than the first."""
    from_ns, to_ns = (integer_parameter(given, name, -INT64_MAX - 1, INT64_MAX) for name in ("from_ns", "to_ns"))
    if from_ns is not None and to_ns is not None and to_ns <= from_ns:
        raise wrong_parameter("to_ns", f"a time later than from_ns={from_ns}", str(to_ns))
    return from_ns, to_ns


def order_parameter(given: dict[str, str]) -> Order:
    """Newest first, unless it is asked for otherwise."""
    return "asc" if choice_parameter(given, "order", ORDERS) == "asc" else "desc"


def wrong_parameter(name: str, expected: str, found: str) -> Problem:
    detail = f"{name}: expected {expected}, found {found!r:.80}"
    return Problem(422, code="parameter_invalid", detail=detail, field=name)
