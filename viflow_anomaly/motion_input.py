"""ImuSamples around a frame pair -> the fixed window that a network eats, with what lowers trust in it.

Nothing is filled silently: what cannot be used raises, what can be used with less trust (or must not be judged) is
reported as an ``ImuFault``. Only the samples that the window itself touches decide about both, so the answer does not
depend on how much of the recording the caller hands over. Plausibility of the units lives in ``imu_units.py``.

Layouts [paper, Datasets and Data Generation]; columns are gyro x y z (rad/s), accelerometer x y z (m/s^2):

- ``paper_euroc``: 50 raw rows, 10 from the 50 ms before the source image and 10 for every 50 ms of the frame interval;
  the rows of a shorter look-ahead are zero.
- ``paper_kitti``: 20 raw rows, 10 from the 100 ms before the source image, 10 from the 100 ms after it.
- ``resampled``: means over equal bins, any IMU rate; the mean of the piecewise linear signal is exact, so that the sum
  of value times bin width is the trapezoidal integral of the samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from viflow_anomaly.config import MotionWindowConfig
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.imu_units import ImuFault, check_accelerometer, check_gyroscope, check_spikes
from viflow_anomaly.sensor_data import Float64Array, FramePair, ImuSamples, PinholeCamera

MAX_COVERAGE_TOLERANCE_S = 0.020
"""KITTI's frames and OXTS rows agree within 1 ms; 20 ms is the exposure and trigger delay of a slow camera."""
UPRIGHT_AT_REST_M_S2 = (0.0, -9.81, 0.0)
"""What an accelerometer in a level camera's axes (y down) reads at rest: against gravity."""
GYRO_ALONE = ImuFault(
    "no_accelerometer",
    "There is no accelerometer: the camera is taken for upright and not accelerated, so the network's guesses of its "
    "velocity are poorer; the correction on the target image makes up for most of that.",
    "lowers_trust",
)
GAP_MIN_S = 0.015
GAP_MEDIANS = 2.5
GAP_INTERVALS = 2.0
MIN_SAMPLES_IN_INTERVAL = 4
MAX_INTERVAL_S = 1.0
STAMP_JITTER_S = 0.001
PAPER_RATE_TOLERANCE = 0.1
PAPER_SPACINGS = (0.55, 1.55)
"""How far an IMU's rate, and the spacing of two samples in its periods, may be from the layout's: KITTI's is 93 to
102 Hz where the paper says 100, and stamps jitter by a millisecond."""


class PaperBlocks(NamedTuple):
    """One of the paper's layouts: raw rows taken in blocks of equal duration, the first of them before the source."""

    block_s: float
    rows_per_block: int
    max_look_ahead: int


PAPER_LAYOUTS: dict[str, PaperBlocks] = {
    "paper_euroc": PaperBlocks(block_s=0.05, rows_per_block=10, max_look_ahead=4),
    "paper_kitti": PaperBlocks(block_s=0.1, rows_per_block=10, max_look_ahead=1),
}


@dataclass(frozen=True, eq=False)
class MotionWindow:
    """The IMU part of one network input.

    Attributes:
        values: [T, 6] float32, read-only: gyro x y z in rad/s, accelerometer x y z in m/s^2; in camera axes when the
            configuration asks for them and the mounting is known, else in IMU axes.
        interval_s: time from the source frame to the target frame.
        faults: what lowers trust in the window or forbids to judge the pair; empty when all is well.
        turn_rate_rad_s: how fast the gyro turned between the frames, mean over the interval; back and forth cancel.
    """

    values: Float32Array
    interval_s: float
    faults: tuple[ImuFault, ...] = ()
    turn_rate_rad_s: float = 0.0


class _Signal(NamedTuple):
    """The samples a window touches: [N] seconds after the source frame (IMU clock), [N, 6] gyro and accelerometer.

    ``spacing_s`` is the median between two of them, 0 for a single one.
    """

    times_s: Float64Array
    values: Float64Array
    spacing_s: float


