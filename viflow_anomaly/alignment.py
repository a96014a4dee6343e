"""The predicted coordinates once more on halved images, and what the static world explains of the flow then left.

The network's view may be several times coarser than the image; a third of a pixel there is two pixels here, and every
edge differs. The flow that remains between source and reconstruction says which small motion of the camera is missing
(``motion_refinement``), and where a whole neighbourhood is nearer or farther than it was taken for: along epipolar
lines, many small things that move alike are one wrong depth. A first look at the halved images moves the coordinates
where that matters; what a second one, at the full size, still finds is taken off the remaining flow.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from viflow_anomaly.block_geometry import BlockGeometry, block_geometry, padded
from viflow_anomaly.config import EVIDENCE_BLOCK_PX
from viflow_anomaly.explanation import Explanation
from viflow_anomaly.geometry import Float32Array, sample_bilinear
from viflow_anomaly.measured_flow import RemainingFlow, measure_coarse_flow, measure_remaining_flow
from viflow_anomaly.model_input import ModelInput
from viflow_anomaly.motion_refinement import common_motion_px
from viflow_anomaly.prediction import PredictedFlow
from viflow_anomaly.regions import BoolArray
from viflow_anomaly.sensor_data import FramePair, Uint8Array

NO_GRAY = np.zeros(4)
"""Added, so that OpenCV rounds and clips to whole gray levels."""
HALF_TEXTURE_GRAY2 = 8.0
"""Of a block whose measured flow is half trusted."""
MIN_SHIFT_PX = 0.5
"""A common motion is worth moving the coordinates by, where its root mean square over the blocks is this much."""
MIN_HALVED_SIDE_PX = 64
MIN_STEP_PX = 1.8
"""Source pixels for one view pixel; with fewer, halves of the image show no more than the view did."""
NEIGHBOURHOOD = 1 / 8
"""Side of what is corrected in depth as a whole, in image widths: a smaller thing cannot explain itself away."""
DEPTH_ROUNDS = 3
DEPTH_TOLERANCE_PX = 1.0
SURE_PARALLAX_PX = 1.0
"""Of a block that tells half of what it could about depth."""
MIN_PARALLAX_PX = 0.3
MAX_LOG_DEPTH = 0.7
PRIOR_TRUST = 1e-3


class Alignment(NamedTuple):
    """Where the static world is in the target image, at the image's own resolution.

    Attributes:
        target_coordinates: [H, W, 2] float32 of every source pixel.
        geometry: of the padded image's blocks.
        log_depth: [h, w] by how much neighbourhoods were brought nearer for it, logarithm of the inverse depth.
    """

    target_coordinates: Float32Array
    geometry: BlockGeometry
    log_depth: Float32Array


class AlignedPair(NamedTuple):
    """What the evidence head's cues are made of; maps of the padded image ("H'") and of its blocks ("h").

    Attributes:
        explained: after alignment, at the image's size.
        source: [H', W'] uint8.
        rebuilt: [H', W'] uint8, the reconstruction; the source itself where nothing can be compared.
        inside_share: [h, w] of each block: where it can.
        geometry: of the blocks.
        remaining: flow from source to rebuilt that the static world does not explain.
        log_depth: [h, w] by how much neighbourhoods were brought nearer in all.
    """

    explained: Explanation
    source: Uint8Array
    rebuilt: Uint8Array
    inside_share: Float32Array
    geometry: BlockGeometry
    remaining: RemainingFlow
    log_depth: Float32Array


class _Common(NamedTuple):
    """What the static world explains of a remaining flow: [h, w, 2] px, and the part of it that is depth [h, w]."""

    flow_px: Float32Array
    log_depth: Float32Array


def align(pair: FramePair, model_input: ModelInput, predicted: PredictedFlow, *, focal_px: float) -> Alignment:
    """Correct the predicted coordinates by what the halved images show, where that is worth it.

    Args:
        pair: the images.
        model_input, predicted: what the network saw and said.
        focal_px: that the network takes the view for.
    """
    view = model_input.view
    coordinates = view.target_coordinates(predicted.flow_px, predicted.stride)
    geometry = block_geometry(predicted, view, focal_px)
    as_predicted = Alignment(coordinates, geometry, np.zeros_like(geometry.log_ratio))
    shows_no_more = min(pair.source.image.shape) < MIN_HALVED_SIDE_PX or max(view.step_px) < MIN_STEP_PX
    if geometry.points is None or shows_no_more:
        return as_predicted
    common = _common(*_remaining_of_halves(pair, coordinates, view.analyzed(), geometry), geometry)
    if common is None or _root_mean_square(common.flow_px) < MIN_SHIFT_PX:
        return as_predicted
    height, width = pair.source.image.shape
    sides = tuple(side * EVIDENCE_BLOCK_PX for side in common.log_depth.shape[::-1])
    shift = cv2.resize(common.flow_px, sides, interpolation=cv2.INTER_LINEAR)[:height, :width]
    return Alignment(np.asarray(coordinates + shift, dtype=np.float32), geometry, common.log_depth)


def remaining_evidence(explained: Explanation, alignment: Alignment) -> AlignedPair:
    """What the static world leaves of the flow between source and reconstruction, at the image's own resolution."""
    geometry, source = alignment.geometry, padded(explained.source)
    inside = padded(explained.inside.view(np.uint8), outside=True)
    rebuilt = padded(np.asarray(cv2.add(explained.reconstruction, NO_GRAY, dtype=cv2.CV_8U), dtype=np.uint8))
    np.copyto(rebuilt, source, where=inside == 0)
    inside_share = _shares(inside, geometry)
    remaining, log_depth = measure_remaining_flow(source, rebuilt, block_px=EVIDENCE_BLOCK_PX), alignment.log_depth
    common = _common(remaining.flow_px, remaining.texture_gray2, inside_share, geometry)
    if common is not None:
        flow_px, local_px = remaining.flow_px - common.flow_px, remaining.local_flow_px - common.flow_px
        remaining = remaining._replace(flow_px=flow_px, local_flow_px=local_px)
        log_depth = log_depth + common.log_depth
    return AlignedPair(explained, source, rebuilt, inside_share, geometry, remaining, log_depth)


