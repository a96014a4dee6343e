"""What the two images themselves say of the motion: dense inverse search flow and how far to trust it.

The measurement corrects the network's prediction (``correction``); it never replaces it: where nothing can be measured
(no texture, occlusion, edge of the image) the prediction stands alone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np

from viflow_anomaly.geometry import Float32Array, cached_pixel_grid, sample_bilinear
from viflow_anomaly.sensor_data import Uint8Array

TEXTURE_GRAY2 = 2.0
"""Smaller eigenvalue of the structure tensor of the halved view (gray levels^2 a pixel^2) that is half trusted."""
MISMATCH_GRAY = 8.0
"""Photometric difference after the measured flow that is half trusted."""
WINDOW_PX = 5
"""Of the structure tensor, on the halved view."""
FINEST_SCALE = 1
"""Inverse search stops at half the view's resolution, and so does the judgement of its flow."""
PATCH_STRIDE_PX, DESCENT_STEPS = 6, 8
"""Patches of 8 px overlap by two, and few steps do, because the search starts near its end: a third less time than with
the preset's 4 and 12 for the same corrected error on held-out sequences."""
MAX_LOCAL_STEP_PX = 4.0
"""Of the local refinement along x and along y: beyond it, gradients say nothing."""
LOCAL_PRIOR_GRAY2 = 6.0
"""Added to the squared gradients: where there is no texture, nothing moves."""
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


