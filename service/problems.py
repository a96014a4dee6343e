"""Every error answer of the service: RFC 9457 ``application/problem+json`` with a stable ``code`` and the field."""

from __future__ import annotations

import json
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any, Final

from fastapi import FastAPI, Request, Response
from pydantic import ValidationError
from starlette.exceptions import HTTPException
from starlette.routing import Match

from viflow_anomaly.config import fault_text
from viflow_anomaly.errors import (
    ConfigError,
    InvalidInputError,
    TooLargeError,
    UnsupportedImageError,
    ViflowError,
)

PROBLEM_MEDIA_TYPE: Final = "application/problem+json"
MAX_LISTED_FAULTS: Final = 10
MAX_TEXT: Final = 1000

# First match wins: children before their parent.
_STATUS_OF_ERROR: Final[tuple[tuple[type[ViflowError], int], ...]] = (
    (TooLargeError, HTTPStatus.REQUEST_ENTITY_TOO_LARGE),
    (UnsupportedImageError, HTTPStatus.UNSUPPORTED_MEDIA_TYPE),
    (InvalidInputError, HTTPStatus.UNPROCESSABLE_ENTITY),
    (ConfigError, HTTPStatus.UNPROCESSABLE_ENTITY),
)
# Error types with a code of their own: two of pydantic's, and those that the validators in schemas.py raise.
_CODE_OF_FAULT: Final = {
    "missing": "field_missing",
    "extra_forbidden": "field_unknown",
    "imu_wrong_shape": "imu_wrong_shape",
    "timestamp_out_of_range": "timestamp_out_of_range",
}


class Problem(Exception):  # noqa: N818 - the RFC's own word
    """An error answer.

    Attributes:
        status: HTTP status.
        code: stable, machine-readable name of the fault.
        detail: what was expected, what was found.
        field: the input at fault in dotted form, or None.
        faults: further fields at fault, each ``{"code", "field", "detail"}``.
        retry_after_s: seconds after which trying again makes sense.
        closes_connection: the request was not read to its end, so that the connection cannot serve another one.
    """

    def __init__(
        self,
        status: int,
        *,
        code: str,
        detail: str,
        field: str | None = None,
        faults: list[dict[str, str | None]] | None = None,
        retry_after_s: int | None = None,
    ) -> None:
        super().__init__(detail)
        self.status = int(status)
        self.code = code
        self.detail = detail
        self.field = field
        self.faults = faults or []
        self.retry_after_s = retry_after_s
        self.closes_connection = False

    def body(self, request_id: str) -> dict[str, Any]:
        """The members of the answer's JSON object."""
        members: dict[str, Any] = {
            "type": "about:blank",
            "title": HTTPStatus(self.status).phrase,
            "status": self.status,
            "code": self.code,
            "detail": self.detail[:MAX_TEXT],
            "request_id": request_id,
        }
        if self.field is not None:
            members["field"] = self.field[:MAX_TEXT]
        if self.faults:
            members["errors"] = self.faults
        return members

    def response(self, request_id: str, headers: Mapping[str, str] | None = None) -> Response:
        """The HTTP answer; ASCII JSON, because a message may quote lone surrogates of the input."""
        content = json.dumps(self.body(request_id), allow_nan=False).encode("ascii")
        extra = dict(headers or {})
        if self.retry_after_s is not None:
            extra["Retry-After"] = str(self.retry_after_s)
        if self.closes_connection:
            extra["Connection"] = "close"
        return Response(content, status_code=self.status, media_type=PROBLEM_MEDIA_TYPE, headers=extra)


def unexpected_problem() -> Problem:
    """What a client learns of a fault of ours: nothing but that it happened (the log has the rest)."""
    return Problem(500, code="internal_error", detail="The service failed unexpectedly; its log has the request_id.")


def problem_of_error(err: ViflowError, field_names: Mapping[str, str] | None = None) -> Problem:
    """The answer to an error that the library raised.

    Args:
        err: the error.
        field_names: the library's field names as this kind of request calls them.

    Raises:
        ViflowError: ``err`` itself, of a class that a client's input cannot cause.
    """
    status = next((status for kind, status in _STATUS_OF_ERROR if isinstance(err, kind)), None)
    if status is None:
        raise err
    return Problem(status, code=err.code, detail=err.message, field=_renamed(err.field, field_names or {}))


def _renamed(field: str | None, names: Mapping[str, str]) -> str | None:
    """``camera.fx`` -> ``request.camera.fx`` where ``camera`` is called ``request.camera``."""
    if field is None:
        return None
    for known, shown in names.items():
        if field == known or field.startswith(f"{known}."):
            return shown + field.removeprefix(known)
    return field


def problem_of_validation(err: ValidationError, prefix: str | None = None) -> Problem:
    """422 for a request whose JSON has the wrong fields or types.

    Args:
        err: what pydantic found.
        prefix: where the validated object stands in the request (a multipart part), or None for the root.
    """
    faults: list[dict[str, str | None]] = []
    for fault in err.errors(include_url=False, include_input=False, include_context=False)[:MAX_LISTED_FAULTS]:
        steps = [str(step) for step in fault["loc"]]
        place = ".".join(([prefix] if prefix else []) + steps)[:MAX_TEXT]
        code = _CODE_OF_FAULT.get(fault["type"], "field_invalid")
        faults.append({"code": code, "field": place or None, "detail": fault_text(fault["type"], fault["msg"])})
    first = faults[0]
    detail = "; ".join(f"{fault['field'] or '(root)'}: {fault['detail']}" for fault in faults)
    return Problem(422, code=str(first["code"]), detail=detail, field=first["field"], faults=faults[1:])


def install_problem_handlers(app: FastAPI) -> None:
    """Make the app answer problems for ours and for the router's own 404 and 405; ``OPTIONS`` says what there is."""

    @app.exception_handler(Problem)
    async def on_problem(request: Request, problem: Problem) -> Response:
        return _answer(request, problem)

    @app.exception_handler(HTTPException)
    async def on_http_exception(request: Request, err: HTTPException) -> Response:
        phrase = HTTPStatus(err.status_code).phrase
        code = phrase.lower().replace(" ", "_")
        problem = Problem(err.status_code, code=code, detail=f"{request.method} {request.url.path}: {phrase}")
        if err.status_code != HTTPStatus.METHOD_NOT_ALLOWED:
            return _answer(request, problem, err.headers)
        allowed = {"Allow": _allowed_methods(request)}
        if request.method == "OPTIONS":
            return Response(status_code=HTTPStatus.NO_CONTENT, headers=allowed)
        return _answer(request, problem, allowed)


def _allowed_methods(request: Request) -> str:
    """Of all routes with the path's own template: each route for itself knows its own only. A name that also fits where
    another template has a parameter (``/models/default``) is what it is called, not that parameter."""
    matching = [route for route in request.app.router.routes if route.matches(request.scope)[0] is not Match.NONE]
    own = min((getattr(route, "path", "") for route in matching), key=lambda path: (path.count("{"), path), default="")
    found = [route for route in matching if getattr(route, "path", "") == own]
    methods = {method for route in found for method in getattr(route, "methods", None) or ()}
    implied = {"HEAD", "OPTIONS"} if "GET" in methods else {"OPTIONS"}
    return ", ".join(sorted(methods | implied))


def _answer(request: Request, problem: Problem, headers: Mapping[str, str] | None = None) -> Response:
    request.scope["viflow_problem_code"] = problem.code
    return problem.response(request.scope.get("viflow_request_id", ""), headers)
