"""Requests that are wrong in one of many ways, from a seeded generator: what ``fuzz_inputs.py`` sends."""

from __future__ import annotations

import base64
import json
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from fuzzing.images import good_image, mutated

T0_NS = 1_700_000_000_000_000_000
INTERVAL_NS = 50_000_000
BOUNDARY = "viflow-fuzz"
FORM = f"multipart/form-data; boundary={BOUNDARY}"
INTEGERS = (0, -1, 1, 2**31, 2**53, 2**62, 2**63 - 1, 2**63, -(2**63) - 1, 10**25, -(10**400))
NUMBERS = (*INTEGERS, 0.5, -0.0, 1e-308, 5e-324, 1e308, float("nan"), float("inf"), -float("inf"))
TEXTS = (
    "",
    "0",
    "NaN",
    "null",
    "\0",
    "\ud800",
    "é" * 50,
    "a" * 5000,
    "../../etc/passwd",
    "'; DROP TABLE x;--",
    "%00",
    "{{7*7}}",
)
DEPTHS = (14, 15, 16, 17, 100, 2000, 100_000)


@dataclass(frozen=True)
class BadRequest:
    """One request, and by which rule it was made; ``path`` as it stands in the request line, the query with it."""

    kind: str
    method: str
    path: bytes
    body: bytes = b""
    headers: list[tuple[bytes, bytes]] = field(default_factory=list)


def imu_samples(count: int = 60) -> dict[str, Any]:
    stamps = list(range(T0_NS - 100_000_000, T0_NS - 100_000_000 + count * 5_000_000, 5_000_000))
    return {
        "timestamps_ns": stamps,
        "gyro_rad_s": [[0.01, -0.02, 0.1]] * count,
        "accel_m_s2": [[0.1, 0.2, 9.8]] * count,
    }


def rest() -> dict[str, Any]:
    identity = [[float(row == column) for column in range(4)] for row in range(4)]
    size = {"fx": 70.0, "fy": 70.0, "cx": 47.5, "cy": 31.5, "width": 96, "height": 64}
    lens = {"distortion_model": "radtan", "distortion_coeffs": [0.1, 0.0, 0.0, 0.0]}
    return {
        "camera": {**size, **lens, "T_cam_imu": identity, "time_offset_s": 0.0},
        "options": {"include_masks": True, "regions": {"threshold_mads": 6.0, "max_regions": 5}},
    }


