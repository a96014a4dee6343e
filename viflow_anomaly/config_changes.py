"""What differs between two configurations, and how to say the difference in a configuration file or the environment."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, NamedTuple

from pydantic import BaseModel


class ChangedValue(NamedTuple):
    """One setting by its dotted name, in plain JSON values."""

    name: str
    before: Any
    after: Any


def changed_values(before: BaseModel, after: BaseModel, *, section: str) -> list[ChangedValue]:
    """Settings that differ, in the order of the configuration; ``section`` is the name of both in the settings."""
    return _changed(before.model_dump(mode="json"), after.model_dump(mode="json"), section)


def _changed(before: dict[str, Any], after: dict[str, Any], above: str) -> list[ChangedValue]:
    found: list[ChangedValue] = []
    for name, old in before.items():
        new, place = after[name], f"{above}.{name}"
        if isinstance(old, dict) and isinstance(new, dict):
            found += _changed(old, new, place)
        elif old != new:
            found.append(ChangedValue(place, old, new))
    return found


def as_toml(changes: Sequence[ChangedValue]) -> str:
    """A configuration file that sets these values: ``[detector.regions]`` and a line for each."""
    tables: dict[str, list[str]] = {}
    for change in changes:
        table, _, key = change.name.rpartition(".")
        tables.setdefault(table, []).append(f"{key} = {json.dumps(change.after)}")
    return "\n\n".join(f"[{table}]\n" + "\n".join(lines) for table, lines in tables.items()) + ("\n" if tables else "")


def as_environment(changes: Sequence[ChangedValue], *, prefix: str) -> str:
    """The same as environment variables, a line for each: ``VIFLOW_DETECTOR__REGIONS__MOTION_SCORE=0.7``."""
    return "".join(f"{prefix}{change.name.upper().replace('.', '__')}={_plain(change.after)}\n" for change in changes)


def _plain(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
