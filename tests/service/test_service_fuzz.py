"""Property: whatever bytes arrive, the answer is 200 or a problem below 500."""

from __future__ import annotations

import json
import random
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rule_detector import RuleDetector
from service_world import (
    LiveServer,
    base64_text,
    camera_part,
    form_request,
    gray_image,
    json_request,
    live_server,
    png,
    problem_of,
)

pytestmark = pytest.mark.timeout(120)
FUZZ = settings(max_examples=80, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)


@pytest.fixture(scope="module")
def server() -> Iterator[LiveServer]:
    limits = {"max_image_pixels": 1_000_000, "max_image_bytes": 1_000_000, "max_imu_samples": 1000}
    with live_server(lambda settings: RuleDetector(), **limits) as running:
        yield running


def assert_no_fault_of_ours(response: httpx.Response) -> None:
    if response.status_code != 200:
        assert response.status_code < 500, response.text
        assert problem_of(response)["code"]


JSON_VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from([2**31, 2**53, 2**63, -(2**63), 10**25, 10**400])
    | st.floats(allow_nan=True, allow_infinity=True)
    | st.text(max_size=20)
    | st.text(alphabet=st.characters(categories=["Cs", "Cc"]), max_size=3),
    lambda children: st.lists(children, max_size=5) | st.dictionaries(st.text(max_size=8), children, max_size=5),
    max_leaves=20,
)


@FUZZ
@given(body=st.binary(max_size=300))
def test_any_bytes_as_json(server: LiveServer, body: bytes) -> None:
    assert_no_fault_of_ours(server.post_bytes(body))


@FUZZ
@given(value=JSON_VALUES)
def test_any_json(server: LiveServer, value: Any) -> None:
    assert_no_fault_of_ours(server.post_json(value))


def paths(node: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Places in a request, long lists entered at their first member only."""
    yield at
    children = node.items() if isinstance(node, dict) else list(enumerate(node))[:1] if isinstance(node, list) else ()
    for key, child in children:
        yield from paths(child, (*at, key))


REQUEST = json_request(
    camera=camera_part() | {"T_cam_imu": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "time_offset_s": 0},
    options={"include_masks": True, "regions": {"threshold_mads": 6.0, "max_regions": 5}},
)


@FUZZ
@given(path=st.sampled_from([path for path in paths(REQUEST) if path]), value=JSON_VALUES, key=st.text(max_size=5))
def test_one_wrong_value_or_key(server: LiveServer, path: tuple[Any, ...], value: Any, key: str) -> None:
    request = json.loads(json.dumps(REQUEST))
    parent = request
    for step in path[:-1]:
        parent = parent[step]
    parent[path[-1]] = value
    assert_no_fault_of_ours(server.post_json(request))
    if isinstance(parent, dict):
        parent[key] = parent.pop(path[-1])
        assert_no_fault_of_ours(server.post_json(request))


def mutated(data: bytes, seed: int) -> bytes:
    """Cut, doubled, overwritten or flipped in a few places."""
    rng = random.Random(seed)  # noqa: S311 - no secret
    for _ in range(rng.randint(1, 3)):
        start = rng.randrange(len(data) + 1)
        end = min(len(data), start + rng.choice([1, 1, 2, 8, 200]))
        middle = rng.choice([b"", data[start:end] * 2, rng.randbytes(end - start), b"\r\n", b"--", b"\xff\xff\xff\xff"])
        data = data[:start] + middle + data[end:]
    return data


@FUZZ
@given(seed=st.integers(0, 2**32))
def test_damaged_forms(server: LiveServer, seed: int) -> None:
    built = server.client.build_request("POST", "/detect", files=form_request(seed=seed % 3))
    body = built.read()
    focus = random.Random(seed).choice([300, 1000, len(body)])  # noqa: S311 - headers are hit as often as content
    damaged = mutated(body[:focus], seed) + body[focus:]
    assert_no_fault_of_ours(server.post_bytes(damaged, built.headers["content-type"]))


@FUZZ
@given(seed=st.integers(0, 2**32))
def test_damaged_json_text(server: LiveServer, seed: int) -> None:
    assert_no_fault_of_ours(server.post_bytes(mutated(json.dumps(REQUEST).encode(), seed)))


@FUZZ
@given(seed=st.integers(0, 2**32))
def test_damaged_images(server: LiveServer, seed: int) -> None:
    request = json_request()
    request["source"]["image_base64"] = base64_text(mutated(png(gray_image()), seed))
    assert_no_fault_of_ours(server.post_json(request))


@FUZZ
@given(content_type=st.text(alphabet=st.characters(min_codepoint=32, max_codepoint=126), max_size=60))
def test_any_content_type(server: LiveServer, content_type: str) -> None:
    for header in (content_type, "multipart/form-data;" + content_type, "application/json;" + content_type):
        assert_no_fault_of_ours(server.post_bytes(b"--a\r\n\r\n--a--", header.strip()))


@FUZZ
@given(request_id=st.binary(max_size=100))
def test_any_request_id(server: LiveServer, request_id: bytes) -> None:
    cleaned = bytes(byte for byte in request_id if byte >= 32 and byte != 127).strip()
    response = server.client.get("/nowhere", headers=[(b"X-Request-ID", cleaned)])
    assert_no_fault_of_ours(response)