def build_motion_window(pair: FramePair, config: MotionWindowConfig, *, gyro_alone: bool = False) -> MotionWindow:
    """The window of ``pair`` in the layout of ``config``: [config.rows, 6] and its faults.

    The camera's ``time_offset_s`` moves the frame stamps to the IMU's clock first (t_imu = t_cam + offset).

    Args:
        gyro_alone: a sensor without accelerometer is taken, and the camera for upright and not accelerated (only with
            ``config.axes`` "camera"); a fault says so.

    Raises:
        InvalidInputError: ``imu_accel_missing``, ``imu_not_covering``, ``imu_window_count``, ``imu_window_interval``
            (paper layouts only), and those of ``imu_units.py``.
    """
    interval_s = pair.interval_ns * 1e-9
    blocks = PAPER_LAYOUTS.get(config.layout)
    before_s, after_s = _reach(interval_s, config)
    gyro_alone = gyro_alone and config.axes == "camera" and pair.imu.accel_m_s2 is None
    signal = _touched_samples(pair, -before_s, after_s, gyro_alone=gyro_alone)
    _require_coverage(signal, interval_s)
    faults = [
        *check_gyroscope(signal.values[:, :3]),
        *([GYRO_ALONE] if gyro_alone else check_accelerometer(signal.values[:, 3:])),
        *check_spikes(signal.values[:, :3], signal.values[:, 3:]),
        *_check_interval(interval_s),
        *_check_rate(signal.times_s, interval_s),
        *_check_gaps(signal, before_s, interval_s),
    ]
    if blocks is None:
        faults += _check_before_window(signal, before_s)
        rows = _resampled_rows(signal, interval_s, config)
    else:
        rows = _paper_rows(signal, interval_s, blocks)
    rows, mounting_faults = _in_requested_axes(rows, pair.camera, config)
    values = rows.astype(np.float32)
    if gyro_alone:
        values[:, 3:] = UPRIGHT_AT_REST_M_S2
    values.setflags(write=False)
    return MotionWindow(values, interval_s, (*faults, *mounting_faults), _turn_rate_rad_s(signal, interval_s))


def _reach(interval_s: float, config: MotionWindowConfig) -> tuple[float, float]:
    """How far the window reaches before and after the source frame, in seconds."""
    blocks = PAPER_LAYOUTS.get(config.layout)
    if blocks is None:
        return config.before_s, interval_s
    last_block_s = _look_ahead(interval_s, blocks) * blocks.block_s
    slowest = 1 + PAPER_RATE_TOLERANCE
    after_s = slowest * (last_block_s + blocks.block_s / blocks.rows_per_block)
    return slowest * blocks.block_s, max(interval_s, after_s)


def _touched_samples(pair: FramePair, start_s: float, end_s: float, *, gyro_alone: bool) -> _Signal:
    """The samples from the last at or before ``start_s`` to the first at or after ``end_s``."""
    imu: ImuSamples = pair.imu
    accel_m_s2 = np.zeros_like(imu.gyro_rad_s) if gyro_alone else imu.accel_m_s2
    if accel_m_s2 is None:
        raise InvalidInputError(
            "accel_m_s2: expected one accelerometer reading per timestamp (the model needs it), found none",
            code="imu_accel_missing",
            field="imu.accel_m_s2",
        )
    offset_s = pair.camera.time_offset_s if pair.camera is not None else 0.0
    source_ns = pair.source.timestamp_ns + round(offset_s * 1e9)
    # Integer subtraction first: float64 seconds since 1970 resolve only 240 ns.
    times_s = np.asarray((imu.timestamps_ns - source_ns) * 1e-9, dtype=np.float64)
    first = max(int(np.searchsorted(times_s, start_s - STAMP_JITTER_S, side="right")) - 1, 0)
    last = int(np.searchsorted(times_s, end_s + STAMP_JITTER_S, side="left")) + 1
    kept = slice(first, last)
    times_s = times_s[kept]
    spacing_s = float(np.median(times_s[1:] - times_s[:-1])) if times_s.size > 1 else 0.0
    return _Signal(times_s, np.concatenate([imu.gyro_rad_s[kept], accel_m_s2[kept]], axis=1), spacing_s)


def _coverage_tolerance_s(signal: _Signal) -> float:
    """How far the first and last sample may lie inside a span that still counts as covered.

    One and a half sample periods, because the sample just outside the span may be missing and stamps jitter, but never
    more than ``MAX_COVERAGE_TOLERANCE_S``; a single sample covers nothing.
    """
    return min(1.5 * signal.spacing_s, MAX_COVERAGE_TOLERANCE_S)


