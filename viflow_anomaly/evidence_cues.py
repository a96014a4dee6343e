"""What the evidence head looks at: how the reconstruction differs from the source, and what geometry says of it.

None of the cues is the picture itself. The head learns on simulated scenes; what it must not learn is what movers look
like there. All cues are bounded to -1..1, so that nothing unheard of reaches the network from a real camera.

Photometric cues are on every source pixel, geometric ones on blocks of 4x4: flow is smooth, and the measured one is no
finer. Of the flow that is left between source and reconstruction, what one small motion of the camera explains is taken
off (``motion_refinement``). Of the rest, only what lies *across* the epipolar line is independent motion for sure;
*along* it, a wrong depth looks the same. Lines and parallax are those of a pinhole camera; a lens bends them a little.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.config import EVIDENCE_BLOCK_PX
from viflow_anomaly.correction import moved_cells
from viflow_anomaly.explanation import Explanation
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.measured_flow import measure_remaining_flow
from viflow_anomaly.motion_refinement import Line, MovedPoints, common_motion_px
from viflow_anomaly.prediction import PredictedFlow, view_rays
from viflow_anomaly.view import InternalView

PHOTOMETRIC_CUES = ("difference", "normalised residual", "half range")
GEOMETRIC_CUES = (
    "remaining flow across",
    "remaining flow along",
    "remaining flow",
    "mismatch after it",
    "texture",
    "parallax",
    "depth correction",
    "inverse depth",
    "inside",
    "predicted flow",
    "local flow across",
    "local flow along",
)
MIN_PARALLAX_PX = 0.05
"""Added to x of every slope, so that a line of no parallax lies along x; much longer slopes keep their direction. One
of (-0.05, 0) px has neither line nor split flow."""
HALF_GRAY, HALF_NORMALISED_GRAY, HALF_MISMATCH_GRAY = 16.0, 8.0, 8.0
HALF_REMAINING_PX, HALF_PARALLAX_PX, HALF_FLOW_PX = 1.0, 4.0, 16.0
HALF_TEXTURE_GRAY2 = 8.0
"""Values at which a cue is half of its largest: c = v / (|v| + half)."""
MIN_INVERSE_DEPTH = 1e-3
NO_GRAY = np.zeros(4)
"""Added, so that OpenCV rounds and clips to whole gray levels."""
SIDE_MULTIPLE_PX = 32
"""Images are padded to multiples of it: the coarsest stride of the head."""


class EvidenceCues(NamedTuple):
    """One pair, all values in -1..1. H' and W' are the image's sides, rounded up to multiples of 32.

    Attributes:
        photometric: [3, H', W'] float32, ``PHOTOMETRIC_CUES``.
        geometric: [12, H' / 4, W' / 4] float32, ``GEOMETRIC_CUES``.
    """

    photometric: Float32Array
    geometric: Float32Array


def evidence_cues(explained: Explanation, *, focal_px: float) -> EvidenceCues:
    """The cues of one pair.

    Args:
        explained: at the source image's size.
        focal_px: that the network takes the view for.
    """
    predicted, view = explained.predicted, explained.model_input.view
    source, inside = _padded(explained.source), _padded(explained.inside.view(np.uint8), outside=True)
    rebuilt = _padded(np.asarray(cv2.add(explained.reconstruction, NO_GRAY, dtype=cv2.CV_8U), dtype=np.uint8))
    np.copyto(rebuilt, source, where=inside == 0)
    height, width = source.shape
    photometric = np.empty((len(PHOTOMETRIC_CUES), height, width), dtype=np.float32)
    difference = np.asarray(cv2.subtract(rebuilt, source, dtype=cv2.CV_32F), dtype=np.float32)
    _bound(difference, HALF_GRAY, photometric[0])
    _bound_padded(explained.normalised, HALF_NORMALISED_GRAY, photometric[1], outside=True)
    _bound_padded(explained.half_range, HALF_GRAY, photometric[2])

    blocks = (width // EVIDENCE_BLOCK_PX, height // EVIDENCE_BLOCK_PX)
    geometric = np.empty((len(GEOMETRIC_CUES), *blocks[::-1]), dtype=np.float32)
    inside_share = np.asarray(cv2.resize(inside * np.float32(1), blocks, interpolation=cv2.INTER_AREA), np.float32)
    remaining = measure_remaining_flow(source, rebuilt, block_px=EVIDENCE_BLOCK_PX)
    depth = _depth_on_blocks(predicted, view, blocks, focal_px)
    line = _epipolar_lines(depth.slope_px)
    remaining_px, local_px = remaining.flow_px, remaining.local_flow_px
    if depth.points is not None:
        texture = np.maximum(remaining.texture_gray2, 0)
        trust = np.asarray(texture / (texture + HALF_TEXTURE_GRAY2) * inside_share, dtype=np.float32)
        focal = (view.step_px[0] * focal_px, view.step_px[1] * focal_px)
        common = common_motion_px(remaining_px, trust, depth.points, line, focal)
        remaining_px, local_px = remaining_px - common, local_px - common
    _split_along(remaining_px, line, geometric[0:2])
    _split_along(local_px, line, geometric[10:12])
    _bound(_length(remaining_px), HALF_REMAINING_PX, geometric[2])
    _bound(line.parallax_px, HALF_PARALLAX_PX, geometric[5])
    _bound(remaining.mismatch_gray, HALF_MISMATCH_GRAY, geometric[3])
    _bound(remaining.texture_gray2, HALF_TEXTURE_GRAY2, geometric[4])
    np.clip(depth.log_ratio, -1, 1, out=geometric[6])
    np.clip(depth.log_inverse_depth * np.float32(0.5), -1, 1, out=geometric[7])
    geometric[8] = inside_share
    flow_px = _on_blocks(predicted.flow_px, predicted, view, blocks) * np.array(view.step_px, dtype=np.float32)
    _bound(_length(flow_px), HALF_FLOW_PX, geometric[9])
    return EvidenceCues(photometric, geometric)


def _padded(image: NDArray[Any], *, outside: bool = False) -> NDArray[Any]:
    """[H', W']; beyond the image its border is repeated, or nothing is (``outside``)."""
    below, right = (-side % SIDE_MULTIPLE_PX for side in image.shape[:2])
    if not below and not right:
        return image
    border = cv2.BORDER_CONSTANT if outside else cv2.BORDER_REPLICATE
    return cv2.copyMakeBorder(image, 0, below, 0, right, border)


def _bound(values: Float32Array, half: float, out: Float32Array) -> None:
    """v / (|v| + half), in -1..1."""
    np.abs(values, out=out)
    out += np.float32(half)
    np.divide(values, out, out=out)


def _bound_padded(values: Float32Array, half: float, out: Float32Array, *, outside: bool = False) -> None:
    """``_bound`` of ``_padded`` values, without the copy that these would be."""
    height, width = values.shape
    _bound(values, half, out[:height, :width])
    if width < out.shape[1]:
        out[:height, width:] = 0 if outside else out[:height, width - 1 : width]
    if height < out.shape[0]:
        out[height:] = 0 if outside else out[height - 1]


def _length(vectors: Float32Array) -> Float32Array:
    """[h, w] of [h, w, 2]; numpy's norm takes ten times as long."""
    return np.asarray(cv2.magnitude(*cv2.split(vectors)), dtype=np.float32)


