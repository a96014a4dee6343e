"""Is a region extended in both directions (independent motion) or a narrow band (model error)?

Four rules, told by ``RegionConfig.shape_rule``. They differ in what they take for a region's two sides:

- ``axis_aligned``, the paper's: the sides of the bounding box. A *diagonal* thin band passes.
- ``oriented``: the sides of the smallest rectangle around it that may be turned.
- ``thickness``: the diameter of the largest disc inside it, and the longest side of the bounding box.
- ``none``: every region passes.

A side shorter than its limit, or a long side that is many times the short one, makes a band.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.config import ShapeRuleName

BoolArray = NDArray[np.bool_]

EXTENDED = "extended_in_x_and_y"
"""The verdict of a region that passes, under any rule but ``none``."""
NOT_JUDGED = "shape_not_judged"


class ShapeLimits(NamedTuple):
    """The rule in pixels of this image. Sides that are not the box's own have the smaller of both limits."""

    min_x_px: float
    min_y_px: float
    max_aspect_ratio: float


class Shape(NamedTuple):
    """What a rule found.

    Attributes:
        verdict: ``extended_in_x_and_y`` or ``shape_not_judged`` for what passes, else why it is a band.
        nearness_to_band: 0 to 1 and beyond: the largest of the three limits over the region's own value.
    """

    verdict: str
    nearness_to_band: float

    @property
    def passes(self) -> bool:
        return self.verdict in {EXTENDED, NOT_JUDGED}


def judge_shape(rule: ShapeRuleName, mask: BoolArray, thickness_px: float, limits: ShapeLimits) -> Shape:
    """Judge one region.

    Args:
        rule: see the module.
        mask: [h, w] of its bounding box, True on the region.
        thickness_px: of the region, ``thickness_px(mask)``.
        limits: of this image.
    """
    if rule == "none":
        return Shape(NOT_JUDGED, 0.0)
    height, width = mask.shape
    sides = (float(width), float(height))
    if rule == "axis_aligned":
        return _judge_sides(sides, (limits.min_x_px, limits.min_y_px), limits.max_aspect_ratio)
    if rule == "oriented":
        sides = oriented_sides_px(mask)
    elif rule == "thickness":
        sides = (float(max(width, height)), thickness_px)
    least_px = min(limits.min_x_px, limits.min_y_px)
    shape = _judge_sides(sides, (least_px, least_px), limits.max_aspect_ratio)
    # x and y are the image's own, these sides are not.
    return shape._replace(verdict="narrow_across") if shape.verdict.startswith("narrow") else shape


def _judge_sides(sides: tuple[float, float], least: tuple[float, float], max_aspect_ratio: float) -> Shape:
    """The paper's rule, and the limit on the aspect ratio that stops a long band of some thickness."""
    (x_px, y_px), (min_x_px, min_y_px) = sides, least
    longest, shortest = max(sides), min(sides)
    nearness = max(min_x_px / x_px, min_y_px / y_px, longest / (max_aspect_ratio * shortest))
    narrow_in_x, narrow_in_y = x_px < min_x_px, y_px < min_y_px
    if narrow_in_x and narrow_in_y:
        return Shape("narrow_in_x_and_y", nearness)
    if narrow_in_x:
        return Shape("narrow_in_x", nearness)
    if narrow_in_y:
        return Shape("narrow_in_y", nearness)
    if longest > max_aspect_ratio * shortest:
        return Shape("band_by_aspect_ratio", nearness)
    return Shape(EXTENDED, nearness)


def oriented_sides_px(mask: BoolArray) -> tuple[float, float]:
    """(long, short) side of the smallest rectangle of any direction around the pixels; one pixel is 1 px wide."""
    y, x = np.nonzero(mask)
    _, sides, _ = cv2.minAreaRect(np.stack([x, y], axis=-1).astype(np.float32))
    return max(sides) + 1.0, min(sides) + 1.0  # between centres of pixels, half a pixel from the edge at both ends


def thickness_px(mask: BoolArray) -> float:
    """Diameter of the largest disc inside the component; a line one pixel wide is 1 px thick.

    The distance transform measures from a pixel's centre to the centre of the nearest pixel outside, half a pixel
    beyond the edge.
    """
    padded = cv2.copyMakeBorder(mask.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT)
    distance_px = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_5)
    return float(2.0 * distance_px.max() - 1.0)