def measure_flow(
    source: Uint8Array,
    target: Uint8Array,
    *,
    stride: int,
    around: Float32Array | None = None,
    thorough: bool = False,
) -> MeasuredFlow:
    """Measure the flow between two views.

    Args:
        source, target: [H, W]; sides are multiples of ``stride``, and even.
        stride: pixels for one cell of the result.
        around: [h, w, 2] a flow on the cells from which the search starts; None: from no motion. A motion of more than
            some ten pixels is found from a guess only.
        thorough: better where texture is weak, at three times the time.

    Source: Kroeger et al., Fast Optical Flow using Dense Inverse Search (ECCV 2016); OpenCV's preset "ultrafast"
    ("medium" if ``thorough``), one level finer, because views are small.
    """
    height, width = source.shape
    cells = (width // stride, height // stride)
    if min(height, width) < MIN_SIDE_PX:
        return MeasuredFlow(np.zeros((*cells[::-1], 2), np.float32), np.zeros(cells[::-1], np.float32), stride)
    search = _thorough_search() if thorough else _fast_search()
    if around is None:
        flow = search.calc(source, target, None)
    else:
        guess = cv2.resize(around, (width, height), interpolation=cv2.INTER_LINEAR)
        grid = cached_pixel_grid(height, width)
        flow = search.calc(source, sample_bilinear(target, grid + guess), None)
        flow = flow + sample_bilinear(guess, grid + flow)  # where a pixel of the moved target came from
    flow_px = np.asarray(cv2.resize(flow, cells, interpolation=cv2.INTER_AREA), dtype=np.float32)
    return MeasuredFlow(flow_px, _confidence(source, target, flow, cells), stride)


def _confidence(source: Uint8Array, target: Uint8Array, flow_px: Float32Array, cells: tuple[int, int]) -> Float32Array:
    """[h, w] in 0..1: texture to measure by, and photometric agreement after the flow, on the halved views."""
    small_source, small_target = (_halved(image) for image in (source, target))
    mismatch = _mismatch_gray(small_source, small_target, flow_px, cells) * np.float32(1 / MISMATCH_GRAY)
    texture = _texture(small_source, cells)
    return np.asarray(texture / ((texture + np.float32(TEXTURE_GRAY2)) * (1 + mismatch * mismatch)), dtype=np.float32)


def _halved(image: Uint8Array) -> Uint8Array:
    half = (image.shape[1] // 2, image.shape[0] // 2)
    return np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _mismatch_gray(
    small_source: Uint8Array, small_target: Uint8Array, flow_px: Float32Array, cells: tuple[int, int]
) -> Float32Array:
    """[h, w] gray levels by which halved images differ after a flow, which is in whole pixels."""
    height, width = small_source.shape
    at = cv2.resize(flow_px, (width, height), interpolation=cv2.INTER_NEAREST) * np.float32(0.5)
    matched = sample_bilinear(small_target, at + cached_pixel_grid(height, width), border=cv2.BORDER_CONSTANT)
    difference = cv2.absdiff(matched, small_source)
    return np.asarray(cv2.resize(difference, cells, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _texture(image: Uint8Array, cells: tuple[int, int]) -> Float32Array:
    """Smaller eigenvalue of the structure tensor [h, w]: near zero on plain surfaces and along straight edges."""
    smaller = cv2.cornerMinEigenVal(image, WINDOW_PX, ksize=3)
    # OpenCV scales gradients by 1 / (2^(ksize - 1) * block * 255) before it sums their products over the block.
    gray2 = (4 * WINDOW_PX * 255) ** 2 / (WINDOW_PX * WINDOW_PX) / 64
    return np.asarray(cv2.resize(smaller, cells, interpolation=cv2.INTER_AREA), dtype=np.float32) * np.float32(gray2)


class RemainingFlow(NamedTuple):
    """What still moves between two images that should be alike, on blocks [h, w].

    Attributes:
        flow_px: [h, w, 2] float32, by inverse search: patches of 16 px, motion of any length.
        mismatch_gray: how far the images differ after it.
        texture_gray2: to measure by, see ``TEXTURE_GRAY2``.
        local_flow_px: [h, w, 2] its refinement by gradients: windows of 10 px, so that small things show.
    """

    flow_px: Float32Array
    mismatch_gray: Float32Array
    texture_gray2: Float32Array
    local_flow_px: Float32Array


def measure_remaining_flow(source: Uint8Array, rebuilt: Uint8Array, *, block_px: int) -> RemainingFlow:
    """Flow from the source to what was rebuilt of it: zero where the prediction is right.

    Args:
        source, rebuilt: [H, W]; sides are multiples of ``block_px``, even, and at least ``MIN_SIDE_PX``.
        block_px: pixels for one value of the result.
    """
    blocks = (source.shape[1] // block_px, source.shape[0] // block_px)
    search = _fast_search()
    flow = np.asarray(search.calc(source, rebuilt, None), dtype=np.float32)
    small_source, small_rebuilt = (_halved(image) for image in (source, rebuilt))
    return RemainingFlow(
        np.asarray(cv2.resize(flow, blocks, interpolation=cv2.INTER_AREA), dtype=np.float32),
        _mismatch_gray(small_source, small_rebuilt, flow, blocks),
        _texture(small_source, blocks),
        _local_flow(small_source, small_rebuilt, flow, blocks),
    )


def _local_flow(
    small_source: Uint8Array, small_rebuilt: Uint8Array, flow_px: Float32Array, blocks: tuple[int, int]
) -> Float32Array:
    """[h, w, 2] flow in whole pixels between halved images: one step of Lucas and Kanade (IJCAI 1981) on."""
    source, rebuilt = small_source.astype(np.float32), small_rebuilt.astype(np.float32)
    height, width = source.shape
    start = cv2.resize(flow_px, (width, height), interpolation=cv2.INTER_NEAREST) * np.float32(0.5)
    difference = sample_bilinear(rebuilt, start + cached_pixel_grid(height, width)) - source
    dx, dy = (cv2.Scharr(source, cv2.CV_32F, *order, scale=1 / 32) for order in ((1, 0), (0, 1)))
    xx, yy = (_windowed(one * one) + np.float32(LOCAL_PRIOR_GRAY2) for one in (dx, dy))
    xy, x, y = (_windowed(one) for one in (dx * dy, dx * difference, dy * difference))
    scale = -1 / (xx * yy - xy * xy)
    step = np.stack([scale * (yy * x - xy * y), scale * (xx * y - xy * x)], axis=-1)
    limit = np.float32(MAX_LOCAL_STEP_PX / 2)
    flow = (start + np.clip(step, -limit, limit)) * np.float32(2)
    return np.asarray(cv2.resize(flow, blocks, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _windowed(values: Any) -> Float32Array:
    return np.asarray(cv2.blur(values, (WINDOW_PX, WINDOW_PX)), dtype=np.float32)


def _thorough_search() -> Any:
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)  # type: ignore[attr-defined]
    search.setFinestScale(FINEST_SCALE)
    return search


def _fast_search() -> Any:
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)  # type: ignore[attr-defined]
    search.setFinestScale(FINEST_SCALE)
    search.setPatchStride(PATCH_STRIDE_PX)
    search.setGradientDescentIterations(DESCENT_STEPS)
    return search
