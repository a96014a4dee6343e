"""From the evidence head's maps to regions: pixels that probably move, cut along seams, scored as probabilities.

Components, the paper's shape rule and the label are those of ``regions``. What differs: the map is a probability and
needs no background to be compared with; two things that touch are cut apart where the head sees a seam; and the score
is fitted (``RegionScore``), so that of regions scored 0.8 about 80 % move by themselves.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from viflow_anomaly.config import EVIDENCE_BLOCK_PX, RegionConfig, RegionScore
from viflow_anomaly.evidence_cues import GEOMETRIC_CUES, HALF_PARALLAX_PX, HALF_REMAINING_PX, EvidenceCues
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.grouping import things_of_pixels
from viflow_anomaly.peaks import divided_at_valleys
from viflow_anomaly.regions import (
    BoolArray,
    BoundingBox,
    Component,
    LabelArray,
    Region,
    largest_components,
    pixels_of,
    region_of,
)
from viflow_anomaly.sensor_data import Float64Array
from viflow_anomaly.shape_rule import Shape, ShapeLimits, judge_shape, thickness_px

SEAM_LOGIT = 0.0
"""Where a seam is as likely as none."""
SEAM_REACH_PX = 5
"""Pixels of a seam go to the component that is nearest, within so many pixels."""
MAX_LOGIT = 8.0
FEATURE_SAMPLES = 512
"""Means over a region are taken over so many of its pixels, evenly spread: more say nothing new, and cost time."""
MAX_AREA_SHARE = 0.6
"""Where more than this of what can be compared seems to move, it is the explanation that is wrong: of another scene,
say, or by a wrong motion of the camera."""
TOO_LARGE = "most_of_the_picture"
BAND_SCORE = 0.49
"""The most that a region scores which the shape rule calls a band, or which is most of the picture."""
REGION_FEATURES = (
    "logit of the mean probability",
    "logit of the largest probability",
    "logarithm of the area's share",
    "fill ratio",
    "nearness to a band",
    "seam",
    "remaining flow across",
    "remaining flow along",
    "mismatch after it",
    "texture",
    "parallax",
    "inside",
    "local flow across",
)
"""What a score is fitted to; the cues are means over the region, bounded as in ``evidence_cues``."""
CUE_FEATURES = REGION_FEATURES[6:]
_CUES = [GEOMETRIC_CUES.index(name) for name in CUE_FEATURES]


LENGTHS = ("across_epipolar_px", "along_epipolar_px", "parallax_px")
"""What a region's evidence tells in pixels of the judged picture."""


class MotionMaps(NamedTuple):
    """What the head says: [H, W] probability of motion and logit of a seam of every source pixel, and offsets
    [2, h, w] of the padded image's blocks to the middle of the thing they belong to, in blocks (y, x)."""

    motion: Float32Array
    seam_logit: Float32Array
    offsets: Float32Array

    @property
    def finite(self) -> bool:
        """False where the head's weights are damaged."""
        return all(bool(np.isfinite(one).all()) for one in self)


class MeasuredRegion(NamedTuple):
    """A component before it has a score: ``features`` [13] are ``REGION_FEATURES``, ``outline`` is its box's mask,
    ``area_share`` its part of what can be compared."""

    component: Component
    box: BoundingBox
    outline: BoolArray
    thickness_px: float
    shape: Shape
    features: Float64Array
    area_share: float


def measure_regions(
    maps: MotionMaps, cues: EvidenceCues, inside: BoolArray, config: RegionConfig
) -> list[MeasuredRegion]:
    """Connected regions that probably move, largest first; arguments as in ``find_moving_regions``."""
    mask = (maps.motion > min(config.min_motion_probability, config.faint_motion_probability)) & inside
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    if not width:
        return []
    part = (slice(top, top + height), slice(left, left + width))
    y, x = pixels_of(mask[part])
    labels = _things(maps, mask[part], part, config)[mask[part]]
    components = largest_components(y + top, x + left, labels, mask.size, config)
    limits, compared_px = _shape_limits(config, float(np.hypot(*mask.shape))), np.count_nonzero(inside)
    measured = []
    for component in components:
        box, outline = component.outline()
        thickness = thickness_px(outline)
        shape = judge_shape(config.shape_rule, outline, thickness, limits)
        features = _features(component, box, maps, cues, outline, shape)
        share = component.y.size / int(compared_px)
        measured.append(MeasuredRegion(component, box, outline, thickness, shape, features, share))
    return measured


