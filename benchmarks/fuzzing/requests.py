"""Whole requests that are wrong: endpoint, head and body; see ``bodies.py`` and ``images.py``."""

from __future__ import annotations

import json
import random
from typing import Any
from urllib.parse import quote_from_bytes

from fuzzing.bodies import (
    FORM,
    INTEGERS,
    JSON_BODIES,
    NUMBERS,
    TEXTS,
    BadRequest,
    as_form,
    odd_form,
    pair_request,
    stream_request,
    with_wrong_image,
    with_wrong_places,
    with_wrong_samples,
)
from fuzzing.images import IMAGES, mutated

BODY_SHARE = 0.9
TYPES = (
    "",
    "application/json",
    "application/json; charset=utf-16",
    "APPLICATION/JSON;;;",
    "text/plain",
    "multipart/form-data",
    "multipart/form-data; boundary",
    'multipart/form-data; boundary="',
    "multipart/mixed; boundary=a",
    "application/x-www-form-urlencoded",
    "application/json, text/html",
    "a" * 8000,
)
METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE", "get", "A" * 60)
PATHS = (
    "/",
    "/detect",
    "/detect/",
    "/streams",
    "/streams/a",
    "/streams/a/frames",
    "/detections",
    "/detections.ndjson",
    "/healthz",
    "/readyz",
    "/version",
    "/models",
    "/metrics",
    "/openapi.json",
    "/docs",
    "/schemas/detection-1.0.json",
)
PARAMETERS = ("stream", "from_ns", "to_ns", "label", "min_score", "order", "limit", "cursor", "colour", "")
HEADERS = (
    "X-Request-ID",
    "Authorization",
    "X-API-Key",
    "Origin",
    "Accept",
    "Content-Encoding",
    "Expect",
    "Range",
    "If-None-Match",
    "Transfer-Encoding",
    "Forwarded",
    "Cookie",
    "traceparent",
    "Content-Length",
)


def bad_request(rng: random.Random) -> BadRequest:
    """The next one. Few are good by chance; those must be answered, too."""
    return _with_body(rng) if rng.random() < BODY_SHARE else _without_body(rng)


def _with_body(rng: random.Random) -> BadRequest:
    stream = rng.random() < 0.35
    path = f"/streams/{rng.choice('abcdefgh')}/frames".encode() if stream else b"/detect"
    request = stream_request(rng) if stream else pair_request(rng)
    where = "stream" if stream else "detect"
    choice = rng.randrange(10)
    if choice < 4:
        name = rng.choice(sorted(IMAGES))
        return _sent(rng, f"{where}: image, {name}", path, with_wrong_image(rng, request, IMAGES[name](rng)))
    if choice < 6:
        return _sent(rng, f"{where}: wrong samples", path, with_wrong_samples(rng, request))
    if choice < 8:
        return _sent(rng, f"{where}: wrong members", path, with_wrong_places(rng, request))
    if choice == 8:
        body, content_type = odd_form(rng, request)
        return BadRequest(f"{where}: odd form", "POST", path, body, [(b"content-type", content_type.encode("latin-1"))])
    name = rng.choice(sorted(JSON_BODIES))
    body = JSON_BODIES[name](rng, request)
    return BadRequest(f"{where}: JSON, {name}", "POST", path, body, [(b"content-type", b"application/json")])


def _sent(rng: random.Random, kind: str, path: bytes, request: dict[str, Any]) -> BadRequest:
    """As JSON or as a form."""
    is_form = rng.random() < 0.5
    body = as_form(rng, request) if is_form else json.dumps(request).encode()
    headers = [(b"content-type", FORM.encode() if is_form else b"application/json")]
    if rng.random() < 0.1:
        headers.append(_odd_header(rng))
    return BadRequest(kind, "POST", path, body, headers)


def _without_body(rng: random.Random) -> BadRequest:
    choice = rng.randrange(4)
    if choice == 0:
        path = rng.choice(("/detections", "/detections.ndjson"))
        query = "&".join(f"{rng.choice(PARAMETERS)}={_query_value(rng)}" for _ in range(rng.randint(1, 4)))
        return BadRequest("query", "GET", f"{path}?{query}".encode())
    if choice == 1:
        name = quote_from_bytes(rng.randbytes(rng.choice((1, 8, 16, 300))))
        path = rng.choice(("/detections/", "/streams/", "/streams/x/", "/schemas/", "/")) + name
        return BadRequest("path", rng.choice(("GET", "DELETE", "POST")), path.encode())
    if choice == 2:
        body = rng.randbytes(rng.choice((0, 10, 1000)))
        path = rng.choice(PATHS).encode()
        method = rng.choice(METHODS)
        return BadRequest(
            "method and headers", method, path, body, [_odd_header(rng) for _ in range(rng.randint(0, 4))]
        )
    content_type = rng.choice(TYPES).encode()
    body = json.dumps(pair_request(rng)).encode()
    return BadRequest("content type", "POST", b"/detect", body, [(b"content-type", mutated(rng, content_type).strip())])


def _query_value(rng: random.Random) -> str:
    value = rng.choice((rng.choice(INTEGERS), rng.choice(NUMBERS), rng.choice(TEXTS), rng.randbytes(8)))
    return quote_from_bytes(value if isinstance(value, bytes) else str(value).encode("utf-8", "surrogatepass"))


def _odd_header(rng: random.Random) -> tuple[bytes, bytes]:
    value = rng.choice(
        (rng.randbytes(20), b"a" * 5000, b"", rng.choice(TEXTS).encode("utf-8", "surrogatepass"), b"gzip")
    )
    printable = bytes(byte for byte in value if byte >= 32 and byte != 127)
    return rng.choice(HEADERS).lower().encode(), printable.strip()
