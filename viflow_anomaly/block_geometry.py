"""What the predicted depth and motion say of each block of source pixels: epipolar line, parallax, depth."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.config import EVIDENCE_BLOCK_PX
from viflow_anomaly.correction import moved_cells
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.motion_refinement import Line, MovedPoints
from viflow_anomaly.prediction import PredictedFlow, view_rays
from viflow_anomaly.view import InternalView

SIDE_MULTIPLE_PX = 32
"""Images are padded to multiples of it: the coarsest stride of the head."""
MIN_PARALLAX_PX = 0.05
"""Below it a line has no direction; along x then."""
MIN_INVERSE_DEPTH = 1e-3


class BlockGeometry(NamedTuple):
    """Of the padded image's blocks [h, w]; zeros (lines along x) where the network gives flow only.

    Attributes:
        line: epipolar lines, in source pixels.
        log_ratio: change of the inverse depth's logarithm as the correction made it.
        log_inverse_depth: the logarithm itself.
        points: after the motion; None where the network gives flow only.
        focal_px: of the source image as the network sees it, x and y.
    """

    line: Line
    log_ratio: Float32Array
    log_inverse_depth: Float32Array
    points: MovedPoints | None
    focal_px: tuple[float, float]


def blocks_of(height: int, width: int) -> tuple[int, int]:
    """Columns and rows of blocks of an image, padded."""
    columns, rows = ((side + -side % SIDE_MULTIPLE_PX) // EVIDENCE_BLOCK_PX for side in (width, height))
    return columns, rows


def padded(image: NDArray[Any], *, outside: bool = False) -> NDArray[Any]:
    """[H', W'], sides multiples of 32; beyond the image its border is repeated, or nothing is (``outside``)."""
    below, right = (-side % SIDE_MULTIPLE_PX for side in image.shape[:2])
    if not below and not right:
        return image
    border = cv2.BORDER_CONSTANT if outside else cv2.BORDER_REPLICATE
    return cv2.copyMakeBorder(image, 0, below, 0, right, border)


def block_geometry(predicted: PredictedFlow, view: InternalView, focal_px: float) -> BlockGeometry:
    """Of one pair; ``focal_px`` is what the network takes the view for."""
    blocks = blocks_of(view.source_height, view.source_width)
    focal = (view.step_px[0] * focal_px, view.step_px[1] * focal_px)
    correction, shape = predicted.correction, predicted.flow_px.shape[:2]
    if correction is None or correction.motion is None or correction.inverse_depth is None:
        none = np.zeros(blocks[::-1], dtype=np.float32)
        return BlockGeometry(_epipolar_lines(np.zeros((*none.shape, 2), np.float32)), none, none, None, focal)
    rays = view_rays(*shape, predicted.stride, view.height, view.width, focal_px)
    moved = moved_cells(rays, correction.inverse_depth, correction.motion)
    log_depth = np.log(np.maximum(correction.inverse_depth, MIN_INVERSE_DEPTH))
    log_ratio = np.zeros_like(log_depth) if correction.log_depth_ratio is None else correction.log_depth_ratio
    slope = moved.slope * (np.array(view.step_px, dtype=np.float32) * np.float32(focal_px))
    first = on_blocks(_merged(*cv2.split(slope), log_ratio, log_depth), predicted, view)
    second = on_blocks(_merged(moved.x, moved.y, moved.nearness), predicted, view)
    points = MovedPoints(*(np.ascontiguousarray(second[..., axis]) for axis in range(3)))
    return BlockGeometry(_epipolar_lines(first[..., :2]), first[..., 2], first[..., 3], points, focal)


def _merged(*planes: NDArray[Any]) -> Float32Array:
    """[h, w, C] of [h, w] each."""
    return np.asarray(cv2.merge(planes), dtype=np.float32)


def on_blocks(cells: Float32Array, predicted: PredictedFlow, view: InternalView) -> Float32Array:
    """[h, w, C] of the padded image from cells of the view, C at most 4; its border is repeated."""
    sampled = view.sample_blocks(cells, predicted.stride, EVIDENCE_BLOCK_PX)
    columns, rows = blocks_of(view.source_height, view.source_width)
    below, right = rows - sampled.shape[0], columns - sampled.shape[1]
    if below or right:
        sampled = np.asarray(cv2.copyMakeBorder(sampled, 0, below, 0, right, cv2.BORDER_REPLICATE), np.float32)
    return sampled


def _epipolar_lines(slope_px: Float32Array) -> Line:
    """Of slopes [h, w, 2]: source pixels for a change of the inverse depth's logarithm by one."""
    x, y = slope_px[..., 0], slope_px[..., 1]
    length = np.sqrt(x * x + y * y)
    rests = length < np.float32(MIN_PARALLAX_PX)
    inverse = 1 / np.maximum(length, np.float32(MIN_PARALLAX_PX))
    return Line(np.where(rests, np.float32(1), x * inverse), np.where(rests, np.float32(0), y * inverse), length)