def _require_coverage(signal: _Signal, interval_s: float) -> None:
    times_s, tolerance_s = signal.times_s, _coverage_tolerance_s(signal)
    starts_late = times_s[0] > tolerance_s
    ends_early = times_s[-1] < interval_s - tolerance_s
    if starts_late or ends_early:
        raise InvalidInputError(
            f"imu: expected samples from the source frame to the target frame, {1e3 * interval_s:.1f} ms later, found "
            f"samples from {1e3 * times_s[0]:.1f} ms to {1e3 * times_s[-1]:.1f} ms after the source frame "
            f"(camera time offset included; {1e3 * tolerance_s:.1f} ms may be missing at each end)",
            code="imu_not_covering",
            field="imu.timestamps_ns",
        )


def _check_interval(interval_s: float) -> list[ImuFault]:
    if interval_s <= MAX_INTERVAL_S:
        return []
    message = f"The frames are {interval_s:.2f} s apart; pairs more than {MAX_INTERVAL_S:.0f} s apart are not judged."
    return [ImuFault("interval_too_long", message, "abstain")]


def _check_rate(times_s: Float64Array, interval_s: float) -> list[ImuFault]:
    inside = (times_s >= -STAMP_JITTER_S) & (times_s <= interval_s + STAMP_JITTER_S)
    count = int(np.count_nonzero(inside))
    if count >= MIN_SAMPLES_IN_INTERVAL:
        return []
    message = (
        f"Only {count} IMU samples lie between the two frames; at least {MIN_SAMPLES_IN_INTERVAL} are needed to follow "
        "a rotation that changes."
    )
    return [ImuFault("imu_rate_low", message, "lowers_trust")]


def _check_gaps(signal: _Signal, before_s: float, interval_s: float) -> list[ImuFault]:
    """A gap is a spacing above 15 ms and above 2.5 medians, or above two frame intervals whatever the median says.

    Where a gap hides more than half of the frame interval the motion between the frames is unknown: abstain.
    """
    times_s = signal.times_s
    spacings_s = times_s[1:] - times_s[:-1]
    normal_s = min(GAP_MEDIANS * signal.spacing_s, GAP_INTERVALS * interval_s)
    touches_window = (times_s[1:] > -before_s) & (times_s[:-1] < interval_s)
    gaps = (spacings_s > max(normal_s, GAP_MIN_S)) & touches_window
    if not gaps.any():
        return []
    hidden_s = np.minimum(times_s[1:], interval_s) - np.maximum(times_s[:-1], 0.0)
    hides_most = bool((hidden_s[gaps] > 0.5 * interval_s).any())
    message = (
        f"The IMU samples have a gap of {1e3 * float(spacings_s[gaps].max()):.0f} ms; the usual spacing is "
        f"{1e3 * signal.spacing_s:.1f} ms and the frames are {1e3 * interval_s:.0f} ms apart."
    )
    return [ImuFault("imu_gap", message, "abstain" if hides_most else "lowers_trust")]


def _check_before_window(signal: _Signal, before_s: float) -> list[ImuFault]:
    missing_s = signal.times_s[0] + before_s
    if missing_s <= _coverage_tolerance_s(signal):
        return []
    message = (
        f"The window begins {1e3 * before_s:.0f} ms before the source frame, but its first {1e3 * missing_s:.0f} ms "
        "have no IMU samples; the first sample was held there."
    )
    return [ImuFault("imu_window_incomplete", message, "lowers_trust")]


def _resampled_rows(signal: _Signal, interval_s: float, config: MotionWindowConfig) -> Float64Array:
    """[T, 6] bin means: ``samples_before`` bins over [-before_s, 0], then ``samples_between`` over the interval."""
    edges_s = np.concatenate(
        [
            np.linspace(-config.before_s, 0.0, config.samples_before + 1),
            np.linspace(0.0, interval_s, config.samples_between + 1)[1:],
        ]
    )
    integral = _integral_at(edges_s, signal)
    return np.asarray(np.diff(integral, axis=0) / np.diff(edges_s)[:, None])


def _integral_at(edges_s: Float64Array, signal: _Signal) -> Float64Array:
    """[E, 6] integral from the first sample to each edge of the samples joined by straight lines (ends held)."""
    times_s, values = signal.times_s, signal.values
    steps_s = np.diff(times_s)[:, None]
    at_samples = np.zeros_like(values)
    np.cumsum(0.5 * (values[1:] + values[:-1]) * steps_s, axis=0, out=at_samples[1:])
    slopes = np.zeros_like(values)
    slopes[:-1] = np.diff(values, axis=0) / steps_s
    sample = np.clip(np.searchsorted(times_s, edges_s, side="right") - 1, 0, None)
    elapsed_s = (edges_s - times_s[sample])[:, None]
    slope = np.where(elapsed_s < 0, 0.0, slopes[sample])
    return np.asarray(at_samples[sample] + elapsed_s * (values[sample] + 0.5 * elapsed_s * slope))


