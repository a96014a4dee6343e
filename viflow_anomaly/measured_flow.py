"""What the two images themselves say of the motion: dense inverse search flow and how far to trust it.

The measurement corrects the network's prediction (``correction``); it never replaces it: where nothing can be measured
(no texture, occlusion, edge of the image) the prediction stands alone.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from viflow_anomaly.geometry import Float32Array, pixel_grid
from viflow_anomaly.sensor_data import Uint8Array

TEXTURE_GRAY2 = 2.0
"""Smaller eigenvalue of the structure tensor (gray levels^2 a pixel^2) at which a cell is half trusted."""
MISMATCH_GRAY = 8.0
"""Photometric difference after the measured flow at which a cell is half trusted."""
WINDOW_PX = 5
"""On the halved picture: 10 px of the view."""
FINEST_SCALE = 1
"""Inverse search stops at half the view's resolution."""
MIN_SIDE_PX = 32
"""Inverse search needs a few patches of 8 pixels along each side of its finest level."""


class MeasuredFlow(NamedTuple):
    """Flow in cells of ``stride`` pixels, each centred as in ``ViflowOutput``.

    Attributes:
        flow_px: [h, w, 2] float32 in pixels of the images.
        confidence: [h, w] float32 in 0..1.
        stride: pixels for one cell.
    """

    flow_px: Float32Array
    confidence: Float32Array
    stride: int


def measure_flow(source: Uint8Array, target: Uint8Array, *, stride: int) -> MeasuredFlow:
    """Measure the flow between two views [H, W]; sides are multiples of ``stride``.

    Source: Kroeger et al., Fast Optical Flow using Dense Inverse Search (ECCV 2016); OpenCV's preset "ultrafast", one
    level finer, because views are small.
    """
    height, width = source.shape
    cells = (width // stride, height // stride)
    if min(height, width) < MIN_SIDE_PX:
        return MeasuredFlow(np.zeros((*cells[::-1], 2), np.float32), np.zeros(cells[::-1], np.float32), stride)
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)  # type: ignore[attr-defined]
    search.setFinestScale(FINEST_SCALE)
    flow = search.calc(source, target, None)
    matched = cv2.remap(  # type: ignore[call-overload]  # the stubs lack the two-channel map
        target, pixel_grid(height, width) + flow, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0
    )
    mismatch = cv2.resize(cv2.absdiff(matched, source), cells, interpolation=cv2.INTER_AREA).astype(np.float32)
    texture = _texture(source, cells)
    confidence = texture / (texture + TEXTURE_GRAY2) / (1 + (mismatch / MISMATCH_GRAY) ** 2)
    flow_px = cv2.resize(flow, cells, interpolation=cv2.INTER_AREA)
    return MeasuredFlow(np.asarray(flow_px, dtype=np.float32), confidence.astype(np.float32), stride)


def _texture(image: Uint8Array, cells: tuple[int, int]) -> Float32Array:
    """Smaller eigenvalue of the structure tensor [h, w]: near zero on plain surfaces and along straight edges."""
    half = cv2.pyrDown(image)
    dx = cv2.Sobel(half, cv2.CV_32F, 1, 0, scale=1 / 16)
    dy = cv2.Sobel(half, cv2.CV_32F, 0, 1, scale=1 / 16)
    blurred = [cv2.blur(product, (WINDOW_PX, WINDOW_PX)) for product in (dx * dx, dy * dy, dx * dy)]
    xx, yy, xy = (cv2.resize(product, cells, interpolation=cv2.INTER_AREA) for product in blurred)
    half_trace, half_difference = (xx + yy) / 2, (xx - yy) / 2
    smaller = half_trace - np.sqrt(half_difference * half_difference + xy * xy)
    return np.asarray(np.maximum(smaller, 0.0), dtype=np.float32)
