"""Residual map -> regions of interest: smooth, threshold, clean up, label, judge the shape.

The paper's way out of "model error also leaves a residual" [Limitations]: model error lies in narrow bands, long in X
or in Y, rarely both; independent motion is extended in X and Y at once. That rule looks at the axis-aligned extents, so
a *diagonal* thin band passes as motion; its thickness and fill ratio are in the evidence, and lower its score. Other
rules are in ``shape_rule``.

Lengths in the configuration are fractions of the image diagonal, so that an image twice as large gives boxes twice as
large and the same labels.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.config import RegionConfig
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.shape_rule import ShapeLimits, judge_shape, thickness_px

BoolArray = NDArray[np.bool_]
IndexArray = NDArray[np.intp]
LabelArray = NDArray[np.integer[Any]]
RegionLabel = Literal["independent_motion", "model_error"]

MAD_TO_SIGMA = 1.4826
"""Median absolute deviation of a normal distribution -> its standard deviation."""
STATISTICS_SAMPLES = 2_500
"""Enough for the median to three hundredths of a sigma; more only costs time."""


class BoundingBox(NamedTuple):
    """Whole pixels, x right and y down, left-top inclusive."""

    x: int
    y: int
    width: int
    height: int

    @property
    def middle_px(self) -> tuple[float, float]:
        """(u, v); pixel centres lie at integers."""
        return self.x + (self.width - 1) / 2, self.y + (self.height - 1) / 2

    @property
    def pixels(self) -> tuple[slice, slice]:
        """Rows and columns of an array [H, W]."""
        return slice(self.y, self.y + self.height), slice(self.x, self.x + self.width)


@dataclass(frozen=True, eq=False)
class Region:
    """One connected component of high residual, all in pixels of the residual map.

    Attributes:
        score: 0..1, confidence in independent motion.
        x_extent_px, y_extent_px: sides of the bounding box.
        area_px: pixels of the component.
        thickness_px: diameter of the largest disc inside it.
        residual_mean, residual_max: over its pixels, not smoothed, in gray levels.
        evidence: what decided, by name: always ``rule``, ``fill_ratio`` and ``aspect_ratio``; of the residual
            ``contrast`` and ``threshold_gray``; of learned evidence see ``moving_regions``.
        mask: [bbox.height, bbox.width], True on the component.
    """

    label: RegionLabel
    score: float
    bbox: BoundingBox
    x_extent_px: int
    y_extent_px: int
    area_px: int
    thickness_px: float
    residual_mean: float
    residual_max: float
    evidence: dict[str, float | str]
    mask: BoolArray = field(repr=False)


@dataclass(frozen=True, eq=False)
class RegionResult:
    """Regions, highest score first (ties by y then x), the threshold on the evidence (in its unit) and the [H, W] mask
    that they came from."""

    regions: tuple[Region, ...]
    threshold: float
    mask: BoolArray = field(repr=False)


class _Level(NamedTuple):
    """What the residual of a well-explained pixel looks like, and where it stops being one (gray levels)."""

    background_gray: float
    threshold_gray: float


class Component(NamedTuple):
    """Pixels of one component in row-major order: rows y [n] and columns x [n]."""

    y: IndexArray
    x: IndexArray

    def outline(self) -> tuple[BoundingBox, BoolArray]:
        """Bounding box, and the mask [height, width] in it."""
        left, top = int(self.x.min()), int(self.y[0])
        box = BoundingBox(left, top, int(self.x.max()) - left + 1, int(self.y[-1]) - top + 1)
        mask = np.zeros((box.height, box.width), dtype=np.bool_)
        mask[self.y - top, self.x - left] = True
        return box, mask


def find_regions(
    evidence: Float32Array, inside: BoolArray, config: RegionConfig, *, residual: Float32Array | None = None
) -> RegionResult:
    """Connected regions of high evidence, each labelled by the paper's shape rule.

    Args:
        evidence: [H, W] float32 gray levels, finite: the residual or ``texture_normalised``.
        residual: [H, W] float32 what a region's ``residual_mean`` and ``residual_max`` are of (None: the evidence).
        inside: [H, W], False where the target image does not reach; nothing is found there.
        config: thresholds, see ``RegionConfig``.
    """
    height, width = evidence.shape
    diagonal_px = float(np.hypot(height, width))
    smoothed = _smooth(evidence, config.smoothing_fraction * diagonal_px)
    level = _robust_level(smoothed, inside, config)
    closing_px = _odd_side_px(config.closing_fraction * diagonal_px)
    mask = _clean_mask(smoothed, inside, level, _odd_side_px(config.opening_fraction * diagonal_px), closing_px)
    y, x = pixels_of(mask)
    labels = _component_labels(y, x, mask.shape, pitch_px=(closing_px + 1) // 2)
    components = largest_components(y, x, labels, mask.size, config)
    limits = shape_limits(config, diagonal_px)
    regions = [
        _judge(component, evidence, evidence if residual is None else residual, level, config, limits)
        for component in components
    ]
    regions.sort(key=lambda region: (-region.score, region.bbox.y, region.bbox.x))
    return RegionResult(tuple(regions), level.threshold_gray, mask)


def _smooth(residual: Float32Array, sigma_px: float) -> Float32Array:
    """Gaussian cut off at two sigma; below a third of a pixel it would change nothing."""
    if sigma_px < 1 / 3:
        return residual
    size_px = 2 * int(np.ceil(2 * sigma_px)) + 1
    return np.asarray(cv2.GaussianBlur(residual, (size_px, size_px), sigma_px), dtype=np.float32)


def _robust_level(smoothed: Float32Array, inside: BoolArray, config: RegionConfig) -> _Level:
    """median + threshold_mads * 1.4826 * MAD over the inside pixels of a regular lattice, at least the minimum."""
    stride = max(1, int(np.sqrt(smoothed.size / STATISTICS_SAMPLES)))
    sample = smoothed[::stride, ::stride][inside[::stride, ::stride]]
    if not sample.size:
        return _Level(0.0, config.min_residual_gray)
    median = float(np.median(sample))
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(sample - median)))
    return _Level(median, max(config.min_residual_gray, median + config.threshold_mads * sigma))


def _odd_side_px(length_px: float) -> int:
    """The odd kernel side nearest to a length; 1 does nothing."""
    return max(1, 2 * round((length_px - 1) / 2) + 1)


def _clean_mask(
    smoothed: Float32Array, inside: BoolArray, level: _Level, opening_px: int, closing_px: int
) -> BoolArray:
    """[H, W]: above the threshold, opened (specks go) then closed (holes and cracks in one object fill)."""
    binary = ((smoothed > level.threshold_gray) & inside).astype(np.uint8)
    for operation, side_px in ((cv2.MORPH_OPEN, opening_px), (cv2.MORPH_CLOSE, closing_px)):
        if side_px > 1:
            binary = np.asarray(cv2.morphologyEx(binary, operation, np.ones((side_px, side_px), np.uint8)))
    return np.asarray((binary != 0) & inside)


def shape_limits(config: RegionConfig, diagonal_px: float) -> ShapeLimits:
    """The shape rule's limits in pixels of this image."""
    return ShapeLimits(
        min_x_px=config.min_x_extent_fraction * diagonal_px,
        min_y_px=config.min_y_extent_fraction * diagonal_px,
        max_aspect_ratio=config.max_aspect_ratio,
    )


