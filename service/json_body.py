"""JSON text -> Python values, with every trap of hostile JSON closed: size, depth, duplicate keys, giant integers."""

from __future__ import annotations

import json
from collections import Counter
from typing import Any, Final

from viflow_anomaly_service.problems import Problem

MAX_DEPTH: Final = 16
_MAX_INTEGER_DIGITS: Final = 20  # 2**63 has 19
_MAX_QUOTED_KEY: Final = 80


def parse_json(data: bytes, *, max_values: int, part: str | None = None) -> Any:
    """Read one JSON text in UTF-8.

    NaN and Infinity, which Python's and other writers emit although JSON has no such numbers, are let through as
    floats: the check of the field they stand in refuses them by name. Integers of more than 20 digits arrive as
    floats, so that no check has to handle them as numbers of unbounded size.

    Args:
        data: the text; base64 holds none of the counted characters, so images do not count.
        max_values: most commas and opening brackets, counted before parsing (bounds the memory of what is parsed).
        part: name of the multipart part the text came in, or None for the whole body.

    Raises:
        Problem: 400 ``json_invalid`` or ``json_too_deep``, 413 ``json_too_many_values``, 422 ``json_duplicate_key``.
    """
    count = sum(data.count(mark) for mark in (b",", b"[", b"{"))
    if count > max_values:
        raise Problem(
            413, code="json_too_many_values", detail=f"expected at most {max_values} values, found {count}", field=part
        )
    try:
        value = json.loads(data.decode("utf-8"), parse_int=_integer, object_pairs_hook=_UniqueKeys(part))
    except UnicodeDecodeError as err:
        raise Problem(
            400, code="json_invalid", detail=f"expected UTF-8, found another byte at {err.start}", field=part
        ) from err
    except json.JSONDecodeError as err:
        detail = f"expected JSON, found: {err.msg} at line {err.lineno} column {err.colno}"
        raise Problem(400, code="json_invalid", detail=detail, field=part) from err
    except RecursionError as err:
        raise _too_deep(part) from err
    if _depth_exceeds(value, MAX_DEPTH):
        raise _too_deep(part)
    return value


def _too_deep(part: str | None) -> Problem:
    return Problem(
        400, code="json_too_deep", detail=f"expected at most {MAX_DEPTH} levels of nesting, found more", field=part
    )


def _integer(digits: str) -> int | float:
    return int(digits) if len(digits) <= _MAX_INTEGER_DIGITS else float(digits)


class _UniqueKeys:
    """Object hook that refuses an object with the same key twice: two readers could take different values."""

    def __init__(self, part: str | None) -> None:
        self._part = part

    def __call__(self, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        result = dict(pairs)
        if len(result) != len(pairs):
            twice = Counter(name for name, _ in pairs).most_common(1)[0][0]
            raise Problem(
                422,
                code="json_duplicate_key",
                detail=f"expected every key once in an object, found {twice[:_MAX_QUOTED_KEY]!r} twice",
                field=self._part or twice[:_MAX_QUOTED_KEY],
            )
        return result


def _depth_exceeds(value: Any, limit: int) -> bool:
    level = [value]
    for _ in range(limit):
        containers = [item for item in level if isinstance(item, dict | list)]
        level = [child for item in containers for child in (item.values() if isinstance(item, dict) else item)]
        if not level:
            return False
    return any(isinstance(item, dict | list) for item in level)
