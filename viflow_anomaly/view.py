"""The internal view: the image a network sees, and the way back from its flow to source pixels.

A view is a pinhole image without distortion whose middle is the principal point. With a calibration its focal length
is fixed (``ViewConfig.focal_px``), so that the same motion gives the same flow on every camera; without one the source
image is shrunk; the paper's centre crop is a view with step 1. Sides are rounded up to multiples of 32 (the networks'
coarsest stride); what lies beyond the source image repeats its border.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.config import ViewConfig
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.geometry import Float32Array, pixel_grid, project_rays, unproject_pixels
from viflow_anomaly.sensor_data import PinholeCamera, Uint8Array

SIDE_MULTIPLE_PX = 32
LENS_LATTICE_PX = 8
"""Lens maps are solved on a lattice of 8 source pixels and interpolated: the error stays below 0.03 px."""


@dataclass(frozen=True, eq=False)
class _LensMaps:
    """Lookup tables of a distorted camera.

    Attributes:
        source_of_view: [h, w, 2] source pixel of every view pixel.
        view_of_source: [H, W, 2] view pixel of every source pixel.
    """

    source_of_view: Float32Array
    view_of_source: Float32Array


@dataclass(frozen=True, eq=False)
class InternalView:
    """How one source image size (and camera) is seen by a network. Stateless and shareable between threads.

    For an undistorted camera ``source = (view - middle) * step + center``; with distortion the lens maps say where.

    Attributes:
        width, height: of the view, multiples of 32 (the paper's crop: exactly its size).
        source_width, source_height: of the image as it was sent.
        step_px: (x, y) source pixels for one view pixel.
        center_px: (u, v) source pixel in the middle of the view.
        camera: the source's calibration when its distortion is undone here, else None.
    """

    width: int
    height: int
    source_width: int
    source_height: int
    step_px: tuple[float, float]
    center_px: tuple[float, float]
    camera: PinholeCamera | None = None
    lens: _LensMaps | None = None

    @property
    def middle_px(self) -> tuple[float, float]:
        """(u, v) of the view's middle in its own pixels."""
        return (self.width - 1) / 2, (self.height - 1) / 2

    def render(self, image: Uint8Array) -> Uint8Array:
        """Source image [H, W] -> view [h, w]; shrinking is antialiased by averaging whole blocks first."""
        block = max(1, round(min(self.step_px)))
        if block > 1:
            rows, columns = image.shape[0] // block, image.shape[1] // block
            image = np.asarray(
                cv2.resize(image[: rows * block, : columns * block], (columns, rows), interpolation=cv2.INTER_AREA),
                dtype=np.uint8,
            )
        if self.lens is not None:
            maps = (self.lens.source_of_view + np.float32(0.5)) / np.float32(block) - np.float32(0.5)
            warped = cv2.remap(image, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
        else:
            matrix = self._source_of_view_affine(block)
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            size = (self.width, self.height)
            warped = cv2.warpAffine(image, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(warped, dtype=np.uint8)

    def covered(self) -> NDArray[np.bool_]:
        """[h, w]: view pixels that show the source image rather than its repeated border."""
        if self.lens is not None:
            source = self.lens.source_of_view
        else:
            source = (pixel_grid(self.height, self.width) - self.middle_px) * self.step_px + self.center_px
        low, high = -0.5, np.array([self.source_width, self.source_height]) - 0.5
        return np.asarray(((source >= low) & (source <= high)).all(axis=-1))

    def target_coordinates(self, flow_view_px: Float32Array, stride: int) -> Float32Array:
        """Where each source pixel is predicted to be in the target image, in source-image pixels.

        Args:
            flow_view_px: [ceil(h / stride), ceil(w / stride), 2] flow in view pixels; cell (i, j) is centred on view
                pixel ((j + 0.5) * stride - 0.5, (i + 0.5) * stride - 0.5).
            stride: view pixels for one flow cell.

        Returns:
            [H, W, 2] float32 (u, v).
        """
        flow = flow_view_px if self.camera is None else self._distorted_flow(flow_view_px, stride)
        size = (self.source_width, self.source_height)
        if self.lens is not None:
            cells = (self.lens.view_of_source + np.float32(0.5)) / np.float32(stride) - np.float32(0.5)
            spread = cv2.remap(flow, cells, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
        else:
            flow = flow * np.array(self.step_px, dtype=np.float32)
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            matrix = self._cell_of_source_affine(stride)
            spread = cv2.warpAffine(flow, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(cv2.add(np.asarray(spread), _source_grid(self.source_height, self.source_width)))

    def analyzed(self) -> NDArray[np.bool_] | None:
        """[H, W]: source pixels that the view shows, or None when it shows all of them."""
        if self.lens is not None:
            view = self.lens.view_of_source
            return np.asarray(((view >= -0.5) & (view <= (self.width - 0.5, self.height - 0.5))).all(axis=-1))
        x, y, width, height = self.region()
        if (width, height) == (self.source_width, self.source_height):
            return None
        mask = np.zeros((self.source_height, self.source_width), dtype=np.bool_)
        mask[y : y + height, x : x + width] = True
        return mask

    def region(self) -> tuple[int, int, int, int]:
        """(x, y, width, height): bounding box of the analysed source pixels."""
        if self.lens is not None:
            rows = np.flatnonzero((mask := self.analyzed()).any(axis=1))  # type: ignore[union-attr]
            columns = np.flatnonzero(mask.any(axis=0))  # type: ignore[union-attr]
            x, y = int(columns[0]), int(rows[0])
            return x, y, int(columns[-1]) - x + 1, int(rows[-1]) - y + 1
        spans = []
        sides = ((self.width, self.source_width), (self.height, self.source_height))
        for (side, limit), step, center in zip(sides, self.step_px, self.center_px, strict=True):
            first = max(0, math.ceil(center - side / 2 * step - 1e-6))
            last = min(limit - 1, math.floor(center + side / 2 * step + 1e-6 - 1e-3))
            spans.append((first, last - first + 1))
        (x, width), (y, height) = spans
        return x, y, width, height

    def _source_of_view_affine(self, block: int) -> NDArray[np.float64]:
        rows = []
        for axis, (step, center, middle) in enumerate(zip(self.step_px, self.center_px, self.middle_px, strict=True)):
            scale = step / block
            offset = (center + 0.5) / block - 0.5 - middle * scale
            rows.append([scale * (axis == 0), scale * (axis == 1), offset])
        return np.array(rows)

    def _cell_of_source_affine(self, stride: int) -> NDArray[np.float64]:
        rows = []
        for axis, (step, center, middle) in enumerate(zip(self.step_px, self.center_px, self.middle_px, strict=True)):
            scale = 1 / (step * stride)
            offset = (middle + 0.5) / stride - 0.5 - center * scale
            rows.append([scale * (axis == 0), scale * (axis == 1), offset])
        return np.array(rows)

    def _distorted_flow(self, flow_view_px: Float32Array, stride: int) -> Float32Array:
        """Flow of the ideal view [h', w', 2] -> flow in distorted source pixels at the same cells."""
        assert self.camera is not None
        height, width = flow_view_px.shape[:2]
        cells = (pixel_grid(height, width) + 0.5) * stride - 0.5 - np.array(self.middle_px, dtype=np.float32)
        to_ray = np.array(self.step_px, dtype=np.float32) / np.array((self.camera.fx, self.camera.fy), dtype=np.float32)
        source = project_rays(self.camera, cells * to_ray)
        target = project_rays(self.camera, (cells + flow_view_px) * to_ray)
        return np.asarray(target - source, dtype=np.float32)


@lru_cache(maxsize=8)
def _source_grid(height: int, width: int) -> Float32Array:
    grid = pixel_grid(height, width)
    grid.setflags(write=False)
    return grid


def make_view(config: ViewConfig, *, width: int, height: int, camera: PinholeCamera | None) -> InternalView:
    """The view of a width x height source image, cached by value (lens maps take milliseconds to solve).

    Raises:
        InvalidInputError: ``image_smaller_than_crop`` when the paper's crop does not fit.
    """
    if config.mode == "center_crop":
        return _crop_view(config, width, height)
    if camera is None:
        return _shrunk_view(config, width, height)
    key = (camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion_model, camera.distortion_coeffs)
    return _pinhole_view(config, width, height, key)


def _crop_view(config: ViewConfig, width: int, height: int) -> InternalView:
    side = config.crop_size
    if width < side or height < side:
        raise InvalidInputError(
            f"image: expected at least {side}x{side} px for the centre crop of this model, found {width}x{height}",
            code="image_smaller_than_crop",
            field="image",
        )
    x, y = (width - side) // 2, (height - side) // 2
    center = (x + (side - 1) / 2, y + (side - 1) / 2)
    return InternalView(side, side, width, height, (1.0, 1.0), center)


def _shrunk_view(config: ViewConfig, width: int, height: int) -> InternalView:
    step = max(1.0, width / config.max_width, height / config.max_height)
    center = ((width - 1) / 2, (height - 1) / 2)
    return InternalView(_padded(width / step), _padded(height / step), width, height, (step, step), center)


_CameraKey = tuple[float, float, float, float, str, tuple[float, ...]]


@lru_cache(maxsize=8)
def _pinhole_view(config: ViewConfig, width: int, height: int, key: _CameraKey) -> InternalView:
    fx, fy, cx, cy, model, coefficients = key
    camera = PinholeCamera(
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        width=width,
        height=height,
        distortion_model=model,  # type: ignore[arg-type]
        distortion_coeffs=coefficients,
    )
    border = np.array([(0, 0), (cx, 0), (width - 1, 0), (width - 1, cy), (width - 1, height - 1), (cx, height - 1)])
    border = np.concatenate([border, [(0, height - 1), (0, cy)]])
    reach_x, reach_y = np.abs(unproject_pixels(camera, border)).max(axis=0) * config.focal_px
    view_width = min(_padded(2 * reach_x), _padded(config.max_width))
    view_height = min(_padded(2 * reach_y), _padded(config.max_height))
    view = InternalView(
        view_width,
        view_height,
        width,
        height,
        (fx / config.focal_px, fy / config.focal_px),
        (cx, cy),
        camera if camera.is_distorted else None,
    )
    if not camera.is_distorted:
        return view
    lens = _LensMaps(_solve_source_of_view(view, camera), _solve_view_of_source(view, camera))
    return InternalView(
        view_width, view_height, width, height, view.step_px, view.center_px, camera, lens
    )


def _padded(side: float) -> int:
    """The next multiple of 32; a hair above one (a principal point off by a pixel) stays on it."""
    return max(1, math.ceil(side / SIDE_MULTIPLE_PX - 0.1)) * SIDE_MULTIPLE_PX


def _solve_source_of_view(view: InternalView, camera: PinholeCamera) -> Float32Array:
    offset = pixel_grid(view.height, view.width) - view.middle_px
    rays = offset * np.array(view.step_px) / (camera.fx, camera.fy)
    return np.asarray(project_rays(camera, rays), dtype=np.float32)


def _solve_view_of_source(view: InternalView, camera: PinholeCamera) -> Float32Array:
    rows = math.ceil(view.source_height / LENS_LATTICE_PX) + 1
    columns = math.ceil(view.source_width / LENS_LATTICE_PX) + 1
    lattice = pixel_grid(rows, columns) * LENS_LATTICE_PX
    rays = unproject_pixels(camera, lattice)
    coarse = rays * np.array((camera.fx, camera.fy)) / view.step_px + view.middle_px
    cells = pixel_grid(view.source_height, view.source_width) / np.float32(LENS_LATTICE_PX)
    return np.asarray(cv2.remap(coarse.astype(np.float32), cells, None, cv2.INTER_LINEAR), dtype=np.float32)  # type: ignore[call-overload]
