"""The OpenAPI document: stable names, references that resolve, examples that are true."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from rule_detector import RuleDetector
from service_world import LiveServer, json_request, live_server

from viflow_anomaly_service.events.query import EVENT_FILTER_NAMES
from viflow_anomaly_service.examples import (
    EXAMPLE_FAULTS,
    INTERVAL_NS,
    SOURCE_NS,
    example_form_request,
    example_image_png,
)
from viflow_anomaly_service.store.query import FILTER_NAMES

HTTP_METHODS = {"get", "post", "put", "delete", "patch", "head", "options", "trace"}


@pytest.fixture(scope="module")
def document(server: LiveServer) -> dict[str, Any]:
    response = server.client.get("/openapi.json")
    assert response.status_code == 200
    return dict(response.json())


def operations(document: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, item in document["paths"].items():
        for method, operation in item.items():
            assert method in HTTP_METHODS
            yield path, method, operation


def contents(document: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every (place, media type object) of requests and answers."""
    for path, method, operation in operations(document):
        bodies = {"request": operation.get("requestBody", {})} | operation["responses"]
        for name, body in bodies.items():
            for media_type, content in body.get("content", {}).items():
                yield f"{method} {path} {name} {media_type}", content


def walk(node: Any) -> Iterator[dict[str, Any]]:
    if isinstance(node, dict):
        yield node
    for child in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
        yield from walk(child)


def validator(document: dict[str, Any], schema: dict[str, Any]) -> jsonschema.Draft202012Validator:
    whole = schema | {"components": document["components"]}
    jsonschema.Draft202012Validator.check_schema(whole)
    return jsonschema.Draft202012Validator(whole)


def test_operation_ids_are_stable(document: dict[str, Any]) -> None:
    assert document["openapi"].startswith("3.1")
    assert {(path, method): operation["operationId"] for path, method, operation in operations(document)} == {
        ("/healthz", "get"): "healthz",
        ("/readyz", "get"): "readyz",
        ("/version", "get"): "version",
        ("/metrics", "get"): "metrics",
        ("/models", "get"): "models",
        ("/models/{name}/load", "post"): "loadModel",
        ("/models/default", "put"): "switchModel",
        ("/models/{name}", "delete"): "unloadModel",
        ("/schemas/detection-1.0.json", "get"): "detectionSchema",
        ("/detect", "post"): "detect",
        ("/detections", "get"): "listDetections",
        ("/detections.ndjson", "get"): "exportDetections",
        ("/detections/{detection_id}", "get"): "getDetection",
        ("/events", "get"): "listEvents",
        ("/events.ndjson", "get"): "exportEvents",
        ("/events/live", "get"): "liveEvents",
        ("/events/deliveries", "get"): "listDeliveries",
        ("/events/deliveries/{delivery_id}/retry", "post"): "retryDelivery",
        ("/detections/{detection_id}/thumbnail", "get"): "getThumbnail",
        ("/streams", "get"): "listStreams",
        ("/streams/{stream_id}", "get"): "getStream",
        ("/streams/{stream_id}", "delete"): "deleteStream",
        ("/streams/{stream_id}/frames", "post"): "addFrame",
        ("/live", "get"): "listLive",
        ("/live/pairs", "get"): "followPairs",
        ("/streams/{stream_id}/live", "get"): "followStreamPairs",
        ("/streams/{stream_id}/pairs", "get"): "listPairs",
        ("/streams/{stream_id}/pairs/{number}/{picture}", "get"): "getPairPicture",
        ("/streams/{stream_id}/pairs/{number}/inspect", "post"): "inspectPair",
        ("/inspect", "post"): "inspect",
        ("/detector", "get"): "getDetector",
    }


def test_every_reference_resolves(document: dict[str, Any]) -> None:
    references = {node["$ref"] for node in walk(document["paths"]) if "$ref" in node}
    references |= {node["$ref"] for node in walk(document["components"]) if isinstance(node.get("$ref"), str)}
    assert "#/components/schemas/Detection" in references
    for reference in references:
        node: Any = document
        for step in reference.removeprefix("#/").split("/"):
            node = node[step]


def test_every_example_fits_its_schema(document: dict[str, Any]) -> None:
    checked = []
    for place, content in contents(document):
        if "example" in content:
            validator(document, content["schema"]).validate(content["example"])
            checked.append(place)
    for wanted in ("request multipart/form-data", "request application/json", "200 application/json"):
        assert f"post /detect {wanted}" in checked


def test_detect_documents_every_status(document: dict[str, Any]) -> None:
    responses = document["paths"]["/detect"]["post"]["responses"]
    assert set(responses) == {"200"} | {str(status) for status in EXAMPLE_FAULTS}
    assert all("application/problem+json" in answer["content"] for name, answer in responses.items() if name != "200")
    assert "Retry-After" in responses["503"]["headers"]


