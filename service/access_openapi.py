"""What the OpenAPI document says of keys: two ways to show one, the scope of each operation, the refusals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from viflow_anomaly_service.access_control import KEY_HEADER
from viflow_anomaly_service.access_rules import is_open, required_scope

SECURITY_SCHEMES: Final = {
    "bearerKey": {"type": "http", "scheme": "bearer", "description": "a key of `viflow-anomaly keys new`"},
    "headerKey": {"type": "apiKey", "in": "header", "name": KEY_HEADER, "description": "the same key"},
}
REFUSALS: Final = (401, 403, 429)


def describe_access(document: dict[str, Any], refusals: Mapping[int | str, Any]) -> None:
    """Write them into the document.

    Args:
        document: OpenAPI 3.1; changed in place.
        refusals: answers to who may not ask, by status.
    """
    document.setdefault("components", {})["securitySchemes"] = SECURITY_SCHEMES
    for path, item in document["paths"].items():
        for method, operation in item.items():
            if is_open(path):
                operation["security"] = []
                continue
            scope = required_scope(method.upper(), path)
            # The empty one: a service on loopback may have been started without keys.
            operation["security"] = [{name: [scope] if scope else []} for name in SECURITY_SCHEMES] + [{}]
            for status, answer in refusals.items():
                own = operation["responses"].get(str(status), {})  # a full table of streams is a 429, too
                both = {**answer, **own, "headers": {**answer.get("headers", {}), **own.get("headers", {})}}
                operation["responses"][str(status)] = both
