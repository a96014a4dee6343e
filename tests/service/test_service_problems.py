from __future__ import annotations

import json

import pytest

from viflow_anomaly.errors import (
    CheckpointError,
    ConfigError,
    InvalidInputError,
    TooLargeError,
    UnsupportedImageError,
    ViflowError,
)
from viflow_anomaly_service.problems import Problem, problem_of_error


@pytest.mark.parametrize(
    ("kind", "status"),
    [(InvalidInputError, 422), (ConfigError, 422), (TooLargeError, 413), (UnsupportedImageError, 415)],
)
def test_faults_of_the_client(kind: type[ViflowError], status: int) -> None:
    problem = problem_of_error(kind("expected x, found y", code="some_code", field="camera.fx"))
    assert (problem.status, problem.code, problem.field) == (status, "some_code", "camera.fx")
    assert problem.detail == "expected x, found y"


@pytest.mark.parametrize("kind", [ViflowError, CheckpointError])
def test_faults_of_ours_are_passed_on(kind: type[ViflowError]) -> None:
    err = kind("broken", code="some_code")
    with pytest.raises(kind) as caught:
        problem_of_error(err)
    assert caught.value is err


@pytest.mark.parametrize(
    ("field", "shown"),
    [
        (None, None),
        ("camera", "request.camera"),
        ("camera.fx", "request.camera.fx"),
        ("cameras", "cameras"),
        ("imu", "imu"),
    ],
)
def test_fields_are_named_as_the_request_calls_them(field: str | None, shown: str | None) -> None:
    err = InvalidInputError("bad", code="some_code", field=field)
    assert problem_of_error(err, {"camera": "request.camera"}).field == shown


def test_the_answer_is_ascii_and_bounded() -> None:
    problem = Problem(422, code="some_code", detail="\ud800" + "x" * 5000, field="y" * 5000)
    response = problem.response("id")
    assert bytes(response.body).isascii()
    body = json.loads(bytes(response.body))
    assert (len(body["detail"]), len(body["field"])) == (1000, 1000)
    assert response.headers["content-type"] == "application/problem+json"
    assert "retry-after" not in response.headers
    assert "connection" not in response.headers


def test_headers_of_answers_that_ask_for_something() -> None:
    problem = Problem(503, code="overloaded", detail="busy", retry_after_s=3)
    problem.closes_connection = True
    headers = problem.response("id", {"Allow": "GET"}).headers
    assert (headers["retry-after"], headers["connection"], headers["allow"]) == ("3", "close", "GET")