def find_moving_regions(
    maps: MotionMaps,
    cues: EvidenceCues,
    inside: BoolArray,
    config: RegionConfig,
    *,
    residual: Float32Array,
    score: RegionScore,
) -> list[Region]:
    """Connected regions that probably move, each labelled by the paper's shape rule and its own probability.

    Args:
        maps: of the head.
        cues: that the head saw.
        inside: [H, W], False where the target image does not reach; nothing is found there.
        config: thresholds, see ``RegionConfig``.
        residual: [H, W] float32 what a region's ``residual_mean`` and ``residual_max`` are of.
        score: as fitted for this head.

    Returns:
        Highest score first, ties by y then x; none below ``config.min_score``.
    """
    judged = (_judge(one, residual, score, config) for one in measure_regions(maps, cues, inside, config))
    regions = [region for region in judged if region.score >= config.min_score]
    return sorted(regions, key=lambda region: (-region.score, region.bbox.y, region.bbox.x))


def _shape_limits(config: RegionConfig, diagonal_px: float) -> ShapeLimits:
    """The head marks no edges: what is narrow there is small or far away, unless it is next to nothing."""
    least_px = config.min_motion_extent_fraction * diagonal_px
    return ShapeLimits(least_px, least_px, config.max_aspect_ratio)


def _judge(measured: MeasuredRegion, residual: Float32Array, score: RegionScore, config: RegionConfig) -> Region:
    _, box, outline, thickness, shape, features, area_share = measured
    probability = probability_of(features, score)
    too_large = area_share > MAX_AREA_SHARE
    if too_large or not shape.passes:
        probability = min(probability, BAND_SCORE)
    moves = shape.passes and not too_large and probability >= config.motion_score
    values = residual[box.pixels][outline]
    evidence = _evidence(features, shape, box.width / box.height, config)
    if too_large:
        evidence["rule"] = TOO_LARGE
    return region_of(values, box, outline, moves=moves, score=probability, thickness_px=thickness, evidence=evidence)


def _things(maps: MotionMaps, mask: BoolArray, part: tuple[slice, slice], config: RegionConfig) -> LabelArray:
    """[h, w] things (1..) in a part of the image: those that somewhere probably move, divided by where their middles
    are and at valleys of the probability, and the faint ones.

    A faint thing is what reaches ``faint_motion_probability`` and has no more than a speck that is certain; small and
    slow things are no more than that. It is neither cut along seams nor divided.
    """
    certain = mask & (maps.motion[part] > config.min_motion_probability)
    origin = (part[0].start, part[1].start)
    things = things_of_pixels(_labels(certain, maps.seam_logit[part]), maps.offsets, origin)
    count, faint = cv2.connectedComponents(mask.view(np.uint8), connectivity=8)
    is_new = np.bincount(faint[certain], minlength=count) < config.min_area_fraction * maps.motion.size
    is_new[0] = False
    things = divided_at_valleys(things, maps.motion[part])
    return np.where(is_new[faint], faint + things.max(), things) if is_new.any() else things


