"""A large picture is judged at a smaller size, and told in the pixels it came in.

What the evidence head costs grows with the pixels; what it finds hardly does: docs/detection.md has the curve. Boxes
grow outwards to whole pixels, maps are interpolated.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.moving_regions import LENGTHS
from viflow_anomaly.regions import BoundingBox, Region
from viflow_anomaly.sensor_data import Frame, FramePair

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
        """In source pixels."""
        step_x, step_y = self.step_px
        left, top = math.floor(box.x * step_x), math.floor(box.y * step_y)
        right = min(self.source_width, math.ceil((box.x + box.width) * step_x))
        bottom = min(self.source_height, math.ceil((box.y + box.height) * step_y))
        return BoundingBox(left, top, right - left, bottom - top)

    def region(self, region: Region) -> Region:
        """In source pixels: box, mask, area, thickness, and the lengths in its evidence."""
        box, step = self.box(region.bbox), math.sqrt(math.prod(self.step_px))
        mask = cv2.resize(region.mask.view(np.uint8), (box.width, box.height), interpolation=cv2.INTER_NEAREST) != 0
        lengths = {name: step * float(region.evidence[name]) for name in LENGTHS if name in region.evidence}
        return replace(
            region,
            bbox=box,
            x_extent_px=box.width,
            y_extent_px=box.height,
            area_px=int(np.count_nonzero(mask)),
            thickness_px=step * region.thickness_px,
            evidence={**region.evidence, **lengths},
            mask=np.asarray(mask, dtype=np.bool_),
        )

    def map(self, values: Float32Array) -> Float32Array:
        """[height, width(, C)] -> [source_height, source_width(, C)], bilinear."""
        return np.asarray(self._resized(values, cv2.INTER_LINEAR), dtype=np.float32)

    def mask(self, inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Likewise, each pixel as the nearest one."""
        return np.asarray(self._resized(inside.view(np.uint8), cv2.INTER_NEAREST), dtype=np.bool_)

    def coordinates(self, target_px: Float32Array) -> Float32Array:
        """[height, width, 2] positions in the internal target -> [source_height, source_width, 2] in the source's."""
        whole = self.map(target_px)
        whole += np.float32(0.5)
        whole *= np.array(self.step_px, dtype=np.float32)
        whole -= np.float32(0.5)
        return whole

    def _resized(self, values: NDArray[Any], interpolation: int) -> NDArray[Any]:
        size = (self.source_width, self.source_height)
        return np.asarray(cv2.resize(values, size, interpolation=interpolation))


def internal_size(width: int, height: int, short_side_px: int) -> InternalSize | None:
    """The size at which a width x height picture is judged; None: its own.

    Args:
        short_side_px: of the judged picture, whatever its proportions; 0: every picture is judged as it came.
    """
    shorter = min(width, height)
    if not short_side_px or shorter <= WORTH_IT * short_side_px:
        return None
    scale = short_side_px / shorter
    return InternalSize(round(width * scale), round(height * scale), width, height)
