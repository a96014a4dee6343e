"""What one prediction says of itself, in numbers a person can look at: hypotheses, flow arrows, signs of the IMU."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.model_input import ModelInput
from viflow_anomaly.prediction import PredictedFlow, reconstruction_errors
from viflow_anomaly.sensor_data import FramePair

ARROWS_ACROSS = 24
ERROR_DECIMALS = 6


class HypothesesView(NamedTuple):
    """How well each hypothesis rebuilds the source, as the choice among them saw it; smaller is better.

    Attributes:
        errors: [K] of the network's hypotheses; None for one that is not finite.
        winner: index of the chosen one.
        corrected_error: of the flow after the correction, None likewise and with correction off.
    """

    errors: tuple[float | None, ...]
    winner: int
    corrected_error: float | None


class PairSigns(NamedTuple):
    """What a pair shows of its IMU and of how the images agree with it; None: not known.

    Attributes:
        imu_rate_hz: of the samples, by their median distance.
        imu_largest_gap_ms: between two of them.
        inlier_share: of the correction.
        turn_error_rad_s: how far the corrected rotation is from the gyro's.
    """

    imu_rate_hz: float | None
    imu_largest_gap_ms: float | None
    inlier_share: float | None
    turn_error_rad_s: float | None


class FlowArrow(NamedTuple):
    """The static world's flow at one source pixel."""

    x: int
    y: int
    du: float
    dv: float


def view_hypotheses(predicted: PredictedFlow, model_input: ModelInput) -> HypothesesView:
    """The competition of the hypotheses on one pair once more."""
    images = (model_input.source, model_input.target)
    errors = reconstruction_errors(predicted.hypotheses_px, predicted.stride, *images)
    corrected = None
    if predicted.correction is not None:
        corrected = _finite(
            reconstruction_errors(predicted.flow_px[None], predicted.stride, *images)[0], ERROR_DECIMALS
        )
    return HypothesesView(tuple(_finite(one, ERROR_DECIMALS) for one in errors), predicted.hypothesis, corrected)


def flow_arrows(flow_px: Float32Array, inside: NDArray[np.bool_]) -> list[FlowArrow]:
    """A coarse grid of the flow [H, W, 2], where it is finite and ``inside`` [H, W]; row by row."""
    height, width = inside.shape
    step = max(1, round(width / ARROWS_ACROSS))
    rows, columns = range(step // 2, height, step), range(step // 2, width, step)
    return [
        FlowArrow(x, y, round(float(flow_px[y, x, 0]), 2), round(float(flow_px[y, x, 1]), 2))
        for y in rows
        for x in columns
        if inside[y, x] and np.isfinite(flow_px[y, x]).all()
    ]


def pair_signs(pair: FramePair, predicted: PredictedFlow | None) -> PairSigns:
    """What is cheap to say of every pair."""
    steps_ns = np.diff(pair.imu.timestamps_ns)
    rate = gap = None
    if steps_ns.size:
        rate = round(1e9 / float(np.median(steps_ns)), 2)
        gap = round(float(steps_ns.max()) * 1e-6, 3)
    correction = None if predicted is None else predicted.correction
    if correction is None:
        return PairSigns(rate, gap, None, None)
    turn = correction.turned_rad / (pair.interval_ns * 1e-9)
    return PairSigns(rate, gap, _finite(correction.inlier_share, 4), _finite(turn, 5))


def _finite(value: float, decimals: int) -> float | None:
    """A damaged network's numbers may be none."""
    return round(float(value), decimals) if np.isfinite(value) else None
