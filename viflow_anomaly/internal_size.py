"""A large picture is judged at a smaller size, and told in the pixels it came in.

What the evidence head costs grows with the pixels. In fewer of them large things are found as well, with fewer false
alarms, and small ones are not: docs/detection.md has the curve. On the way back a source pixel belongs to the internal
pixel that its middle lies in; what is continuous is interpolated.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.geometry import Float32Array, cached_pixel_grid
from viflow_anomaly.moving_regions import LENGTHS
from viflow_anomaly.regions import BoundingBox, IndexArray, Region
from viflow_anomaly.sensor_data import MIN_FOCAL_LENGTH_PX, Frame, FramePair, PinholeCamera

WORTH_IT = 1.25
"""A picture whose shorter side is up to this many times the wanted one stays as it is: little would be saved."""


class InternalSize(NamedTuple):
    """At what size a pair is judged, and the size it came in; pixels."""

    width: int
    height: int
    source_width: int
    source_height: int

    @property
    def step_px(self) -> tuple[float, float]:
        """(x, y) source pixels for one internal pixel."""
        return self.source_width / self.width, self.source_height / self.height

    def reduce(self, pair: FramePair) -> FramePair:
        """The pair as a camera with fewer pixels would have seen it; antialiased."""
        size = (self.width, self.height)
        source, target = (
            Frame(
                frame.timestamp_ns,
                np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8),
            )
            for frame in (pair.source, pair.target)
        )
        camera = None if pair.camera is None else pair.camera.scaled_to(*size)
        return replace(pair, source=source, target=target, camera=camera)

    def box(self, box: BoundingBox) -> BoundingBox:
        """The source pixels whose middles lie in a box of internal pixels."""
        left, right = (_first_pixel(x, self.source_width, self.width) for x in (box.x, box.x + box.width))
        top, bottom = (_first_pixel(y, self.source_height, self.height) for y in (box.y, box.y + box.height))
        return BoundingBox(left, top, right - left, bottom - top)

    def region(self, region: Region) -> Region:
        """In source pixels: box, mask, area, thickness, and what its evidence tells of shape and in lengths."""
        box, step = self.box(region.bbox), math.sqrt(math.prod(self.step_px))
        rows, columns = self._at(box)
        mask = region.mask[np.ix_(rows - region.bbox.y, columns - region.bbox.x)]
        area_px = int(np.count_nonzero(mask))
        shape = {"fill_ratio": area_px / mask.size, "aspect_ratio": max(mask.shape) / min(mask.shape)}
        lengths = {name: step * float(region.evidence[name]) for name in LENGTHS if name in region.evidence}
        return replace(
            region,
            bbox=box,
            x_extent_px=box.width,
            y_extent_px=box.height,
            area_px=area_px,
            thickness_px=step * region.thickness_px,
            evidence={**region.evidence, **shape, **lengths},
            mask=mask,
        )

    def map(self, values: Float32Array) -> Float32Array:
        """[height, width(, C)] -> [source_height, source_width(, C)], bilinear."""
        size = (self.source_width, self.source_height)
        return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)

    def mask(self, inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """[height, width] -> [source_height, source_width]."""
        return inside[np.ix_(*self._at(BoundingBox(0, 0, self.source_width, self.source_height)))]

    def thin_out(self, values: NDArray[Any]) -> NDArray[Any]:
        """[source_height, source_width] -> [height, width]: what holds at each internal pixel's middle."""
        rows = _holding(np.arange(self.height), self.height, self.source_height)
        columns = _holding(np.arange(self.width), self.width, self.source_width)
        return values[np.ix_(rows, columns)]

    def coordinates(self, target_px: Float32Array) -> Float32Array:
        """[height, width, 2] positions in the internal target -> [source_height, source_width, 2] in the source's."""
        flow = self.map(target_px - cached_pixel_grid(self.height, self.width))
        flow *= np.array(self.step_px, dtype=np.float32)
        flow += cached_pixel_grid(self.source_height, self.source_width)
        return flow

    def _at(self, box: BoundingBox) -> tuple[IndexArray, IndexArray]:
        """Internal row of each row of a box of source pixels, and internal column of each column."""
        rows = np.arange(box.y, box.y + box.height)
        columns = np.arange(box.x, box.x + box.width)
        return (
            _holding(rows, self.source_height, self.height),
            _holding(columns, self.source_width, self.width),
        )


def _holding(pixels: IndexArray, side: int, other_side: int) -> IndexArray:
    """Of pixels of a side, those of the other side that their middles lie in; of two that touch there the second."""
    return (2 * pixels + 1) * other_side // (2 * side)


def _first_pixel(edge: int, source_side: int, side: int) -> int:
    """The first source pixel whose middle is not before an internal pixel's edge; exact, in whole numbers."""
    return -((side - 2 * edge * source_side) // (2 * side))


def internal_size(
    width: int, height: int, short_side_px: int, camera: PinholeCamera | None = None
) -> InternalSize | None:
    """The size at which a width x height picture is judged; None: its own.

    Args:
        short_side_px: of the judged picture, whatever its proportions; 0: every picture is judged as it came.
        camera: of the picture; one whose focal length would be none at the smaller size keeps its own.
    """
    shorter = min(width, height)
    if not short_side_px or shorter <= WORTH_IT * short_side_px:
        return None
    scale = short_side_px / shorter
    if camera is not None and min(camera.fx, camera.fy) * scale < 2 * MIN_FOCAL_LENGTH_PX:
        return None
    return InternalSize(round(width * scale), round(height * scale), width, height)