class _DepthOnBlocks(NamedTuple):
    """What the corrected depth and motion say of each block [h, w]; zeros where the network gives flow only.

    Attributes:
        slope_px: [h, w, 2] source pixels for a change of the inverse depth's logarithm by one.
        log_ratio: that change as the correction made it.
        log_inverse_depth: the logarithm itself.
        points: after the motion; None where the network gives flow only.
    """

    slope_px: Float32Array
    log_ratio: Float32Array
    log_inverse_depth: Float32Array
    points: MovedPoints | None


def _depth_on_blocks(
    predicted: PredictedFlow, view: InternalView, blocks: tuple[int, int], focal_px: float
) -> _DepthOnBlocks:
    correction, shape = predicted.correction, predicted.flow_px.shape[:2]
    if correction is None or correction.motion is None or correction.inverse_depth is None:
        none = np.zeros(blocks[::-1], dtype=np.float32)
        return _DepthOnBlocks(np.zeros((*none.shape, 2), np.float32), none, none, None)
    rays = view_rays(*shape, predicted.stride, view.height, view.width, focal_px)
    moved = moved_cells(rays, correction.inverse_depth, correction.motion)
    log_depth = np.log(np.maximum(correction.inverse_depth, MIN_INVERSE_DEPTH))
    log_ratio = np.zeros_like(log_depth) if correction.log_depth_ratio is None else correction.log_depth_ratio
    slope = moved.slope * (np.array(view.step_px, dtype=np.float32) * np.float32(focal_px))
    first = _on_blocks(_merged(*cv2.split(slope), log_ratio, log_depth), predicted, view, blocks)
    second = _on_blocks(_merged(moved.x, moved.y, moved.nearness), predicted, view, blocks)
    points = MovedPoints(*(np.ascontiguousarray(second[..., axis]) for axis in range(3)))
    return _DepthOnBlocks(first[..., :2], first[..., 2], first[..., 3], points)


def _merged(*planes: NDArray[Any]) -> Float32Array:
    """[h, w, C] of [h, w] each."""
    return np.asarray(cv2.merge(planes), dtype=np.float32)


def _epipolar_lines(slope_px: Float32Array) -> Line:
    """Of slopes [h, w, 2] in source pixels; see ``MIN_PARALLAX_PX``."""
    x, y = slope_px[..., 0] + np.float32(MIN_PARALLAX_PX), slope_px[..., 1]
    length = np.sqrt(x * x + y * y)
    inverse = 1 / np.maximum(length, np.float32(1e-6))
    return Line(x * inverse, y * inverse, length)


def _split_along(flow_px: Float32Array, line: Line, out: Float32Array) -> None:
    """[2, h, w]: how far a flow goes across and along the line, bounded."""
    u, v = flow_px[..., 0], flow_px[..., 1]
    _bound(v * line.x - u * line.y, HALF_REMAINING_PX, out[0])
    _bound(u * line.x + v * line.y, HALF_REMAINING_PX, out[1])


def _on_blocks(
    cells: Float32Array, predicted: PredictedFlow, view: InternalView, blocks: tuple[int, int]
) -> Float32Array:
    """[h, w, C] of the padded image; beyond the image its border is repeated."""
    sampled = view.sample_blocks(cells, predicted.stride, EVIDENCE_BLOCK_PX)
    below, right = blocks[1] - sampled.shape[0], blocks[0] - sampled.shape[1]
    if below or right:
        sampled = np.asarray(cv2.copyMakeBorder(sampled, 0, below, 0, right, cv2.BORDER_REPLICATE), np.float32)
    return sampled
