"""A distorted camera: its image's pixels as rays, and the tables between that image and the internal view.

Undoing a distortion has no closed form. It is solved by iteration on a lattice of the image and interpolated between;
a distortion that folds the image, so that two of its pixels show the same ray, is refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.geometry import Float32Array, pixel_grid, project_rays, sample_bilinear, unproject_pixels
from viflow_anomaly.sensor_data import Float64Array, PinholeCamera

LENS_LATTICE_PX = 8
"""Lens maps are solved on a lattice of 8 source pixels and interpolated: the error stays below 0.03 px, in the corners
of a fisheye's view (60 degrees off its axis) below 0.4 px."""
MAX_ROUND_TRIP_PX = 1.0
"""A lens is understood where undoing and redoing its distortion comes back this close."""


class _CellMaps(NamedTuple):
    """What a flow on cells of one stride needs, the same for every frame.

    Attributes:
        cells_of_source: [H, W, 2] flow cell of every source pixel.
        from_middle: [h, w, 2] view pixels of each cell from the view's middle.
        source: [h, w, 2] source pixel of each cell.
        of_blocks: by a block's sides, [rows, columns, 2] the flow cell of the middle of each block of source pixels.
    """

    cells_of_source: Float32Array
    from_middle: Float32Array
    source: Float32Array
    of_blocks: dict[int, Float32Array]


@dataclass(frozen=True, eq=False)
class LensMaps:
    """Lookup tables of a distorted camera.

    Attributes:
        camera: whose distortion they undo.
        step_px: (x, y) source pixels for one view pixel, where there is no distortion.
        source_of_view: [h, w, 2] source pixel of every view pixel.
        view_of_source: [H, W, 2] view pixel of every source pixel.
    """

    camera: PinholeCamera
    step_px: tuple[float, float]
    source_of_view: Float32Array
    view_of_source: Float32Array
    _by_stride: dict[int, _CellMaps] = field(default_factory=dict, repr=False)

    @property
    def held_bytes(self) -> int:
        """Of all tables, those that a first flow will add included (of its blocks: a sixteenth)."""
        return self.source_of_view.nbytes + self.view_of_source.nbytes * 33 // 16

    def spread(self, flow_view_px: Float32Array, stride: int) -> Float32Array:
        """Flow of the ideal view on cells [h', w', 2] -> flow of every distorted source pixel [H, W, 2]."""
        maps = self._cell_maps(flow_view_px.shape[:2], stride)
        target = project_rays(self.camera, (maps.from_middle + flow_view_px) * self._to_ray())
        flow = np.asarray(target - maps.source, dtype=np.float32)
        return np.asarray(sample_bilinear(flow, maps.cells_of_source), dtype=np.float32)

    def cells_of_blocks(self, shape: tuple[int, ...], stride: int, block_px: int) -> Float32Array:
        """[rows, columns, 2]: flow cell of the middle of each block of ``block_px`` source pixels."""
        maps = self._cell_maps(shape, stride)
        known = maps.of_blocks.get(block_px)
        if known is None:
            sides = maps.cells_of_source.shape[:2]
            rows, columns = (np.minimum(np.arange(0, side, block_px) + block_px // 2, side - 1) for side in sides)
            known = np.asarray(maps.cells_of_source[np.ix_(rows, columns)])
            maps.of_blocks.clear()  # the evidence has one size of blocks
            maps.of_blocks[block_px] = known
        return known

    def _cell_maps(self, shape: tuple[int, ...], stride: int) -> _CellMaps:
        """Made once; two threads that make the same maps make the same values."""
        maps = self._by_stride.get(stride)
        if maps is None:
            half = np.float32(0.5)
            offset = (pixel_grid(shape[0], shape[1]) + half) * np.float32(stride) - half
            view_height, view_width = self.source_of_view.shape[:2]
            from_middle = (offset - _middle_px(view_width, view_height)).astype(np.float32)
            source = project_rays(self.camera, from_middle * self._to_ray()).astype(np.float32)
            cells = (self.view_of_source + half) / np.float32(stride) - half
            self._by_stride.clear()  # a network has one stride
            maps = self._by_stride[stride] = _CellMaps(cells, from_middle, source, {})
        return maps

    def _to_ray(self) -> Float32Array:
        return np.array((self.step_px[0] / self.camera.fx, self.step_px[1] / self.camera.fy), dtype=np.float32)


def lattice_rays(camera: PinholeCamera) -> Float64Array:
    """Undistorted rays [rows, columns, 2] of every 8th source pixel, the last ones up to 7 px beyond the image.

    Pixels of a fisheye that look 90 degrees or more off the axis have no place in a pinhole view: far rays.

    Raises:
        InvalidInputError: ``camera_invalid``: the distortion folds the image.
    """
    rows, columns = (math.ceil((side - 1) / LENS_LATTICE_PX) + 1 for side in (camera.height, camera.width))
    pixels = pixel_grid(rows, columns) * LENS_LATTICE_PX
    offset = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    with np.errstate(all="ignore"):  # what diverges is found below
        rays = unproject_pixels(camera, pixels)
        lost = ~(np.abs(project_rays(camera, rays) - pixels).max(axis=-1) <= MAX_ROUND_TRIP_PX)
        in_order = (np.diff(rays[..., 0], axis=1) > 0).all() and (np.diff(rays[..., 1], axis=0) > 0).all()
    if camera.distortion_model == "equidistant":
        folds = _fisheye_folds(camera, float(np.hypot(offset[..., 0], offset[..., 1]).max()))
    else:
        folds = lost.any() or not in_order
    if folds:
        raise InvalidInputError(
            "distortion_coeffs: expected a distortion that can be undone over the whole image, "
            f"found {list(camera.distortion_coeffs)} for {camera.distortion_model}, which folds it or is too strong",
            code="camera_invalid",
            field="camera.distortion_coeffs",
        )
    return np.where(lost[..., None], offset * 1e4, rays)


def _fisheye_folds(camera: PinholeCamera, radius: float) -> bool:
    """Whether two angles below 90 degrees meet within ``radius`` (focal lengths) of the principal point."""
    angles = np.linspace(0.0, 0.5 * np.pi, 513)[:-1]
    curve = (project_rays(camera, np.stack([np.tan(angles), 0 * angles], axis=-1))[:, 0] - camera.cx) / camera.fx
    within = np.logical_and.accumulate(curve[:-1] < radius)
    return bool((np.diff(curve)[within] <= 0).any())


def solve_lens_maps(
    camera: PinholeCamera, rays: Float64Array, *, width: int, height: int, step_px: tuple[float, float]
) -> LensMaps:
    """Lookup tables between the camera's image and a view.

    Args:
        camera: the distorted one.
        rays: its ``lattice_rays``.
        width, height: of the view.
        step_px: as in ``LensMaps``.
    """
    middle_px = _middle_px(width, height)
    offset = pixel_grid(height, width) - middle_px
    source_of_view = project_rays(camera, offset * np.array(step_px) / (camera.fx, camera.fy))
    coarse = rays * np.array((camera.fx, camera.fy)) / step_px + middle_px
    cells = pixel_grid(camera.height, camera.width) / np.float32(LENS_LATTICE_PX)
    view_of_source = np.asarray(sample_bilinear(coarse.astype(np.float32), cells), dtype=np.float32)
    return LensMaps(camera, step_px, source_of_view.astype(np.float32), view_of_source)


def _middle_px(width: int, height: int) -> Float64Array:
    """(u, v) of a view's middle in its own pixels."""
    return np.array([(width - 1) / 2, (height - 1) / 2])