def pixels_of(mask: BoolArray) -> tuple[IndexArray, IndexArray]:
    """Rows y [n] and columns x [n] of a mask's pixels, row-major."""
    at = np.flatnonzero(mask)  # np.nonzero takes five times as long
    y = at // mask.shape[1]
    return y, at - y * mask.shape[1]


def largest_components(
    y: IndexArray, x: IndexArray, labels: LabelArray, image_px: int, config: RegionConfig
) -> list[Component]:
    """Components of at least the minimum area, at most ``max_regions`` (the largest), largest first.

    Only the pixels of the mask are looked at, and no component before its area is known: a noisy mask of thousands of
    specks costs little more than a clean one.

    Args:
        y, x: of the mask's pixels, row-major.
        labels: of each, integers from 1 on; 0 belongs to none.
        image_px: pixels of the image.
        config: limits.
    """
    areas_px = np.bincount(labels, minlength=1)
    areas_px[0] = 0
    largest_first = np.argsort(-areas_px, kind="stable")[: config.max_regions]
    kept = largest_first[areas_px[largest_first] >= max(1.0, config.min_area_fraction * image_px)]
    rank_of_label = np.full(areas_px.size, kept.size)
    rank_of_label[kept] = np.arange(kept.size)
    rank = rank_of_label[labels].astype(np.uint16)  # 16 bits: numpy then sorts in linear time
    by_component = np.argsort(rank, kind="stable")
    ends = np.cumsum(areas_px[kept]).tolist()
    pixels = (by_component[first:end] for first, end in zip([0, *ends], ends, strict=False))
    return [Component(y[some], x[some]) for some in pixels]


