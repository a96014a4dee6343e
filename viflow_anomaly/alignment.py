"""A pair's explanation once more at the image's own resolution, until nothing is left that the static world explains.

The network's view may be several times coarser than the image; a third of a pixel there is two pixels here, and every
edge differs. The flow that remains between source and reconstruction says which small motion of the camera is missing
(``motion_refinement``), and where a whole neighbourhood is nearer or farther than it was taken for: along epipolar
lines, many small things that move alike are one wrong depth. Where that matters, the source is rebuilt and the
remaining flow measured anew; the rest is taken off the measured flow.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from viflow_anomaly.block_geometry import BlockGeometry, block_geometry, padded
from viflow_anomaly.config import EVIDENCE_BLOCK_PX, DetectorConfig
from viflow_anomaly.explanation import Explanation, explain_at
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.measured_flow import RemainingFlow, measure_remaining_flow
from viflow_anomaly.motion_refinement import common_motion_px
from viflow_anomaly.sensor_data import FramePair, Uint8Array

NO_GRAY = np.zeros(4)
"""Added, so that OpenCV rounds and clips to whole gray levels."""
HALF_TEXTURE_GRAY2 = 8.0
"""Of a block whose measured flow is half trusted."""
MIN_SHIFT_PX = 0.5
"""A common motion is worth rebuilding the source for, where its root mean square over the blocks is this much."""
MAX_REBUILDS = 2
NEIGHBOURHOOD = 1 / 8
"""Side of what is corrected in depth as a whole, in image widths: a smaller thing cannot explain itself away."""
DEPTH_ROUNDS = 3
DEPTH_TOLERANCE_PX = 1.0
SURE_PARALLAX_PX = 1.0
"""Of a block that tells half of what it could about depth."""
MIN_PARALLAX_PX = 0.3
MAX_LOG_DEPTH = 0.7
PRIOR_TRUST = 1e-3


class AlignedPair(NamedTuple):
    """What the evidence head's cues are made of; maps of the padded image ("H'") and of its blocks ("h").

    Attributes:
        explained: after alignment, at the image's size.
        source: [H', W'] uint8.
        rebuilt: [H', W'] uint8, the reconstruction; the source itself where nothing can be compared.
        inside: [H', W'] uint8, 1 where it can.
        inside_share: [h, w] of each block.
        geometry: of the blocks.
        remaining: flow from source to rebuilt that the static world does not explain.
        log_depth: [h, w] by how much neighbourhoods were brought nearer, logarithm of the inverse depth.
    """

    explained: Explanation
    source: Uint8Array
    rebuilt: Uint8Array
    inside: Uint8Array
    inside_share: Float32Array
    geometry: BlockGeometry
    remaining: RemainingFlow
    log_depth: Float32Array


class _Common(NamedTuple):
    """What the static world explains of a remaining flow: [h, w, 2] px, and the part of it that is depth [h, w]."""

    flow_px: Float32Array
    log_depth: Float32Array


def align(pair: FramePair, explained: Explanation, config: DetectorConfig, *, focal_px: float) -> AlignedPair:
    """Measure what remains, and rebuild the source while a common motion is a large part of it.

    Args:
        pair: the images.
        explained: under the predicted flow.
        config: as for ``explain``.
        focal_px: that the network takes the view for.
    """
    geometry = block_geometry(explained.predicted, explained.model_input.view, focal_px)
    source, log_depth = padded(explained.source), np.zeros_like(geometry.log_ratio)
    for rebuilds_left in range(MAX_REBUILDS, -1, -1):
        inside = padded(explained.inside.view(np.uint8), outside=True)
        rebuilt = padded(np.asarray(cv2.add(explained.reconstruction, NO_GRAY, dtype=cv2.CV_8U), dtype=np.uint8))
        np.copyto(rebuilt, source, where=inside == 0)
        blocks = log_depth.shape[::-1]
        inside_share = np.asarray(cv2.resize(inside * np.float32(1), blocks, interpolation=cv2.INTER_AREA), np.float32)
        remaining = measure_remaining_flow(source, rebuilt, block_px=EVIDENCE_BLOCK_PX)
        common = _common(remaining, geometry, inside_share)
        if common is None:
            break
        log_depth = log_depth + common.log_depth
        if not rebuilds_left or _root_mean_square(common.flow_px) < MIN_SHIFT_PX:
            flow_px, local_px = remaining.flow_px - common.flow_px, remaining.local_flow_px - common.flow_px
            remaining = remaining._replace(flow_px=flow_px, local_flow_px=local_px)
            break
        height, width = explained.source.shape
        shift = cv2.resize(common.flow_px, source.shape[::-1], interpolation=cv2.INTER_LINEAR)[:height, :width]
        coordinates = np.asarray(explained.target_coordinates + shift, dtype=np.float32)
        explained = explain_at(pair, explained.model_input, explained.predicted, coordinates, config)
    return AlignedPair(explained, source, rebuilt, inside, inside_share, geometry, remaining, log_depth)


def _common(remaining: RemainingFlow, geometry: BlockGeometry, inside_share: Float32Array) -> _Common | None:
    """None where the network gives flow only, and no static world can be told from anything else."""
    if geometry.points is None:
        return None
    texture = np.maximum(remaining.texture_gray2, 0)
    trust = np.asarray(texture / (texture + HALF_TEXTURE_GRAY2) * inside_share, dtype=np.float32)
    line = geometry.line
    moved = common_motion_px(remaining.flow_px, trust, geometry.points, line, geometry.focal_px)
    left = remaining.flow_px - moved
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
