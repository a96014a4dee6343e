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
FIRST_OF_DOUBLED = np.array([0.25, 0.75, 0.0], dtype=np.float32)
MEAN_OF_DOUBLED = np.array([0.125, 0.75, 0.125], dtype=np.float32)
"""What bilinear doubling makes of an array: the first of each pixel's two; and, averaged over neighbours, the mean of
each two pixels' four."""
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
    height, width = small_source.shape
    at_px = np.asarray(cv2.resize(flow_px, (width, height), interpolation=cv2.INTER_NEAREST), dtype=np.float32)
    at_px *= np.float32(0.5)
    at_px += cached_pixel_grid(height, width)
    mismatch = _mismatch_gray(small_source, small_target, at_px, cells)
    mismatch *= np.float32(1 / MISMATCH_GRAY)
    mismatch *= mismatch
    mismatch += np.float32(1)
    texture = _texture(small_source, cells)
    mismatch *= texture + np.float32(TEXTURE_GRAY2)
    return np.divide(texture, mismatch, out=mismatch)


def _halved(image: Uint8Array) -> Uint8Array:
    half = (image.shape[1] // 2, image.shape[0] // 2)
    return np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _mismatch_gray(
    small_source: Uint8Array, small_target: Uint8Array, at_px: Float32Array, cells: tuple[int, int]
) -> Float32Array:
    """[h, w] gray levels by which halved images differ; each pixel of the source is at ``at_px`` in the target."""
    matched = sample_bilinear(small_target, at_px, border=cv2.BORDER_CONSTANT)
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
    height, width = source.shape[0] // 2, source.shape[1] // 2
    blocks = (source.shape[1] // block_px, source.shape[0] // block_px)
    small_source, small_rebuilt = (_halved(image) for image in (source, rebuilt))
    half_px = _flow_of_halves(small_source, small_rebuilt)
    start_px = _filtered(half_px, FIRST_OF_DOUBLED)
    at_px = start_px + cached_pixel_grid(height, width)
    return RemainingFlow(
        _doubled_on_blocks(half_px, blocks),
        _mismatch_gray(small_source, small_rebuilt, at_px, blocks),
        _texture(small_source, blocks),
        _local_flow(small_source, small_rebuilt, start_px, at_px, blocks),
    )


def measure_coarse_flow(source: Uint8Array, rebuilt: Uint8Array, *, block_px: int) -> tuple[Float32Array, Float32Array]:
    """``flow_px`` and ``texture_gray2`` of ``measure_remaining_flow``, and nothing else."""
    blocks = (source.shape[1] // block_px, source.shape[0] // block_px)
    small_source, small_rebuilt = (_halved(image) for image in (source, rebuilt))
    return _doubled_on_blocks(_flow_of_halves(small_source, small_rebuilt), blocks), _texture(small_source, blocks)


def _flow_of_halves(small_source: Uint8Array, small_rebuilt: Uint8Array) -> Float32Array:
    """[h, w, 2] in halved pixels. The search's own pyramid begins with the same halves: this is its flow before it is
    doubled in size, bilinearly; what follows is what the doubled one would say of every second pixel, and on average of
    each block."""
    return np.asarray(_fast_search(finest_scale=0).calc(small_source, small_rebuilt, None), dtype=np.float32)


def _doubled_on_blocks(half_px: Float32Array, blocks: tuple[int, int]) -> Float32Array:
    """[h, w, 2] in whole pixels."""
    mean_px = np.asarray(
        cv2.resize(_filtered(half_px, MEAN_OF_DOUBLED), blocks, interpolation=cv2.INTER_AREA), np.float32
    )
    return np.multiply(mean_px, np.float32(2), out=mean_px)


def _filtered(flow_px: Float32Array, taps: Float32Array) -> Any:
    """[h, w, 2] along x and along y; the border is repeated."""
    return cv2.sepFilter2D(flow_px, cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REPLICATE)


def _local_flow(
    small_source: Uint8Array,
    small_rebuilt: Uint8Array,
    start_px: Float32Array,
    at_px: Float32Array,
    blocks: tuple[int, int],
) -> Float32Array:
    """[h, w, 2] flow in whole pixels between halved images: one step of Lucas and Kanade (IJCAI 1981) on.

    ``start_px`` is where the step begins, in halved pixels, and ``at_px`` that place in the rebuilt image.
    """
    source = small_source.astype(np.float32)
    difference = sample_bilinear(small_rebuilt.astype(np.float32), at_px)
    difference -= source
    dx, dy = (cv2.Scharr(source, cv2.CV_32F, *order, scale=1 / 32) for order in ((1, 0), (0, 1)))
    xx, yy, xy, x, y = (_windowed(a * b) for a, b in ((dx, dx), (dy, dy), (dx, dy), (dx, difference), (dy, difference)))
    xx += np.float32(LOCAL_PRIOR_GRAY2)
    yy += np.float32(LOCAL_PRIOR_GRAY2)
    scale = -1 / (xx * yy - xy * xy)
    limit = np.float32(MAX_LOCAL_STEP_PX / 2)
    steps = (np.clip(scale * along, -limit, limit) for along in (yy * x - xy * y, xx * y - xy * x))
    flow = np.asarray(cv2.merge(list(steps)), dtype=np.float32)
    flow += start_px
    flow_px = np.asarray(cv2.resize(flow, blocks, interpolation=cv2.INTER_AREA), dtype=np.float32)
    flow_px *= np.float32(2)
    return flow_px


def _windowed(values: Any) -> Float32Array:
    return np.asarray(cv2.blur(values, (WINDOW_PX, WINDOW_PX)), dtype=np.float32)


def _thorough_search() -> Any:
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)  # type: ignore[attr-defined]
    search.setFinestScale(FINEST_SCALE)
    return search


def _fast_search(finest_scale: int = FINEST_SCALE) -> Any:
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)  # type: ignore[attr-defined]
    search.setFinestScale(finest_scale)
    search.setPatchStride(PATCH_STRIDE_PX)
    search.setGradientDescentIterations(DESCENT_STEPS)
    return search
