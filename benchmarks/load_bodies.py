"""Requests of ``POST /detect`` made of a pair in a folder such as samples/drone, as a form or as JSON.

python benchmarks/load_bodies.py --out request.bin    # what load_client.py sends
"""

from __future__ import annotations

import argparse
import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2

ROOT = Path(__file__).resolve().parents[1]
BOUNDARY = "viflow-load"


def request_parts(sample: Path, width: int, height: int) -> tuple[dict[str, bytes], dict[str, Any], dict[str, Any]]:
    """The sample's pair as JPEG by name, resized, its IMU part and its request part with the resized camera."""
    imu = json.loads((sample / "imu.json").read_text(encoding="utf-8"))
    request = json.loads((sample / "request.json").read_text(encoding="utf-8"))
    images: dict[str, bytes] = {}
    camera = request["camera"]
    scale_x, scale_y = width / camera["width"], height / camera["height"]
    camera |= {"fx": camera["fx"] * scale_x, "fy": camera["fy"] * scale_y, "width": width, "height": height}
    camera |= {"cx": (camera["cx"] + 0.5) * scale_x - 0.5, "cy": (camera["cy"] + 0.5) * scale_y - 0.5}
    for name in ("source", "target"):
        image = cv2.imread(str(sample / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise SystemExit(f"error: {sample / name}.png: expected an image")
        resized = cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC)
        images[name] = cv2.imencode(".jpg", resized, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
    return images, imu, request


def form_body(images: dict[str, bytes], imu: dict[str, Any], request: dict[str, Any]) -> bytes:
    parts = images | {"imu": json.dumps(imu).encode(), "request": json.dumps(request).encode()}
    body = b"".join(
        f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n'.encode() + content + b"\r\n"
        for name, content in parts.items()
    )
    return body + f"--{BOUNDARY}--\r\n".encode()


def json_body(images: dict[str, bytes], imu: dict[str, Any], request: dict[str, Any]) -> bytes:
    imu = dict(imu)
    pair = {
        name: {"timestamp_ns": imu.pop(f"{name}_timestamp_ns"), "image_base64": base64.b64encode(image).decode()}
        for name, image in images.items()
    }
    return json.dumps(request | pair | {"imu": imu}).encode()


BODIES: dict[str, tuple[str, Callable[[dict[str, bytes], dict[str, Any], dict[str, Any]], bytes]]] = {
    "form": (f"multipart/form-data; boundary={BOUNDARY}", form_body),
    "json": ("application/json", json_body),
}
"""Kind of request -> its Content-Type, and how its body is made."""


def head(content_type: str, body: bytes) -> bytes:
    """What stands before the body."""
    lines = (
        "POST /detect HTTP/1.1",
        "Host: localhost",
        f"Content-Type: {content_type}",
        f"Content-Length: {len(body)}",
    )
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


def main() -> None:
    parser = argparse.ArgumentParser(description="Write one whole request to a file.")
    parser.add_argument("--sample", type=Path, default=ROOT / "samples" / "drone", help="a pair as in samples/drone")
    parser.add_argument("--size", default="720x480", help="WIDTHxHEIGHT of the pair (default 720x480)")
    parser.add_argument("--body", choices=sorted(BODIES), default="form", help="how it is sent (default form)")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    width, height = (int(side) for side in arguments.size.split("x"))
    content_type, make_body = BODIES[arguments.body]
    body = make_body(*request_parts(arguments.sample, width, height))
    arguments.out.write_bytes(head(content_type, body) + body)


if __name__ == "__main__":
    main()