def _component_labels(y: IndexArray, x: IndexArray, shape: tuple[int, ...], pitch_px: int) -> IndexArray:
    """Label (1..) of every mask pixel, from scikit-image's 8-connected components.

    They are computed on cells of ``pitch_px`` pixels, which joins pixels across up to 2 * pitch - 2 empty ones: with
    half the side of the closing that is nothing that the closing would not have filled, and a fraction of the time.
    Without closing the cells are the pixels.
    """
    cells = np.zeros([-(-side // pitch_px) for side in shape], dtype=np.bool_)
    cell_y, cell_x = y // pitch_px, x // pitch_px
    cells[cell_y, cell_x] = True
    from skimage.measure import label as label_components  # noqa: PLC0415  # a fifth of a second of start-up

    labels = label_components(cells, connectivity=2)  # type: ignore[no-untyped-call]
    return np.asarray(labels[cell_y, cell_x], dtype=np.intp)


def _judge(
    component: Component,
    evidence: Float32Array,
    residual: Float32Array,
    level: _Level,
    config: RegionConfig,
    limits: ShapeLimits,
) -> Region:
    y, x = component
    box, mask = component.outline()
    values = residual[y, x]
    evidence_gray = float(evidence[y, x].mean())
    fill_ratio = values.size / mask.size
    aspect_ratio = max(box.width, box.height) / min(box.width, box.height)
    contrast = _contrast(evidence_gray, level)
    thickness = thickness_px(mask)
    shape = judge_shape(config.shape_rule, mask, thickness, limits)
    score = _score(shape.passes, contrast, fill_ratio, shape.nearness_to_band)
    reasons: dict[str, float | str] = {
        "rule": shape.verdict,
        "contrast": contrast,
        "threshold_gray": level.threshold_gray,
        "fill_ratio": fill_ratio,
        "aspect_ratio": aspect_ratio,
    }
    moves = shape.passes and score >= config.motion_score
    return region_of(values, box, mask, moves=moves, score=score, thickness_px=thickness, evidence=reasons)


def region_of(
    residual: Float32Array,
    box: BoundingBox,
    mask: BoolArray,
    *,
    moves: bool,
    score: float,
    thickness_px: float,
    evidence: dict[str, float | str],
) -> Region:
    """A judged region; ``residual`` [n] is that of its pixels, ``mask`` that of its box."""
    return Region(
        label="independent_motion" if moves else "model_error",
        score=score,
        bbox=box,
        x_extent_px=box.width,
        y_extent_px=box.height,
        area_px=int(residual.size),
        thickness_px=thickness_px,
        residual_mean=float(residual.mean()),
        residual_max=float(residual.max()),
        evidence=evidence,
        mask=mask,
    )


def _contrast(mean_gray: float, level: _Level) -> float:
    """Residual over background, in units of the threshold over background: 1 is at the threshold."""
    span_gray = max(level.threshold_gray - level.background_gray, 1e-6)
    return max(0.0, (mean_gray - level.background_gray) / span_gray)


def _score(passes: bool, contrast: float, fill_ratio: float, nearness_to_band: float) -> float:
    """0.5 to 1 for an extended region, 0 to 0.5 for a band; rises with contrast, fill and distance from a band.

    score = 0.5 [extended] + 0.5 * c / (1 + c) * sqrt(fill) * (1 - b / 2), where b in 0..1 says how near to a band the
    region is (``Shape``). Rounded, so that equal scores tie in the written answer as well.
    """
    shape = 1.0 - 0.5 * min(nearness_to_band, 1.0)
    strength = contrast / (1.0 + contrast) * float(np.sqrt(fill_ratio)) * shape
    return round((0.5 if passes else 0.0) + 0.5 * strength, 4)