def _remaining_of_halves(
    pair: FramePair, coordinates: Float32Array, analyzed: BoolArray | None, geometry: BlockGeometry
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """A first look at a quarter of the pixels: flow [h, w, 2] in pixels of the whole image, texture to measure it by,
    and what share of each of its blocks can be compared.

    Exposures are not compensated: the search takes means off, and a gain leaves less than ``MIN_SHIFT_PX``.
    """
    height, width = pair.source.image.shape
    source, target = (padded(frame.image) for frame in (pair.source, pair.target))
    halves = (source.shape[1] // 2, source.shape[0] // 2)
    source, target = (
        np.asarray(cv2.resize(image, halves, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        for image in (source, target)
    )
    at = cv2.resize(padded(coordinates), halves, interpolation=cv2.INTER_AREA)
    at = (at - np.float32(0.5)) * np.float32(0.5)
    reached = cv2.inRange(at, (-0.25, -0.25), ((width - 1.5) / 2, (height - 1.5) / 2))
    shown = np.ones((height, width), np.uint8) if analyzed is None else analyzed.view(np.uint8)
    shown_halves = cv2.resize(padded(shown, outside=True), halves, interpolation=cv2.INTER_NEAREST)
    inside = np.asarray(np.minimum(reached, shown_halves), dtype=np.uint8)
    rebuilt = np.asarray(sample_bilinear(target, at), dtype=np.uint8)
    np.copyto(rebuilt, source, where=inside == 0)
    flow_px, texture = measure_coarse_flow(source, rebuilt, block_px=EVIDENCE_BLOCK_PX)
    blocks = geometry.log_ratio.shape[::-1]
    flow_px, texture = (
        np.asarray(cv2.resize(one, blocks, interpolation=cv2.INTER_LINEAR), dtype=np.float32)
        for one in (flow_px * np.float32(2), texture)
    )
    return flow_px, texture, _shares(inside, geometry)


def _shares(inside: Uint8Array, geometry: BlockGeometry) -> Float32Array:
    """[h, w] of each block."""
    blocks = geometry.log_ratio.shape[::-1]
    return np.asarray(cv2.resize(inside * np.float32(1), blocks, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _common(
    flow_px: Float32Array, texture_gray2: Float32Array, inside_share: Float32Array, geometry: BlockGeometry
) -> _Common | None:
    """None where the network gives flow only, and no static world can be told from anything else."""
    if geometry.points is None:
        return None
    texture = np.maximum(texture_gray2, 0)
    trust = np.asarray(texture / (texture + HALF_TEXTURE_GRAY2) * inside_share, dtype=np.float32)
    line = geometry.line
    moved = common_motion_px(flow_px, trust, geometry.points, line, geometry.focal_px)
    left = flow_px - moved
    along = left[..., 0] * line.x + left[..., 1] * line.y
    log_depth = _neighbourhood_log_depth(along, trust, line.parallax_px)
    nearer = log_depth * line.parallax_px
    moved[..., 0] += nearer * line.x
    moved[..., 1] += nearer * line.y
    return _Common(moved, log_depth)


def _neighbourhood_log_depth(along_px: Float32Array, trust: Float32Array, parallax_px: Float32Array) -> Float32Array:
    """[h, w] robust mean, over a neighbourhood, of the change of depth that explains a flow along epipolar lines."""
    side = max(3, round(along_px.shape[1] * NEIGHBOURHOOD))
    information = parallax_px * parallax_px
    certain = trust * information / (information + np.float32(SURE_PARALLAX_PX**2))
    log_depth = along_px / np.maximum(parallax_px, np.float32(MIN_PARALLAX_PX))
    weights, mean = certain, np.zeros_like(along_px)
    for _ in range(DEPTH_ROUNDS):
        both = cv2.blur(np.dstack([weights * log_depth, weights]), (side, side), borderType=cv2.BORDER_CONSTANT)
        mean = np.asarray(both[..., 0] / (both[..., 1] + np.float32(PRIOR_TRUST)), dtype=np.float32)
        error = (log_depth - mean) * parallax_px * np.float32(1 / DEPTH_TOLERANCE_PX)
        weights = certain / (1 + error * error)
    return np.clip(mean, -MAX_LOG_DEPTH, MAX_LOG_DEPTH)


def _root_mean_square(flow_px: Float32Array) -> float:
    return float(np.sqrt(2 * np.mean(np.square(flow_px))))