def _turn_rate_rad_s(signal: _Signal, interval_s: float) -> float:
    start, end = _integral_at(np.array([0.0, interval_s]), signal)[:, :3]
    return float(np.linalg.norm(end - start)) / interval_s


def _paper_rows(signal: _Signal, interval_s: float, blocks: PaperBlocks) -> Float64Array:
    """[T, 6] raw rows, zero beyond the look-ahead; the sample at the source frame opens the first block after it.

    That anchor is the first sample not more than 1 ms earlier than the frame. Blocks are counted in samples from it, so
    stamps may jitter (EuRoC's differ by 256 ns) and the rate may be a tenth off; a missing sample, or one too many,
    shows in the spacing.
    """
    look_ahead = _look_ahead(interval_s, blocks)
    times_s = signal.times_s
    anchor = int(np.searchsorted(times_s, -STAMP_JITTER_S))
    first, end = anchor - blocks.rows_per_block, anchor + look_ahead * blocks.rows_per_block
    spacings = np.diff(times_s[max(first, 0) : end]) * blocks.rows_per_block / blocks.block_s
    whole = first >= 0 and end <= times_s.size
    even = whole and PAPER_SPACINGS[0] < spacings.min() and spacings.max() < PAPER_SPACINGS[1]
    if not even or abs(float(spacings.mean()) - 1) > PAPER_RATE_TOLERANCE:
        raise _not_the_layout(times_s, anchor, look_ahead, blocks)
    rows = np.zeros((blocks.rows_per_block * (1 + blocks.max_look_ahead), 6))
    rows[: end - first] = signal.values[first:end]
    return rows


def _not_the_layout(times_s: Float64Array, anchor: int, look_ahead: int, blocks: PaperBlocks) -> InvalidInputError:
    """Names the first block that holds another number of samples, counted in time from the anchor."""
    anchor_s = float(times_s[min(anchor, times_s.size - 1)])
    half_period_s = 0.5 * blocks.block_s / blocks.rows_per_block
    counts = np.diff(
        np.searchsorted(times_s, anchor_s - half_period_s + blocks.block_s * np.arange(-1, look_ahead + 1))
    )
    wrong = np.flatnonzero(counts != blocks.rows_per_block)
    block = int(wrong[0]) if wrong.size else 0
    found = str(counts[block]) if wrong.size else "them unevenly spaced"
    return InvalidInputError(
        f"imu: expected {blocks.rows_per_block} samples in the {1e3 * blocks.block_s:.0f} ms that begin "
        f"{1e3 * (block - 1) * blocks.block_s:+.0f} ms from the source frame (the paper's layout of raw samples), "
        f"found {found}",
        code="imu_window_count",
        field="imu.timestamps_ns",
    )


def _look_ahead(interval_s: float, blocks: PaperBlocks) -> int:
    """Frame interval in blocks; a quarter of a block is what trigger jitter may add or take."""
    look_ahead = round(interval_s / blocks.block_s)
    off_s = abs(interval_s - look_ahead * blocks.block_s)
    if not 1 <= look_ahead <= blocks.max_look_ahead or off_s > 0.25 * blocks.block_s:
        wanted = ", ".join(f"{1e3 * n * blocks.block_s:.0f}" for n in range(1, blocks.max_look_ahead + 1))
        raise InvalidInputError(
            f"target timestamp_ns: expected frames {wanted} ms apart (the paper's layout of raw samples), "
            f"found {1e3 * interval_s:.1f} ms",
            code="imu_window_interval",
            field="target.timestamp_ns",
        )
    return look_ahead


def _in_requested_axes(
    rows: Float64Array, camera: PinholeCamera | None, config: MotionWindowConfig
) -> tuple[Float64Array, list[ImuFault]]:
    if config.axes == "sensor":
        return rows, []
    R_cam_imu = camera.R_cam_imu if camera is not None else None
    if R_cam_imu is None:
        message = "How the IMU is mounted on the camera is unknown (no T_cam_imu); its axes are taken as they are."
        return rows, [ImuFault("mounting_unknown", message, "lowers_trust")]
    rotated = rows.reshape(-1, 2, 3) @ R_cam_imu.T
    return np.asarray(rotated).reshape(-1, 6), []
