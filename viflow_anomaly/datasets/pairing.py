"""Frame pairs of a recording: each frame with the one 1 to 4 places after it, and the IMU samples around both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import overload

from viflow_anomaly.config import MotorSource
from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.sensor_data import Float64Array, FramePair, ImuSamples

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
        motor_source: what ``FramePair.motor_command`` gets: the recording's own command at the source frame where it
            has one, or the camera's displacement along its trajectory (``ModelConfig.motor_source``).

    Attributes:
        indices: (source, target) frame indices of each pair.
        skipped: those left out because of ``max_interval_s``.

    Raises:
        DatasetError: ``trajectory_missing``: a displacement is asked for and the recording has no poses; as
            ``Recording.trajectory``.
    """

    def __init__(
        self,
        recording: Recording,
        look_aheads: Sequence[int] = (1,),
        *,
        before_s: float = 0.25,
        after_s: float = 0.25,
        max_interval_s: float | None = None,
        motor_source: MotorSource | None = "command",
    ) -> None:
        for name, margin in (("before_s", before_s), ("after_s", after_s)):
            if not 0 <= margin < float("inf"):
                raise InvalidInputError(
                    f"{name}: expected seconds from 0 up, found {margin}", code="margin_out_of_range", field=name
                )
        self.recording = recording
        self._trajectory = recording.trajectory if motor_source == "displacement" else None
        if motor_source == "displacement" and self._trajectory is None:
            raise DatasetError(
                f"{recording.root}: expected poses of the camera (this model's motor input is a displacement), "
                f"found none in this {recording.format} recording",
                code="trajectory_missing",
                field="motor_command",
            )
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
            DatasetError: ``image_missing``, ``trajectory_not_covering``.
        """
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        source, target = self.indices[index]
        return FramePair(
            source=self.recording.frame(source),
            target=self.recording.frame(target),
            imu=self.imu(index),
            camera=self.recording.camera,
            motor_command=self.motor_command(index),
        )

    def motor_command(self, index: int) -> Float64Array | None:
        """[M] command or displacement of pair ``index``, None where the recording has no commands.

        Raises:
            DatasetError: ``trajectory_not_covering``.
        """
        if self._trajectory is not None:
            return self._trajectory.displacement_m(*self.stamps(index))
        return self.recording.motor_command(self.indices[index][0])

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