def test_every_operation_says_which_key_it_needs(document: dict[str, Any]) -> None:
    schemes = document["components"]["securitySchemes"]
    assert {scheme["type"] for scheme in schemes.values()} == {"http", "apiKey"}
    for path, method, operation in operations(document):
        if path in ("/healthz", "/readyz"):
            assert operation["security"] == []
            continue
        assert [name for way in operation["security"] for name in way] == list(schemes)
        assert {"401", "403", "429"} <= set(operation["responses"]), (method, path)
        assert "Retry-After" in operation["responses"]["429"]["headers"]
    assert document["paths"]["/detect"]["post"]["security"][0] == {"bearerKey": ["detect"]}


def test_the_json_example_works(server: LiveServer, document: dict[str, Any]) -> None:
    body = document["paths"]["/detect"]["post"]["requestBody"]["content"]["application/json"]["example"]
    response = server.post_json(body)
    assert response.status_code == 200, response.text
    schema = {"$ref": "#/components/schemas/Detection"}
    validator(document, schema).validate(response.json())


def test_the_form_example_works(server: LiveServer) -> None:
    parts = example_form_request()
    files = {
        "source": ("source.png", example_image_png(), "image/png"),
        "target": ("target.png", example_image_png(1), "image/png"),
        "imu": ("imu.json", json.dumps(parts["imu"]), "application/json"),
        "request": ("request.json", json.dumps(parts["request"]), "application/json"),
    }
    assert server.post_form(files).status_code == 200


def test_the_schema_refuses_what_the_service_refuses(document: dict[str, Any]) -> None:
    body = document["paths"]["/detect"]["post"]["requestBody"]["content"]["application/json"]
    check = validator(document, body["schema"])
    for change in (
        {"extra": 1},
        {"imu": body["example"]["imu"] | {"gyro_rad_s": [[1, 2]]}},
        {"camera": body["example"]["camera"] | {"zoom": 1}},
        {"options": {"regions": {"unknown": 1}}},
    ):
        assert not check.is_valid(body["example"] | change), change


def test_problem_answers_fit_the_documented_schema(server: LiveServer, document: dict[str, Any]) -> None:
    check = validator(document, {"$ref": "#/components/schemas/Problem"})
    for response in (
        server.post_bytes(b"{}"),
        server.post_bytes(b"{"),
        server.client.get("/nowhere"),
        server.post_form({"x": ("x", b"1")}),
    ):
        check.validate(response.json())


def test_stored_detections_fit_the_documented_schema(document: dict[str, Any], tmp_path: Path) -> None:
    with live_server(lambda settings: RuleDetector(), store_url=str(tmp_path / "x.db")) as storing:
        kept = storing.post_json(json_request()).headers["x-detection-id"]
        answers = {
            "DetectionPage": storing.client.get("/detections", params={"limit": 1}).json(),
            "StoredDetection": storing.client.get(f"/detections/{kept}").json(),
        }
    for name, answer in answers.items():
        validator(document, {"$ref": f"#/components/schemas/{name}"}).validate(answer)


def test_the_stream_example_works_and_answers_as_documented(server: LiveServer, document: dict[str, Any]) -> None:
    body = document["paths"]["/streams/{stream_id}/frames"]["post"]["requestBody"]["content"]
    example = body["application/json"]["example"]
    answers = {"StreamAnswer": server.client.post("/streams/drone7/frames", json=example)}
    again = example | {"frame": example["frame"] | {"timestamp_ns": SOURCE_NS + INTERVAL_NS}}
    answers |= {"StreamAnswer ": server.client.post("/streams/drone7/frames", json=again)}
    answers |= {"StreamStatus": server.client.get("/streams/drone7"), "StreamList": server.client.get("/streams")}
    for name, answer in answers.items():
        assert answer.status_code == 200, answer.text
        validator(document, {"$ref": f"#/components/schemas/{name.strip()}"}).validate(answer.json())
    assert len(answers["StreamAnswer "].json()["detections"]) == 1
    form = body["multipart/form-data"]["example"]
    files = {
        "frame": ("frame.png", example_image_png(), "image/png"),
        **{name: (None, json.dumps(form[name]), "application/json") for name in ("imu", "request")},
    }
    assert server.client.post("/streams/drone8/frames", files=files).status_code == 200
    assert server.client.delete("/streams/drone8").status_code == 204


def test_the_parameters_of_a_list_are_documented(document: dict[str, Any]) -> None:
    for path, refused in (("/detections", ()), ("/detections.ndjson", ("limit", "cursor"))):
        documented = {one["name"] for one in document["paths"][path]["get"]["parameters"]}
        assert documented == {*FILTER_NAMES, "limit", "cursor"} - {*refused}


def test_the_parameters_of_the_lists_of_events_are_documented(document: dict[str, Any]) -> None:
    for path, refused in (("/events", ()), ("/events.ndjson", ("limit", "cursor"))):
        documented = {one["name"] for one in document["paths"][path]["get"]["parameters"]}
        assert documented == {*EVENT_FILTER_NAMES, "limit", "cursor"} - {*refused}


def test_docs_page_is_served(server: LiveServer) -> None:
    response = server.client.get("/docs")
    assert response.status_code == 200
    assert "/openapi.json" in response.text
