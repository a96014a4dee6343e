"""Which pairs of a recording have an IMU that a motion window can be made of, and why the others have none."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from viflow_anomaly.config import MotionWindowConfig
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.motion_input import build_motion_window
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples, PinholeCamera

BLANK_SIDE_PX = 32


class Interval(NamedTuple):
    """Stamps of a pair's frames, nanoseconds of camera time."""

    source_ns: int
    target_ns: int


@dataclass(frozen=True)
class UsablePairs:
    """Indices into the pairs, and how many were left out for each reason (the code of a fault)."""

    indices: list[int]
    excluded: dict[str, int]


def usable_pairs(pairs: RecordingPairs, config: MotionWindowConfig) -> UsablePairs:
    """The pairs whose IMU slice and window hold; no image is read.

    Besides the codes of ``window_fault``: ``imu_unsorted``, ``imu_duplicate_timestamps`` (stamps out of order or twice
    in the pair's slice) and ``imu_not_covering``.
    """
    indices: list[int] = []
    excluded: Counter[str] = Counter()
    for index in range(len(pairs)):
        try:
            fault = window_fault(Interval(*pairs.stamps(index)), pairs.imu(index), config, pairs.recording.camera)
        except InvalidInputError as err:
            fault = err.code
        if fault is None:
            indices.append(index)
        else:
            excluded[fault] += 1
    return UsablePairs(indices, dict(excluded))


def window_fault(
    interval: Interval, imu: ImuSamples, config: MotionWindowConfig, camera: PinholeCamera | None = None
) -> str | None:
    """Why no window should be made of these samples, or None: the code of what ``build_motion_window`` raises
    (``imu_window_count``: a block of raw rows has too few or too many), of a fault that forbids to judge the pair, or
    ``imu_gap``."""
    side = BLANK_SIDE_PX
    blank = np.zeros((side, side) if camera is None else (camera.height, camera.width), np.uint8)
    try:
        pair = FramePair(Frame(interval.source_ns, blank), Frame(interval.target_ns, blank), imu, camera)
        faults = build_motion_window(pair, config).faults
    except InvalidInputError as err:
        return err.code
    return next((fault.code for fault in faults if fault.severity == "abstain" or fault.code == "imu_gap"), None)