def _labels(mask: BoolArray, seam_logit: Float32Array) -> LabelArray:
    """[H, W] components (1..) of the mask, cut along seams; what is left of a seam joins no component."""
    cut = mask & (seam_logit > SEAM_LOGIT)
    count, labels = cv2.connectedComponents((mask & ~cut).view(np.uint8), connectivity=8)
    left, top, width, height = cv2.boundingRect(cut.view(np.uint8))
    if not width or count > np.iinfo(np.uint16).max:
        return np.asarray(labels)
    # Only seams change, and one pixel around them is all that they change by.
    near = (slice(max(top - 1, 0), top + height + 1), slice(max(left - 1, 0), left + width + 1))
    seams, grown, block = cut[near], labels[near].astype(np.uint16), np.ones((3, 3), np.uint8)
    for _ in range(SEAM_REACH_PX):
        np.copyto(grown, np.asarray(cv2.dilate(grown, block), np.uint16), where=seams & (grown == 0))
    labels[near] = grown
    return np.asarray(labels)


def _features(
    component: Component, box: BoundingBox, maps: MotionMaps, cues: EvidenceCues, outline: BoolArray, shape: Shape
) -> Float64Array:
    """[13], in the order of ``REGION_FEATURES``."""
    y, x = component
    some = slice(None, None, max(1, y.size // FEATURE_SAMPLES))
    at, width = (y[some], x[some]), cues.geometric.shape[2]
    blocks = at[0] // EVIDENCE_BLOCK_PX * width + at[1] // EVIDENCE_BLOCK_PX
    bounded = cues.geometric.reshape(len(cues.geometric), -1).take(blocks, axis=1)[_CUES]
    means = np.abs(bounded, out=bounded).sum(axis=1) / np.float32(blocks.size)
    mask, motion = outline.view(np.uint8), maps.motion[box.pixels]
    mean, largest = cv2.mean(motion, mask)[0], cv2.minMaxLoc(motion, mask)[1]
    shares = (math.log(y.size / maps.motion.size), y.size / outline.size, min(shape.nearness_to_band, 2.0))
    seam = float(sigmoid(maps.seam_logit[at]).sum()) / blocks.size
    return np.array([_logit(mean), _logit(largest), *shares, seam, *means], dtype=np.float64)


def sigmoid(logits: Float32Array) -> Float32Array:
    """1 / (1 + exp(-logits)); OpenCV's exponential, because numpy's takes ten times as long."""
    grown = np.asarray(cv2.exp(-logits), dtype=np.float32).reshape(logits.shape)
    return np.asarray(1 / (grown + np.float32(1)), dtype=np.float32)


def _logit(probability: float) -> float:
    odds = probability / max(1 - probability, 1e-9)
    return min(max(math.log(odds), -MAX_LOGIT), MAX_LOGIT) if odds > 0 else -MAX_LOGIT


def probability_of(features: Float64Array, score: RegionScore) -> float:
    """That a region moves by itself, 0..1, rounded so that equal scores tie in the written answer as well."""
    logit = float(features[0])
    if score.weights:
        logit = score.bias + sum(weight * one for weight, one in zip(score.weights, features.tolist(), strict=True))
    return round(1 / (1 + math.exp(-min(max(logit, -MAX_LOGIT), MAX_LOGIT))), 4)


def _evidence(features: Float64Array, shape: Shape, ratio: float, config: RegionConfig) -> dict[str, float | str]:
    """What decided, in units that a person can judge; the cues' bound is undone."""
    across, along, parallax = (
        _unbounded(features[REGION_FEATURES.index(name)], half)
        for name, half in (
            ("remaining flow across", HALF_REMAINING_PX),
            ("remaining flow along", HALF_REMAINING_PX),
            ("parallax", HALF_PARALLAX_PX),
        )
    )
    probability, needed = 1 / (1 + math.exp(-features[0])), config.min_motion_probability
    if probability <= needed:  # a faint thing
        needed = min(needed, config.faint_motion_probability)
    return {
        "rule": shape.verdict,
        "probability": probability,
        "min_probability": needed,
        "fill_ratio": float(features[3]),
        "aspect_ratio": max(ratio, 1 / ratio),
        **dict(zip(LENGTHS, (across, along, parallax), strict=True)),
    }


def _unbounded(bounded: float, half: float) -> float:
    return float(half * bounded / max(1 - bounded, 1e-3))
