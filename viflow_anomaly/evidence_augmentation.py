"""Recordings as a worse camera on a worse calibrated rig would have made them, so that a head does not learn to trust.

The simulator's calibration is exact, its contrast fair, its lens ideal. Real ones are not, and what that leaves between
a source and its reconstruction must not look like motion. One draw for each recording, from the seed and its name.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np

from viflow_anomaly.evaluation.perturbed_pairs import (
    Perturbation,
    add_image_noise,
    brighten_target,
    scale_focal_length,
    shift_imu,
    turn_mounting,
    unperturbed,
)
from viflow_anomaly.geometry import pixel_grid, sample_bilinear
from viflow_anomaly.sensor_data import FramePair, Uint8Array

TIME_OFFSET_SIGMA_S = 0.004
MOUNTING_SIGMA_RAD = math.radians(0.5)
FOCAL_SIGMA = 0.01
LENS_SIGMA = 0.0025
"""Of the error of the lens at the image's corners, in image diagonals."""
MIN_CONTRAST, MAX_CONTRAST = 0.35, 2.4
MAX_PIVOT_GRAY = 60.0
MAX_BLUR_PX, MAX_NOISE_GRAY = 1.2, 3.0
MAX_LOG_GAIN = 0.15


class Augment(NamedTuple):
    """Which recordings are perturbed: ``share`` of them, each in its own way. And ``own_size_share`` of them are judged
    with all their pixels, whatever the internal size. Pure functions of the seed and the recording's name."""

    seed: int
    share: float
    own_size_share: float = 0.0

    def of(self, name: str) -> Perturbation:
        """What a recording is seen through."""
        rng = self._rng(name)
        if rng.random() >= self.share:
            return unperturbed
        return partial(_one_after_the_other, steps=tuple(_draw(rng)))

    def at_own_size(self, name: str) -> bool:
        """Whether a recording is judged with all its pixels."""
        return bool(self._rng(f"size of {name}").random() < self.own_size_share)

    def _rng(self, name: str) -> np.random.Generator:
        digest = hashlib.sha256(f"{self.seed}/{name}".encode()).digest()
        return np.random.default_rng(list(digest[:16]))


NO_AUGMENT = Augment(0, 0.0)


def _draw(rng: np.random.Generator) -> list[Perturbation]:
    """Each kind with its own coin; images first, then what is said of them."""
    contrast = math.exp(rng.uniform(math.log(MIN_CONTRAST), math.log(MAX_CONTRAST)))
    pivot = rng.uniform(-MAX_PIVOT_GRAY, MAX_PIVOT_GRAY)
    kinds: list[tuple[float, Perturbation]] = [
        (0.4, partial(bend_lens, by=float(rng.normal(0, LENS_SIGMA)))),
        (0.3, partial(_on_images, change=partial(_blurred, sigma_px=rng.uniform(0.3, MAX_BLUR_PX)))),
        (0.6, partial(change_contrast, factor=contrast, pivot_gray=pivot)),
        (0.4, partial(add_image_noise, sigma_gray=rng.uniform(0, MAX_NOISE_GRAY))),
        (0.2, partial(brighten_target, gain=math.exp(rng.uniform(-MAX_LOG_GAIN, MAX_LOG_GAIN)))),
        (0.5, partial(shift_imu, by_s=rng.normal(0, TIME_OFFSET_SIGMA_S))),
        (0.4, partial(scale_focal_length, factor=rng.normal(1, FOCAL_SIGMA))),
    ]
    turns = rng.random() < 0.5
    kinds += [
        (float(turns), partial(turn_mounting, axis=axis, by_rad=rng.normal(0, MOUNTING_SIGMA_RAD))) for axis in range(3)
    ]
    return [kind for probability, kind in kinds if rng.random() < probability]


def _one_after_the_other(pair: FramePair, *, steps: tuple[Perturbation, ...]) -> FramePair:
    for step in steps:
        pair = step(pair)
    return pair


def change_contrast(pair: FramePair, *, factor: float, pivot_gray: float) -> FramePair:
    """Gray levels spread (> 1) or squeezed about the source's mean plus ``pivot_gray``; what leaves the range is cut
    off, as in a burnt-out sky or a black shadow."""
    pivot = float(pair.source.image.mean()) + pivot_gray
    levels = np.clip(np.rint((np.arange(256) - pivot) * factor + pivot), 0, 255).astype(np.uint8)
    return _on_images(pair, change=lambda image: levels[image])


def bend_lens(pair: FramePair, *, by: float) -> FramePair:
    """Both images as through a lens whose distortion is off by so many image diagonals at the corners.

    Labels stay where they were: there, they are off by as much.
    """
    height, width = pair.source.image.shape
    middle = np.array([(width - 1) / 2, (height - 1) / 2], dtype=np.float32)
    offsets = pixel_grid(height, width) - middle
    radius2 = (offsets**2).sum(axis=-1, keepdims=True) / float((middle**2).sum())
    at = np.asarray(middle + offsets * (1 + 2 * np.float32(by) * radius2), dtype=np.float32)
    return _on_images(pair, change=lambda image: np.asarray(sample_bilinear(image, at), dtype=np.uint8))


def _blurred(image: Uint8Array, *, sigma_px: float) -> Uint8Array:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), dtype=np.uint8)


def _on_images(pair: FramePair, *, change: Callable[[Uint8Array], Uint8Array]) -> FramePair:
    source, target = (replace(frame, image=change(frame.image)) for frame in (pair.source, pair.target))
    return replace(pair, source=source, target=target)
