"""Requests and answers shown in the OpenAPI document; the tests post the requests and validate the answers."""

from __future__ import annotations

import base64
from typing import Any, Final

import cv2
import numpy as np

SOURCE_NS: Final = 1_700_000_000_000_000_000
INTERVAL_NS: Final = 50_000_000
_IMU_STEP_NS: Final = 5_000_000
_WIDTH, _HEIGHT = 96, 64

EXAMPLE_CAMERA: Final[dict[str, Any]] = {
    "fx": 70.0,
    "fy": 70.0,
    "cx": 47.5,
    "cy": 31.5,
    "width": _WIDTH,
    "height": _HEIGHT,
    "distortion_model": "none",
    "distortion_coeffs": [],
    "T_cam_imu": [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
    "time_offset_s": 0.0,
}

EXAMPLE_OPTIONS: Final[dict[str, Any]] = {"include_masks": True, "regions": {"threshold_mads": 7.0}}

EXAMPLE_DETECTION: Final[dict[str, Any]] = {
    "schema_version": "1.0",
    "source_timestamp_ns": SOURCE_NS,
    "target_timestamp_ns": SOURCE_NS + INTERVAL_NS,
    "image": {"width": 752, "height": 480},
    "status": "ok",
    "reasons": [],
    "model": {"name": "compact", "version": "1", "sha256": "0" * 64},
    "rois": [
        {
            "id": 1,
            "track_id": None,
            "label": "independent_motion",
            "score": 0.87,
            "bbox": {"x": 402, "y": 188, "width": 61, "height": 44},
            "x_extent_px": 61.0,
            "y_extent_px": 44.0,
            "area_px": 1893.0,
            "thickness_px": 31.5,
            "residual_mean": 38.2,
            "residual_max": 121.0,
            "evidence": {"rule": "extended in x and y"},
        }
    ],
    "region_analyzed": {"x": 0, "y": 0, "width": 752, "height": 480},
    "residual": {"mean": 4.1, "median": 2.6, "p95": 12.9},
    "timings_ms": {"decode": 4.0, "inference": 9.8, "regions": 3.1, "total": 16.9},
}

# status -> (code, detail, field): one example of each.
EXAMPLE_FAULTS: Final[dict[int, tuple[str, str, str | None]]] = {
    400: ("json_invalid", "expected JSON, found: Expecting value at line 1 column 9", None),
    401: ("key_missing", "expected an API key in 'Authorization: Bearer KEY' or 'X-API-Key: KEY', found none", None),
    403: ("scope_missing", "expected a key of scope detect, found one of read", None),
    408: ("body_timeout", "expected the whole body within 30 s, found 65536 bytes of it", None),
    413: ("image_too_many_pixels", "source: expected at most 16777216 pixels, found 60000x60000", "source"),
    415: (
        "image_unsupported_type",
        "target: expected a PNG or JPEG file, found one that starts with b'<html>'",
        "target",
    ),
    422: ("image_sizes_differ", "target: expected the source's size 752x480, found 640x480", "target"),
    429: ("rate_limited", "expected at most 5 requests a second (20 at once), found more", None),
    500: ("internal_error", "The service failed unexpectedly; its log has the request_id.", None),
    503: ("overloaded", "The service is busy: all 34 places are taken.", None),
}


def example_image_png(shift_px: int = 0) -> bytes:
    """A small checkered 8-bit gray PNG, moved to the left by ``shift_px``."""
    v, u = np.mgrid[0:_HEIGHT, 0:_WIDTH]
    gray = ((u + shift_px) // 8 * 37 + v // 8 * 59) % 200 + 28
    return bytes(cv2.imencode(".png", gray.astype(np.uint8))[1])


def example_imu(*, stamped: bool) -> dict[str, Any]:
    """IMU samples at 200 Hz around the interval, at rest but for a slow yaw; ``stamped`` as in multipart requests."""
    first, last = SOURCE_NS - 2 * INTERVAL_NS, SOURCE_NS + 2 * INTERVAL_NS
    stamps = list(range(first, last + 1, _IMU_STEP_NS))
    imu: dict[str, Any] = {
        "timestamps_ns": stamps,
        "gyro_rad_s": [[0.0, 0.0, 0.2]] * len(stamps),
        "accel_m_s2": [[0.0, 0.0, 9.81]] * len(stamps),
    }
    if stamped:
        imu |= {"source_timestamp_ns": SOURCE_NS, "target_timestamp_ns": SOURCE_NS + INTERVAL_NS}
    return imu


def example_json_request() -> dict[str, Any]:
    """A whole request in JSON that the service answers with 200."""

    def image(stamp: int, shift_px: int) -> dict[str, Any]:
        return {"timestamp_ns": stamp, "image_base64": base64.b64encode(example_image_png(shift_px)).decode("ascii")}

    return {
        "source": image(SOURCE_NS, 0),
        "target": image(SOURCE_NS + INTERVAL_NS, 1),
        "imu": example_imu(stamped=False),
        "camera": EXAMPLE_CAMERA,
        "options": EXAMPLE_OPTIONS,
    }


def example_form_request() -> dict[str, Any]:
    """The parts of a multipart request; the two files are named, not shown."""
    return {
        "source": "(bytes of source.png)",
        "target": "(bytes of target.png)",
        "imu": example_imu(stamped=True),
        "request": {"camera": EXAMPLE_CAMERA, "options": EXAMPLE_OPTIONS},
    }
