"""How good an evidence map is pixel by pixel, whatever its unit: average precision and intersection over union."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.evaluation.labelled_pairs import BoolArray, Pixels
from viflow_anomaly.geometry import Float32Array

DROPPED_BITS = 17
BINS = 1 << (31 - DROPPED_BITS)
"""Floats from 0 up sort as their bits do; the upper ones are a histogram whose bins are 1.6 % wide or less."""


@dataclass
class PixelScores:
    """Counts pixels of movers and of the rest by evidence. Ignored movers and what left the image do not count."""

    frames: int = 0
    _moving: NDArray[np.int64] = field(default_factory=lambda: np.zeros(BINS, np.int64))
    _static: NDArray[np.int64] = field(default_factory=lambda: np.zeros(BINS, np.int64))

    def add(self, evidence: Float32Array, inside: BoolArray, pixels: Pixels) -> None:
        """Count one frame.

        Args:
            evidence: [H, W] float32, finite and at least 0.
            inside: [H, W] where it holds.
            pixels: the truth.
        """
        bins = np.ascontiguousarray(evidence + np.float32(0)).view(np.uint32) >> DROPPED_BITS  # + 0: no minus zero
        judged = inside & ~pixels.ignored
        self.frames += 1
        self._moving += np.bincount(bins[judged & pixels.moving], minlength=BINS)
        self._static += np.bincount(bins[judged & ~pixels.moving], minlength=BINS)

    def merge(self, other: PixelScores) -> None:
        """Count all of ``other``, too."""
        self.frames += other.frames
        self._moving += other._moving
        self._static += other._static

    def average_precision(self) -> float | None:
        """Over all thresholds; None without a moving pixel."""
        moving, static = self._above()
        if not moving[-1]:
            return None
        return average_precision(moving / moving[-1], moving / np.maximum(moving + static, 1))

    def best_iou(self) -> float | None:
        """The largest intersection over union that any threshold gives; None without a moving pixel."""
        moving, static = self._above()
        return float((moving / (moving[-1] + static)).max()) if moving[-1] else None

    def _above(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Moving and static pixels as the threshold falls past each bin."""
        return np.cumsum(self._moving[::-1]), np.cumsum(self._static[::-1])


@dataclass
class MaskScores:
    """Intersection over union of found and moving pixels, added up over frames."""

    shared: int = 0
    either: int = 0

    def add(self, found: BoolArray, inside: BoolArray, pixels: Pixels) -> None:
        """Count one frame, [H, W] each."""
        judged = inside & ~pixels.ignored
        self.shared += int(np.count_nonzero(judged & found & pixels.moving))
        self.either += int(np.count_nonzero(judged & (found | pixels.moving)))

    def merge(self, other: MaskScores) -> None:
        """Count all of ``other``, too."""
        self.shared += other.shared
        self.either += other.either

    def iou(self) -> float | None:
        """None where nothing moved and nothing was found."""
        return self.shared / self.either if self.either else None


def average_precision(recall: NDArray[np.float64], precision: NDArray[np.float64]) -> float:
    """Area under the curve, precision made monotone (as in PASCAL VOC since 2010)."""
    steps = np.diff(np.concatenate([[0.0], recall]))
    monotone = np.maximum.accumulate(precision[::-1])[::-1]
    return float((steps * monotone).sum())
