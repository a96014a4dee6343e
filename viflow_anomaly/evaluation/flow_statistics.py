"""Statistics of endpoint errors over pixels, in memory that does not grow with their number.

Mean and deviation are kept as running sums (Chan's merge); the median comes from a histogram whose bins are 0.005 px
wide up to 10.24 px and 0.25 % wide beyond, so that it is known to half of that.
"""

from __future__ import annotations

import math
from array import array
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.geometry import Float32Array

BoolArray = NDArray[np.bool_]

FINE_BIN_PX = 0.005
FINE_BINS = 2048
GROWTH = 1.0025
COARSE_BINS = 2800
"""Up to 11 000 px; what lies beyond falls into the last bin."""
FINE_END_PX = FINE_BIN_PX * FINE_BINS

OUTLIER_PX, OUTLIER_SHARE = 3.0, 0.05
"""KITTI's: an error beyond 3 px and beyond 5 % of the true flow's length makes an outlier."""
QUOTIENT_SCALE = 0.01
"""Of the paper's quotient: mean EPE (px) x runtime (ms) x 0.01 [Table I]."""


@dataclass
class FlowStatistics:
    """Errors of one method over some pairs.

    Attributes:
        pairs: with an estimate.
        missing: pairs without one, by reason.
        valid_px: pixels with ground truth in ``pairs``.
        estimated_px: those of them with an estimate; all measures are over these.
        identity_sum_px: sum of the true flow's length over them: what "no motion" would have been wrong by.
        outliers: KITTI's, among them.
        runtimes_ms: one for each timed run, 8 bytes each.
    """

    pairs: int = 0
    missing: Counter[str] = field(default_factory=Counter)
    valid_px: int = 0
    estimated_px: int = 0
    outliers: int = 0
    identity_sum_px: float = 0.0
    runtimes_ms: array[float] = field(default_factory=lambda: array("d"))
    _mean_px: float = 0.0
    _square_sum: float = 0.0
    _histogram: NDArray[np.int64] = field(default_factory=lambda: np.zeros(FINE_BINS + COARSE_BINS, np.int64))

    def add_pair(self, flow_px: Float32Array, true_px: Float32Array, valid: BoolArray) -> None:
        """Count one pair.

        Args:
            flow_px: [H, W, 2], not finite where there is no estimate.
            true_px: [H, W, 2].
            valid: [H, W], where ``true_px`` holds.
        """
        used = valid & np.isfinite(flow_px).all(axis=-1)
        true = true_px[used].astype(np.float64)
        errors = np.linalg.norm(flow_px[used].astype(np.float64) - true, axis=-1)  # n
        lengths = np.linalg.norm(true, axis=-1)
        self.pairs += 1
        self.valid_px += int(np.count_nonzero(valid))
        self.outliers += int(np.count_nonzero((errors > OUTLIER_PX) & (errors > OUTLIER_SHARE * lengths)))
        self.identity_sum_px += float(lengths.sum())
        if errors.size:
            mean = float(errors.mean())
            self._add_moments(errors.size, mean, float(((errors - mean) ** 2).sum()))
            self._histogram += np.bincount(_bins(errors), minlength=self._histogram.size)

    def merge(self, other: FlowStatistics) -> None:
        """Count all of ``other``, too."""
        self.pairs += other.pairs
        self.missing.update(other.missing)
        self.valid_px += other.valid_px
        self.outliers += other.outliers
        self.identity_sum_px += other.identity_sum_px
        self.runtimes_ms.extend(other.runtimes_ms)
        self._histogram += other._histogram
        if other.estimated_px:
            self._add_moments(other.estimated_px, other._mean_px, other._square_sum)

    def _add_moments(self, count: int, mean: float, square_sum: float) -> None:
        """Chan, Golub, LeVeque 1979: no difference of large sums."""
        total = self.estimated_px + count
        step = mean - self._mean_px
        self._square_sum += square_sum + step * step * self.estimated_px * count / total
        self._mean_px += step * count / total
        self.estimated_px = total

    def median_px(self) -> float:
        """The median, to half a bin; NaN without any pixel."""
        if not self.estimated_px:
            return math.nan
        filled = np.cumsum(self._histogram)
        half = self.estimated_px / 2
        index = int(np.searchsorted(filled, half))
        before = int(filled[index - 1]) if index else 0
        start, end = _bin_start(index), _bin_start(index + 1)
        return start + (end - start) * (half - before) / int(self._histogram[index])

    def summary(self) -> dict[str, Any]:
        """All figures; None where there is nothing to say (no pixel, no run that was timed, no motion)."""
        known = self.estimated_px > 0
        mean = self._mean_px if known else math.nan
        identity = self.identity_sum_px / self.estimated_px if known else math.nan
        runtime_ms = float(np.median(self.runtimes_ms)) if self.runtimes_ms else math.nan
        return {
            "pairs": self.pairs,
            "missing_pairs": dict(sorted(self.missing.items())),
            "pixels": self.estimated_px,
            "density": _rounded(self.estimated_px / self.valid_px if self.valid_px else math.nan, 6),
            "epe_mean_px": _rounded(mean),
            "epe_sd_px": _rounded(math.sqrt(self._square_sum / self.estimated_px) if known else math.nan),
            "epe_median_px": _rounded(self.median_px()),
            "f1_all": _rounded(self.outliers / self.estimated_px if known else math.nan, 6),
            "identity_epe_px": _rounded(identity),
            "epe_ratio": _rounded(mean / identity if identity else math.nan),
            "runtime_ms": _rounded(runtime_ms),
            "quotient": _rounded(mean * runtime_ms * QUOTIENT_SCALE),
        }


def _bins(errors_px: NDArray[np.float64]) -> NDArray[np.intp]:
    fine = np.minimum(errors_px, FINE_END_PX) / FINE_BIN_PX
    coarse = FINE_BINS + np.log(np.maximum(errors_px, FINE_END_PX) / FINE_END_PX) / math.log(GROWTH)
    bins = np.where(errors_px < FINE_END_PX, fine, np.minimum(coarse, FINE_BINS + COARSE_BINS - 1))
    return bins.astype(np.intp)


def _bin_start(index: int) -> float:
    return index * FINE_BIN_PX if index <= FINE_BINS else FINE_END_PX * GROWTH ** (index - FINE_BINS)


def _rounded(value: float, digits: int = 4) -> float | None:
    return None if math.isnan(value) else round(value, digits)
