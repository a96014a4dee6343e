"""The internal view: the image a network sees, and the way back from its flow to source pixels.

A view is a pinhole image without distortion whose middle is the principal point. With a calibration its focal length
is fixed (``ViewConfig.focal_px``), so that the same motion gives the same flow on every camera; without one the source
image is shrunk; the paper's centre crop is a view with step 1. Sides are rounded up to multiples of 32 (the networks'
coarsest stride); what lies beyond the source image repeats its border.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.array_cache import MEBIBYTE, ArrayCache
from viflow_anomaly.config import ViewConfig
from viflow_anomaly.errors import InvalidInputError, TooLargeError
from viflow_anomaly.geometry import Float32Array, cached_pixel_grid, sample_bilinear, unproject_pixels
from viflow_anomaly.lens import LensMaps, lattice_rays, solve_lens_maps
from viflow_anomaly.sensor_data import DistortionModel, PinholeCamera, Uint8Array

SIDE_MULTIPLE_PX = 32
MAX_SIDE_PX = 32767


@dataclass(frozen=True, eq=False)
class InternalView:
    """How one source image size (and camera) is seen by a network. Stateless and shareable between threads.

    For an undistorted camera ``source = (view - middle) * step + center``; with distortion the lens maps say where.

    Attributes:
        width, height: of the view, multiples of 32 (the paper's crop: exactly its size).
        source_width, source_height: of the image as it was sent.
        step_px: (x, y) source pixels for one view pixel.
        center_px: (u, v) source pixel in the middle of the view.
        focal_px: of the view; the configuration's where no camera says another one.
        lens: how the source's distortion is undone, else None.
    """

    width: int
    height: int
    source_width: int
    source_height: int
    step_px: tuple[float, float]
    center_px: tuple[float, float]
    focal_px: float
    lens: LensMaps | None = None

    @property
    def middle_px(self) -> tuple[float, float]:
        """(u, v) of the view's middle in its own pixels."""
        return (self.width - 1) / 2, (self.height - 1) / 2

    def render(self, image: Uint8Array) -> Uint8Array:
        """Source image [H, W] -> view [h, w]; shrinking is antialiased by averaging whole blocks first."""
        block = min(max(1, round(min(self.step_px))), *image.shape)
        if block > 1:
            rows, columns = image.shape[0] // block, image.shape[1] // block
            image = np.asarray(
                cv2.resize(image[: rows * block, : columns * block], (columns, rows), interpolation=cv2.INTER_AREA),
                dtype=np.uint8,
            )
        if self.lens is not None:
            at_px = (self.lens.source_of_view + np.float32(0.5)) / np.float32(block) - np.float32(0.5)
            return np.asarray(sample_bilinear(image, at_px), dtype=np.uint8)
        scales = [step / block for step in self.step_px]
        offsets = [
            (center + 0.5) / block - 0.5 - middle * scale
            for center, middle, scale in zip(self.center_px, self.middle_px, scales, strict=True)
        ]
        return np.asarray(_sample_affine(image, scales, offsets, (self.width, self.height)), dtype=np.uint8)

    def target_coordinates(self, flow_view_px: Float32Array, stride: int) -> Float32Array:
        """Where each source pixel is predicted to be in the target image, in source-image pixels.

        Args:
            flow_view_px: [ceil(h / stride), ceil(w / stride), 2] flow in view pixels; cell (i, j) is centred on view
                pixel ((j + 0.5) * stride - 0.5, (i + 0.5) * stride - 0.5).
            stride: view pixels for one flow cell.

        Returns:
            [H, W, 2] float32 (u, v).
        """
        if self.lens is not None:
            coordinates = self.lens.spread(flow_view_px, stride)
        else:
            scales = [1 / (step * stride) for step in self.step_px]
            offsets = [
                (middle + 0.5) / stride - 0.5 - center * scale
                for center, middle, scale in zip(self.center_px, self.middle_px, scales, strict=True)
            ]
            along_x, along_y = (
                _bilinear_weights(cells, scale, offset, side)
                for cells, scale, offset, side in zip(
                    flow_view_px.shape[1::-1], scales, offsets, (self.source_width, self.source_height), strict=True
                )
            )
            wide = np.empty((len(flow_view_px), self.source_width, 2), dtype=np.float32)
            for axis, step in enumerate(self.step_px):
                wide[..., axis] = (flow_view_px[..., axis] * np.float32(step)) @ along_x.T
            coordinates = (along_y @ wide.reshape(len(wide), -1)).reshape(self.source_height, self.source_width, 2)
        coordinates += cached_pixel_grid(self.source_height, self.source_width)
        return coordinates

    def sample_blocks(self, cells: Float32Array, stride: int, block_px: int) -> Float32Array:
        """What cells of the view (as in ``target_coordinates``) say of the middle of each block of source pixels.

        Args:
            cells: [h, w, C], C at most 4; anything, not converted.
            stride: view pixels for one cell.
            block_px: sides of a block; the first one's corner is the image's.

        Returns:
            [ceil(H / block_px), ceil(W / block_px), C] float32.
        """
        rows, columns = -(-self.source_height // block_px), -(-self.source_width // block_px)
        if self.lens is not None:
            at = self.lens.cells_of_blocks(cells.shape[:2], stride, block_px)
            return np.asarray(sample_bilinear(cells, at), dtype=np.float32)
        scales = [1 / (step * stride) for step in self.step_px]
        offsets = [
            (middle + 0.5) / stride - 0.5 - center * scale + (block_px - 1) / 2 * scale
            for center, middle, scale in zip(self.center_px, self.middle_px, scales, strict=True)
        ]
        blocks = _sample_affine(cells, [scale * block_px for scale in scales], offsets, (columns, rows))
        return np.asarray(blocks, dtype=np.float32)

    @property
    def held_bytes(self) -> int:
        """Bytes of the arrays that the view holds, or will hold once ``analyzed`` was asked."""
        if self.lens is None:
            return 0
        return self.lens.held_bytes + self.source_width * self.source_height

    def analyzed(self) -> NDArray[np.bool_] | None:
        """[H, W]: source pixels that the view shows, or None when it shows all of them."""
        if self.lens is not None:
            return self._lens_shown[0]
        x, y, width, height = self.region()
        if (width, height) == (self.source_width, self.source_height):
            return None
        mask = np.zeros((self.source_height, self.source_width), dtype=np.bool_)
        mask[y : y + height, x : x + width] = True
        return mask

    def region(self) -> tuple[int, int, int, int]:
        """(x, y, width, height): bounding box of the analysed source pixels; 0 wide and high when there are none."""
        if self.lens is not None:
            return self._lens_shown[1]
        spans = []
        sides = ((self.width, self.source_width), (self.height, self.source_height))
        for (side, limit), step, center in zip(sides, self.step_px, self.center_px, strict=True):
            first = max(0, math.ceil(center - side / 2 * step - 1e-6))
            last = min(limit - 1, math.floor(center + side / 2 * step + 1e-6 - 1e-3))
            spans.append((first, last - first + 1))
        (x, width), (y, height) = spans
        return (x, y, width, height) if width > 0 and height > 0 else (0, 0, 0, 0)

    @cached_property
    def _lens_shown(self) -> tuple[NDArray[np.bool_], tuple[int, int, int, int]]:
        """What ``analyzed`` and ``region`` answer for a lens: milliseconds to find, the same for every frame."""
        assert self.lens is not None
        view = self.lens.view_of_source
        mask = np.asarray(((view >= -0.5) & (view <= (self.width - 0.5, self.height - 0.5))).all(axis=-1))
        mask.setflags(write=False)
        x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
        return mask, (x, y, width, height)


def _sample_affine(
    array: NDArray[Any], scales: Sequence[float], offsets: Sequence[float], size: tuple[int, int]
) -> NDArray[Any]:
    """Bilinear samples of [H, W(, C)] at pixel * scale + offset, for every pixel of an image of ``size`` (w, h)."""
    matrix = np.array([[scales[0], 0.0, offsets[0]], [0.0, scales[1], offsets[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(array, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)


@lru_cache(maxsize=16)
def _bilinear_weights(cells: int, scale: float, offset: float, side: int) -> Float32Array:
    """[side, cells]: how every pixel, at pixel * scale + offset, is made of two cells; beyond the last ones, of those.

    For a few cells, two products with such matrices take a third of the time of OpenCV's warp, which for two channels
    also rounds places to 1/32 of a cell.
    """
    at = np.clip(np.arange(side) * scale + offset, 0, cells - 1)
    first = np.minimum(at.astype(np.intp), max(cells - 2, 0))
    weights = np.zeros((side, cells), dtype=np.float32)
    weights[np.arange(side), first] = 1 - (at - first)
    weights[np.arange(side), np.minimum(first + 1, cells - 1)] += at - first
    weights.setflags(write=False)
    return weights


# An image of the largest size that the default limits allow (16 Mi pixels) fits into it.
_VIEWS: ArrayCache[InternalView] = ArrayCache(256 * MEBIBYTE)


def make_view(config: ViewConfig, *, width: int, height: int, camera: PinholeCamera | None) -> InternalView:
    """The view of a width x height source image, cached by value (lens maps take milliseconds to solve).

    Raises:
        InvalidInputError: ``image_smaller_than_crop`` when the paper's crop does not fit; ``camera_invalid`` when the
            distortion cannot be undone or the principal point is too far from the image.
        TooLargeError: ``image_too_large``, a side beyond 32767 px (a limit of cv2.remap).
    """
    if max(width, height) > MAX_SIDE_PX:
        raise TooLargeError(
            f"image: expected sides of at most {MAX_SIDE_PX} px, found {width}x{height}",
            code="image_too_large",
            field="image",
        )
    if config.mode == "center_crop":
        return _crop_view(config, width, height, camera)
    if camera is None:
        return _shrunk_view(config, width, height)
    # What a view depends on: cameras that differ in their mounting or clock alone share one.
    key = (camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion_model, camera.distortion_coeffs)
    return _VIEWS.get(
        (config, width, height, key),
        lambda: _pinhole_view(config, width, height, key),
        lambda view: view.held_bytes,
    )


def _crop_view(config: ViewConfig, width: int, height: int, camera: PinholeCamera | None) -> InternalView:
    side = config.crop_size
    if width < side or height < side:
        raise InvalidInputError(
            f"image: expected at least {side}x{side} px for the centre crop of this model, found {width}x{height}",
            code="image_smaller_than_crop",
            field="image",
        )
    x, y = (width - side) // 2, (height - side) // 2
    center = (x + (side - 1) / 2, y + (side - 1) / 2)
    focal_px = config.focal_px if camera is None else camera.fx
    return InternalView(side, side, width, height, (1.0, 1.0), center, focal_px)


def _shrunk_view(config: ViewConfig, width: int, height: int) -> InternalView:
    step = max(1.0, width / config.max_width, height / config.max_height)
    center = ((width - 1) / 2, (height - 1) / 2)
    return InternalView(
        _padded(width / step), _padded(height / step), width, height, (step, step), center, config.focal_px
    )


_CameraKey = tuple[float, float, float, float, DistortionModel, tuple[float, ...]]


def _pinhole_view(config: ViewConfig, width: int, height: int, key: _CameraKey) -> InternalView:
    fx, fy, cx, cy, model, coefficients = key
    camera = PinholeCamera(fx, fy, cx, cy, width, height, model, coefficients)
    rays = lattice_rays(camera) if camera.is_distorted else None
    border = np.array([(0, 0), (cx, 0), (width - 1, 0), (width - 1, cy), (width - 1, height - 1), (cx, height - 1)])
    border = np.concatenate([border, [(0, height - 1), (0, cy)]])
    reach_x, reach_y = np.abs(unproject_pixels(camera, border)).max(axis=0) * config.focal_px
    view = InternalView(
        min(_padded(2 * reach_x), _padded(config.max_pinhole_width)),
        min(_padded(2 * reach_y), _padded(config.max_pinhole_height)),
        width,
        height,
        (fx / config.focal_px, fy / config.focal_px),
        (cx, cy),
        config.focal_px,
    )
    if rays is not None:
        lens = solve_lens_maps(camera, rays, width=view.width, height=view.height, step_px=view.step_px)
        view = replace(view, lens=lens)
    if not all(view.region()[2:]):
        raise InvalidInputError(
            f"cx, cy: expected a principal point near enough for the view around it to show a part of the {width}x"
            f"{height} image, found ({cx:g}, {cy:g})",
            code="camera_invalid",
            field="camera.cx",
        )
    return view


def _padded(side: float) -> int:
    """The next multiple of 32; a hair above one (a principal point off by a pixel) stays on it."""
    return max(1, math.ceil(side / SIDE_MULTIPLE_PX - 0.1)) * SIDE_MULTIPLE_PX
