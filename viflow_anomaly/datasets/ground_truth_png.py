"""The pictures of ground truth: depth, flow, masks.

Flow PNGs are KITTI's: 16 bit, three channels, value = 64 * flow + 2^15, third channel 1 where valid. Depth PNGs are
16 bit, 256 steps a metre, 0 where nothing is known. Masks are 8 bit. Every file is
written beside its place and renamed.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.config import ImageLimits
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.images import read_image_size
from viflow_anomaly.sensor_data import Uint8Array

Float32Array = NDArray[np.float32]
BoolArray = NDArray[np.bool_]

FLOW_STEPS_PER_PX = 64.0
FLOW_ZERO = 2**15
DEPTH_STEPS_PER_M = 256.0
UINT16_MAX = 65535
LIMITS = ImageLimits()
PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
"""OpenCV reads a file that ends before it without complaint."""


def _write_png(path: Path, image: NDArray[Any]) -> None:
    encoded, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert encoded
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")  # two runs may write one picture
    partial.write_bytes(data.tobytes())
    partial.replace(path)


def _read_png(path: Path, channels: int, kind: str, dtype: type[np.unsignedinteger[Any]]) -> NDArray[Any]:
    data = _checked_bytes(path, kind)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise DatasetError(
            f"{path}: expected a {kind} PNG, found {len(data)} bytes that are none", code="ground_truth_malformed"
        )
    shape = image.shape[2] if image.ndim == 3 else 1
    if shape != channels or image.dtype != dtype:
        raise DatasetError(
            f"{path}: expected a {kind} PNG of {channels} channel(s) of {np.dtype(dtype)}, "
            f"found {shape} of {image.dtype}",
            code="ground_truth_malformed",
        )
    return np.asarray(image)


def _checked_bytes(path: Path, kind: str) -> bytes:
    """The file, if its size and its header promise no more than an image may have, and if it reaches its end."""
    try:
        read_image_size(path, limits=LIMITS, field=f"{kind} PNG")
        data = path.read_bytes()
    except (DatasetError, OSError) as err:
        raise DatasetError(
            f"{path}: expected a {kind} PNG, cannot read it: {err}", code="ground_truth_missing"
        ) from err
    except InvalidInputError as err:
        raise DatasetError(err.message, code="ground_truth_malformed") from err
    if PNG_END not in data:
        raise DatasetError(
            f"{path}: expected a {kind} PNG, found {len(data)} bytes without a PNG's last chunk",
            code="ground_truth_malformed",
        )
    return data


def write_flow_png(path: Path, flow: Float32Array, valid: BoolArray) -> None:
    """Store flow [H, W, 2] (px) and validity [H, W]; flow that does not fit (beyond +-512 px) becomes invalid."""
    steps = np.rint(np.where(np.isfinite(flow), flow, 1e9).astype(np.float64) * FLOW_STEPS_PER_PX + FLOW_ZERO)
    stored = valid & ((steps >= 0) & (steps <= UINT16_MAX)).all(axis=-1)
    steps = np.where(stored[..., None], steps, 0)
    # OpenCV writes channels in the order B, G, R: valid, v, u.
    channels = np.stack([stored.astype(np.float64), steps[..., 1], steps[..., 0]], axis=-1)
    _write_png(path, channels.astype(np.uint16))


def read_flow_png(path: Path) -> tuple[Float32Array, BoolArray]:
    """Flow [H, W, 2] float32 in px (0 where invalid) and validity [H, W].

    Raises:
        DatasetError: ``ground_truth_missing``, ``ground_truth_malformed``.
    """
    image = _read_png(path, 3, "KITTI flow", np.uint16)
    valid = image[..., 0] > 0
    flow = (image[..., :0:-1].astype(np.float32) - FLOW_ZERO) / FLOW_STEPS_PER_PX
    return np.where(valid[..., None], flow, np.float32(0)), valid


def write_depth_png(path: Path, depth_m: Float32Array) -> None:
    """Store depth [H, W] in metres; what is not finite or does not fit (256 m) is stored as 0."""
    steps = np.rint(np.where(np.isfinite(depth_m), depth_m, 0.0).astype(np.float64) * DEPTH_STEPS_PER_M)
    _write_png(path, np.where((steps >= 1) & (steps <= UINT16_MAX), steps, 0).astype(np.uint16))


def read_depth_png(path: Path) -> Float32Array:
    """Depth [H, W] float32 in metres along the optical axis, inf where nothing was hit.

    Raises:
        DatasetError: ``ground_truth_missing``, ``ground_truth_malformed``.
    """
    image = _read_png(path, 1, "depth", np.uint16)
    return np.where(image > 0, image.astype(np.float32) / np.float32(DEPTH_STEPS_PER_M), np.float32(np.inf))


def write_instances_png(path: Path, instances: Uint8Array) -> None:
    """Store instance numbers [H, W] uint8 (0 static, 1.. movers)."""
    _write_png(path, instances)


def read_instances_png(path: Path) -> Uint8Array:
    """Instance numbers [H, W] uint8.

    Raises:
        DatasetError: ``ground_truth_missing``, ``ground_truth_malformed``.
    """
    return np.asarray(_read_png(path, 1, "instance", np.uint8), dtype=np.uint8)


def write_mask_png(path: Path, mask: BoolArray) -> None:
    """Store a mask [H, W]: 255 where it is set."""
    _write_png(path, np.where(mask, 255, 0).astype(np.uint8))


def read_mask_png(path: Path) -> BoolArray:
    """A mask [H, W].

    Raises:
        DatasetError: ``ground_truth_missing``, ``ground_truth_malformed``.
    """
    return np.asarray(_read_png(path, 1, "mask", np.uint8) > 0)
