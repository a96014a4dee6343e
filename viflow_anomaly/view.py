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

from viflow_anomaly.config import ViewConfig
from viflow_anomaly.errors import InvalidInputError, TooLargeError
from viflow_anomaly.geometry import Float32Array, pixel_grid, project_rays, unproject_pixels
from viflow_anomaly.sensor_data import DistortionModel, Float64Array, PinholeCamera, Uint8Array

SIDE_MULTIPLE_PX = 32
LENS_LATTICE_PX = 8
"""Lens maps are solved on a lattice of 8 source pixels and interpolated: the error stays below 0.03 px."""
MAX_SIDE_PX = 32767
MAX_ROUND_TRIP_PX = 1.0
"""A lens is understood where undoing and redoing its distortion comes back this close."""


@dataclass(frozen=True, eq=False)
class _LensMaps:
    """Lookup tables of a distorted camera.

    Attributes:
        camera: whose distortion they undo.
        source_of_view: [h, w, 2] source pixel of every view pixel.
        view_of_source: [H, W, 2] view pixel of every source pixel.
    """

    camera: PinholeCamera
    source_of_view: Float32Array
    view_of_source: Float32Array

    def distorted_flow(self, view: InternalView, flow_view_px: Float32Array, stride: int) -> Float32Array:
        """Flow of the ideal view [h', w', 2] -> flow in distorted source pixels at the same cells."""
        height, width = flow_view_px.shape[:2]
        offset = (pixel_grid(height, width) + np.float32(0.5)) * np.float32(stride) - np.float32(0.5)
        from_middle = (offset - np.array(view.middle_px, dtype=np.float32)).astype(np.float32)
        to_ray = np.array(view.step_px, dtype=np.float32) / np.array((self.camera.fx, self.camera.fy), dtype=np.float32)
        source = project_rays(self.camera, (from_middle * to_ray).astype(np.float32))
        target = project_rays(self.camera, ((from_middle + flow_view_px) * to_ray).astype(np.float32))
        return np.asarray(target - source, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class InternalView:
    """How one source image size (and camera) is seen by a network. Stateless and shareable between threads.

    For an undistorted camera ``source = (view - middle) * step + center``; with distortion the lens maps say where.

    Attributes:
        width, height: of the view, multiples of 32 (the paper's crop: exactly its size).
        source_width, source_height: of the image as it was sent.
        step_px: (x, y) source pixels for one view pixel.
        center_px: (u, v) source pixel in the middle of the view.
        lens: how the source's distortion is undone, else None.
    """

    width: int
    height: int
    source_width: int
    source_height: int
    step_px: tuple[float, float]
    center_px: tuple[float, float]
    lens: _LensMaps | None = None

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
            return np.asarray(_sample(image, at_px), dtype=np.uint8)
        scales = [step / block for step in self.step_px]
        offsets = [
            (center + 0.5) / block - 0.5 - middle * scale
            for center, middle, scale in zip(self.center_px, self.middle_px, scales, strict=True)
        ]
        return np.asarray(_sample_affine(image, scales, offsets, (self.width, self.height)), dtype=np.uint8)

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
        if self.lens is not None:
            cells = (self.lens.view_of_source + np.float32(0.5)) / np.float32(stride) - np.float32(0.5)
            spread = _sample(self.lens.distorted_flow(self, flow_view_px, stride), cells)
        else:
            scales = [1 / (step * stride) for step in self.step_px]
            offsets = [
                (middle + 0.5) / stride - 0.5 - center * scale
                for center, middle, scale in zip(self.center_px, self.middle_px, scales, strict=True)
            ]
            flow = flow_view_px * np.array(self.step_px, dtype=np.float32)
            spread = _sample_affine(flow, scales, offsets, (self.source_width, self.source_height))
        return np.asarray(cv2.add(spread, _source_grid(self.source_height, self.source_width)), dtype=np.float32)

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


def _sample(array: NDArray[Any], at_px: Float32Array) -> NDArray[Any]:
    """Bilinear samples of [H, W(, C)] at [h, w, 2] pixel coordinates; the border is repeated."""
    return cv2.remap(  # type: ignore[call-overload, no-any-return]  # the stubs lack the two-channel map
        array, at_px, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )


def _sample_affine(
    array: NDArray[Any], scales: Sequence[float], offsets: Sequence[float], size: tuple[int, int]
) -> NDArray[Any]:
    """Bilinear samples of [H, W(, C)] at pixel * scale + offset, for every pixel of an image of ``size`` (w, h)."""
    matrix = np.array([[scales[0], 0.0, offsets[0]], [0.0, scales[1], offsets[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(array, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)


@lru_cache(maxsize=8)
def _source_grid(height: int, width: int) -> Float32Array:
    grid = pixel_grid(height, width)
    grid.setflags(write=False)
    return grid


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


_CameraKey = tuple[float, float, float, float, DistortionModel, tuple[float, ...]]


@lru_cache(maxsize=8)
def _pinhole_view(config: ViewConfig, width: int, height: int, key: _CameraKey) -> InternalView:
    fx, fy, cx, cy, model, coefficients = key
    camera = PinholeCamera(fx, fy, cx, cy, width, height, model, coefficients)
    lattice_rays = _lattice_rays(camera) if camera.is_distorted else None
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
    )
    if lattice_rays is not None:
        view = replace(view, lens=_solve_lens_maps(view, camera, lattice_rays))
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


def _lattice_rays(camera: PinholeCamera) -> Float64Array:
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


def _solve_lens_maps(view: InternalView, camera: PinholeCamera, lattice_rays: Float64Array) -> _LensMaps:
    """Lookup tables of a view that has none yet."""
    offset = pixel_grid(view.height, view.width) - view.middle_px
    source_of_view = project_rays(camera, offset * np.array(view.step_px) / (camera.fx, camera.fy))
    coarse = lattice_rays * np.array((camera.fx, camera.fy)) / view.step_px + view.middle_px
    cells = pixel_grid(view.source_height, view.source_width) / np.float32(LENS_LATTICE_PX)
    view_of_source = np.asarray(_sample(coarse.astype(np.float32), cells), dtype=np.float32)
    return _LensMaps(camera, source_of_view.astype(np.float32), view_of_source)
