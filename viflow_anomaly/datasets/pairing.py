"""Frame pairs of a recording: each frame with the one 1 to 4 places after it, and the IMU samples around both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import overload

from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.sensor_data import FramePair, ImuSamples

MAX_LOOK_AHEAD = 4


def pair_indices(count: int, look_aheads: Sequence[int]) -> list[tuple[int, int]]:
    """(source, target) indices of all pairs of ``count`` frames, by source, then by look-ahead.

    Raises:
        InvalidInputError: ``look_ahead_out_of_range``: none given, or one outside 1 to 4.
    """
    steps = sorted(set(look_aheads))
    if not steps or not all(1 <= step <= MAX_LOOK_AHEAD for step in steps):
        raise InvalidInputError(
            f"look_aheads: expected numbers between 1 and {MAX_LOOK_AHEAD}, found {list(look_aheads)}",
            code="look_ahead_out_of_range",
            field="look_aheads",
        )
    return [(source, source + step) for source in range(count) for step in steps if source + step < count]


class RecordingPairs(Sequence[FramePair]):
    """The pairs of one recording, read when asked for.

    Args:
        recording: any reader's.
        look_aheads: each between 1 and 4.
        before_s, after_s: how much IMU to take before the source and after the target.
        max_interval_s: pairs whose frames lie further apart are not in the sequence but in ``skipped``.

    Attributes:
        indices: (source, target) frame indices of each pair.
        skipped: those left out because of ``max_interval_s``.
    """

    def __init__(
        self,
        recording: Recording,
        look_aheads: Sequence[int] = (1,),
        *,
        before_s: float = 0.25,
        after_s: float = 0.25,
        max_interval_s: float | None = None,
    ) -> None:
        for name, margin in (("before_s", before_s), ("after_s", after_s)):
            if not 0 <= margin < float("inf"):
                raise InvalidInputError(
                    f"{name}: expected seconds from 0 up, found {margin}", code="margin_out_of_range", field=name
                )
        self.recording = recording
        self.before_s = before_s
        self.after_s = after_s
        self.indices: list[tuple[int, int]] = []
        self.skipped: list[tuple[int, int]] = []
        stamps = recording.frame_timestamps_ns
        for source, target in pair_indices(len(recording), look_aheads):
            far = max_interval_s is not None and int(stamps[target] - stamps[source]) > round(max_interval_s * 1e9)
            (self.skipped if far else self.indices).append((source, target))

    def __len__(self) -> int:
        return len(self.indices)

    @overload
    def __getitem__(self, index: int) -> FramePair: ...

    @overload
    def __getitem__(self, index: slice) -> list[FramePair]: ...

    def __getitem__(self, index: int | slice) -> FramePair | list[FramePair]:
        """Read pair ``index`` (negative counts from the end).

        Raises:
            IndexError: outside the sequence.
            InvalidInputError: as ``Recording.frame``, ``ImuLog.between`` and ``FramePair``.
            DatasetError: ``image_missing``.
        """
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        source, target = self.indices[index]
        return FramePair(
            source=self.recording.frame(source),
            target=self.recording.frame(target),
            imu=self.imu(index),
            camera=self.recording.camera,
            motor_command=self.recording.motor_command(source),
        )

    def stamps(self, index: int) -> tuple[int, int]:
        """(source, target) stamps of pair ``index`` in camera time, nanoseconds; no image is read."""
        source, target = self.indices[index]
        stamps = self.recording.frame_timestamps_ns
        return int(stamps[source]), int(stamps[target])

    def imu(self, index: int) -> ImuSamples:
        """The samples of pair ``index`` from ``before_s`` ahead of it to ``after_s`` behind it, in IMU time.

        Raises:
            InvalidInputError: as ``ImuLog.between``.
        """
        camera = self.recording.camera
        offset_s = 0.0 if camera is None else camera.time_offset_s
        source_ns, target_ns = self.stamps(index)
        start_ns = source_ns + round((offset_s - self.before_s) * 1e9)
        return self.recording.imu.between(start_ns, target_ns + round((offset_s + self.after_s) * 1e9))