def base64_text(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def pair_request(rng: random.Random) -> dict[str, Any]:
    """A good body of ``POST /detect``."""
    images = {
        name: {"timestamp_ns": T0_NS + number * INTERVAL_NS, "image_base64": base64_text(good_image(rng))}
        for number, name in enumerate(("source", "target"))
    }
    return {**images, "imu": imu_samples(), **(rest() if rng.random() < 0.5 else {})}


def stream_request(rng: random.Random) -> dict[str, Any]:
    """A good body of ``POST /streams/{id}/frames``."""
    frame = {"timestamp_ns": T0_NS + rng.randrange(40) * INTERVAL_NS, "image_base64": base64_text(good_image(rng))}
    return {"frame": frame, "imu": imu_samples(), **(rest() if rng.random() < 0.3 else {})}


def some_value(rng: random.Random, depth: int = 0) -> Any:
    """Any JSON value, the nasty ones often."""
    choice = rng.randrange(8 if depth < 3 else 6)
    if choice == 6:
        return [some_value(rng, depth + 1) for _ in range(rng.randrange(5))]
    if choice == 7:
        return {rng.choice(TEXTS): some_value(rng, depth + 1) for _ in range(rng.randrange(4))}
    return (None, rng.random() < 0.5, rng.choice(NUMBERS), rng.choice(TEXTS), rng.choice(INTEGERS), rng.gauss(0, 100))[
        choice
    ]


def places(node: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every place in a request but the root; of a long list the first members and the last one."""
    if at:
        yield at
    steps: list[Any] = list(node) if isinstance(node, dict) else []
    if isinstance(node, list):
        steps = sorted({*range(min(2, len(node))), *range(len(node))[-1:]})
    for step in steps:
        yield from places(node[step], (*at, step))


def with_wrong_places(rng: random.Random, request: dict[str, Any]) -> dict[str, Any]:
    """One to three members replaced, removed, renamed, shortened or doubled."""
    changed: dict[str, Any] = json.loads(json.dumps(request))
    for _ in range(rng.choice((1, 1, 2, 3))):
        place = rng.choice(list(places(changed)))
        parent: Any = changed
        for step in place[:-1]:
            parent = parent[step]
        last, action = place[-1], rng.randrange(6)
        if action == 0:
            del parent[last]
        elif action == 1 and isinstance(parent, dict):
            parent[rng.choice(TEXTS)] = parent.pop(last)
        elif action == 2 and isinstance(parent[last], list):
            parent[last] = (
                parent[last] * 2 if rng.random() < 0.5 else parent[last][: rng.randrange(len(parent[last]) + 1)]
            )
        elif action == 3 and isinstance(parent[last], list):
            rng.shuffle(parent[last])
        else:
            parent[last] = some_value(rng)
        if not changed:
            break
    return changed


def with_wrong_samples(rng: random.Random, request: dict[str, Any]) -> dict[str, Any]:
    """IMU samples that contradict themselves, do not cover, or are no numbers."""
    count = rng.choice((0, 1, 2, 59, 60, 61, 400, 1000, 1001))
    imu = imu_samples(count)
    for name in rng.sample(sorted(imu), rng.randint(1, 3)):
        if imu[name]:
            imu[name] = list(imu[name])
            number = rng.choice(NUMBERS)
            imu[name][rng.randrange(len(imu[name]))] = number if name == "timestamps_ns" else [0.0, number, number]
    if rng.random() < 0.3:
        scale = rng.choice((0, -1, 10**3, 10**6))
        imu["timestamps_ns"] = [stamp * scale if isinstance(stamp, int) else stamp for stamp in imu["timestamps_ns"]]
    if rng.random() < 0.2:
        imu[rng.choice(sorted(imu))] = [[0.0] * rng.choice((0, 2, 3, 4, 1000))] * rng.choice((0, 1, 60))
    return request | {"imu": imu}


def image_bytes(text: Any) -> bytes:
    """What base64 says; nothing where it is none."""
    try:
        return base64.b64decode(text)
    except (TypeError, ValueError):
        return b""


def as_form(rng: random.Random, request: dict[str, Any]) -> bytes:
    """The multipart form that says the same; what has no place in one is left out."""
    imu = dict(request["imu"]) if isinstance(request.get("imu"), dict) else request.get("imu")
    parts: list[tuple[str, bytes]] = []
    for name in ("source", "target", "frame"):
        part = request.get(name)
        if isinstance(part, dict):
            if isinstance(imu, dict) and "timestamp_ns" in part:
                imu[f"{name}_timestamp_ns"] = part["timestamp_ns"]
            parts.append((name, image_bytes(part.get("image_base64"))))
    parts.append(("imu", json.dumps(imu).encode()))
    parts.append(
        ("request", json.dumps({name: request[name] for name in ("camera", "options") if name in request}).encode())
    )
    rng.shuffle(parts)
    body = b"".join(
        f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="{name}"; filename="x"\r\n\r\n'.encode()
        + content
        + b"\r\n"
        for name, content in parts
    )
    return body + f"--{BOUNDARY}--\r\n".encode()


def with_wrong_image(rng: random.Random, request: dict[str, Any], image: bytes) -> dict[str, Any]:
    name = rng.choice([name for name in ("source", "target", "frame") if name in request])
    return request | {name: request[name] | {"image_base64": base64_text(image)}}


def odd_form(rng: random.Random, request: dict[str, Any]) -> tuple[bytes, str]:
    """Parts without names, twice, too many, without end; boundaries that do not match."""
    good = as_form(rng, request)
    line = f"--{BOUNDARY}\r\n".encode()
    end = f"--{BOUNDARY}--\r\n".encode()
    part = line + b'Content-Disposition: form-data; name="imu"\r\n\r\n{}\r\n'
    bodies = (
        good[: rng.randrange(len(good))],
        mutated(rng, good[:400]) + good[400:],
        mutated(rng, good),
        part * rng.choice((2, 15, 16, 17, 3000)) + end,
        line + b"Content-Disposition: form-data\r\n\r\nx\r\n" + end,
        line + b'Content-Disposition: form-data; name="' + rng.randbytes(30) + b'"\r\n\r\nx\r\n' + end,
        line + b"A: " + b"b" * rng.choice((100, 10_000, 1_000_000)) + b"\r\n\r\nx\r\n" + end,
        line + b"A: b\r\n" * rng.choice((10, 5000)) + b"\r\nx\r\n" + end,
        good.replace(b"\r\n", rng.choice((b"\n", b"\r", b"\r\n\r\n"))),
        end,
        b"",
        good + rng.randbytes(50),
        line * rng.choice((2, 1000)),
    )
    boundary = rng.choice((BOUNDARY, BOUNDARY, BOUNDARY, BOUNDARY[:-1], "x" * 70, "x" * 5000, "", '"', "a b", "\xe9"))
    return rng.choice(bodies), f"multipart/form-data; boundary={boundary}"


def deep(rng: random.Random) -> bytes:
    """Nested, at the root or in a member; closed or not."""
    depth, (opening, closing) = rng.choice(DEPTHS), rng.choice((("[", "]"), ('{"a":', "}")))
    text = opening * depth + ("1" if rng.random() < 0.8 else "") + closing * rng.choice((depth, depth - 1, 0))
    return (text if rng.random() < 0.5 else '{"imu":' + text + "}").encode()


def twice(rng: random.Random, request: dict[str, Any]) -> bytes:
    """A member of the root twice, equal or not."""
    text = json.dumps(request)
    name = rng.choice(sorted(request))
    return f"{text[:-1]}, {json.dumps(name)}: {json.dumps(rng.choice((request[name], None, 1)))}}}".encode()


def any_bytes(rng: random.Random) -> bytes:
    start = rng.choice((b"", b"{", b"[", b'{"source":', b"\xef\xbb\xbf{", b"\xff\xfe{\0"))
    return start + rng.randbytes(rng.choice((0, 1, 10, 300)))


def odd_numbers(rng: random.Random, request: dict[str, Any]) -> bytes:
    """Numbers as no writer writes them: a million digits, exponents without end, plus signs, hexadecimals."""
    digits = rng.choice((20, 21, 400, 4299, 4301, 100_000))
    number = rng.choice(
        ("9" * digits, "-" + "9" * digits, "1e" + "9" * 5, "1e-99999", "+1", "0x10", "01", ".5", "1_0", "-")
    )
    text = json.dumps(request)
    found = [place for place in range(len(text)) if text.startswith((": 1", ": 7", ": 0", "[0"), place)]
    place = rng.choice(found)
    start = place + (2 if text[place] == ":" else 1)
    end = next(at for at in range(start, len(text)) if text[at] in ",}] ")
    return (text[:start] + number + text[end:]).encode()


JSON_BODIES: dict[str, Callable[[random.Random, dict[str, Any]], bytes]] = {
    "any bytes": lambda rng, request: any_bytes(rng),
    "any value": lambda rng, request: json.dumps(some_value(rng)).encode(),
    "deep": lambda rng, request: deep(rng),
    "member twice": twice,
    "odd numbers": odd_numbers,
    "damaged text": lambda rng, request: mutated(rng, json.dumps(request).encode()),
}
"""Name of what is wrong -> a body of type JSON that is wrong like that, made of a good request."""
