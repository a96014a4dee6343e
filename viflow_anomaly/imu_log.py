"""The raw IMU table of a recording; slices of it become ImuSamples."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.sensor_data import Float64Array, ImuSamples, Int64Array


@dataclass(frozen=True, eq=False)
class ImuLog:
    """A recording's IMU samples in the order of its file, which need not be the order of time.

    Readers check while parsing that every number is finite, where they can name the line. Disorder and duplicate
    stamps are kept: they surface in the slices that contain them, not in the rest of the recording.

    Args:
        timestamps_ns: [N] int64 in the IMU's clock, N >= 1.
        gyro_rad_s: [N, 3] angular rate in the IMU frame.
        accel_m_s2: [N, 3] specific force in the IMU frame, or None for gyro-only sensors.

    Raises:
        InvalidInputError: ``imu_empty``, ``imu_wrong_shape``.
    """

    timestamps_ns: Int64Array
    gyro_rad_s: Float64Array
    accel_m_s2: Float64Array | None = None
    _sorted: bool = field(init=False, repr=False)

    def __post_init__(self) -> None:
        count = int(self.timestamps_ns.size)
        if not count:
            raise InvalidInputError("imu: expected at least one sample, found none", code="imu_empty", field="imu")
        if self.timestamps_ns.ndim != 1 or self.timestamps_ns.dtype != np.int64:
            raise self._wrong("timestamps_ns", self.timestamps_ns, "an int64 list")
        if self.gyro_rad_s.shape != (count, 3):
            raise self._wrong("gyro_rad_s", self.gyro_rad_s, f"{count} rows of 3 numbers")
        if self.accel_m_s2 is not None and self.accel_m_s2.shape != (count, 3):
            raise self._wrong("accel_m_s2", self.accel_m_s2, f"{count} rows of 3 numbers")
        object.__setattr__(self, "_sorted", bool((np.diff(self.timestamps_ns) >= 0).all()))

    @staticmethod
    def _wrong(name: str, array: NDArray[np.generic], expected: str) -> InvalidInputError:
        return InvalidInputError(
            f"{name}: expected {expected}, found shape {array.shape} of {array.dtype}",
            code="imu_wrong_shape",
            field=f"imu.{name}",
        )

    def __len__(self) -> int:
        return int(self.timestamps_ns.size)

    def between(self, start_ns: int, end_ns: int) -> ImuSamples:
        """Samples from ``start_ns`` to ``end_ns`` (inclusive) and one neighbour on either side where there is one.

        The neighbours let a window interpolate up to its edges. Takes O(log N) for a log in time order; otherwise the
        rows are taken in file order, so that disorder among them is reported instead of sorted away.

        Raises:
            InvalidInputError: ``imu_not_covering`` when the log has nothing there; ``imu_unsorted`` or
                ``imu_duplicate_timestamps`` when the rows taken are out of order.
        """
        first, last = self._sorted_range(start_ns, end_ns) if self._sorted else self._file_range(start_ns, end_ns)
        rows = slice(max(first - 1, 0), last + 1)
        accel = None if self.accel_m_s2 is None else self.accel_m_s2[rows]
        return ImuSamples(self.timestamps_ns[rows], self.gyro_rad_s[rows], accel)

    def _sorted_range(self, start_ns: int, end_ns: int) -> tuple[int, int]:
        first = int(np.searchsorted(self.timestamps_ns, start_ns, side="left"))
        last = int(np.searchsorted(self.timestamps_ns, end_ns, side="right"))
        if first >= last and (first == 0 or first == len(self)):
            raise self._not_covering(start_ns, end_ns)
        return first, last

    def _file_range(self, start_ns: int, end_ns: int) -> tuple[int, int]:
        stamps = self.timestamps_ns
        inside = np.flatnonzero((stamps >= start_ns) & (stamps <= end_ns))
        if inside.size:
            return int(inside[0]), int(inside[-1]) + 1
        before, after = np.flatnonzero(stamps < start_ns), np.flatnonzero(stamps > end_ns)
        if not before.size or not after.size:
            raise self._not_covering(start_ns, end_ns)
        around = sorted((int(before[np.argmax(stamps[before])]), int(after[np.argmin(stamps[after])])))
        return around[0] + 1, around[1]

    def _not_covering(self, start_ns: int, end_ns: int) -> InvalidInputError:
        return InvalidInputError(
            f"imu: expected samples between {start_ns} and {end_ns} ns, found {len(self)} samples between "
            f"{int(self.timestamps_ns.min())} and {int(self.timestamps_ns.max())} ns",
            code="imu_not_covering",
            field="imu",
        )
