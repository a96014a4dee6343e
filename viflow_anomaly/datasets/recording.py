"""What every reader returns: frames by index, one IMU log, the camera when it is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np

from viflow_anomaly.config import ImageLimits
from viflow_anomaly.datasets.trajectory import Trajectory
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.images import read_image
from viflow_anomaly.imu_log import ImuLog
from viflow_anomaly.sensor_data import Float64Array, Frame, Int64Array, PinholeCamera


class Recording(Protocol):
    """Camera frames and IMU samples of one drive or flight, with random access."""

    @property
    def name(self) -> str: ...

    @property
    def root(self) -> Path:
        """The folder that was read."""
        ...

    @property
    def format(self) -> str:
        """Its key in ``registry.READERS``."""
        ...

    @property
    def camera(self) -> PinholeCamera | None:
        """Calibration of the images as they are stored, or None when the recording has none."""
        ...

    @property
    def camera_name(self) -> str | None:
        """Which of its cameras this is (EuRoC ``cam0``, KITTI ``image_02``), or None where the layout has only one."""
        ...

    @property
    def frame_timestamps_ns(self) -> Int64Array:
        """[F] strictly increasing, in the camera's clock."""
        ...

    @property
    def imu(self) -> ImuLog:
        """Stamps in the IMU's clock: t_imu = t_cam + camera.time_offset_s."""
        ...

    def __len__(self) -> int:
        """F, the number of frames."""
        ...

    def frame(self, index: int) -> Frame:
        """Decode frame ``index`` (negative counts from the end).

        Raises:
            IndexError: outside the recording.
            DatasetError: ``image_missing``.
            InvalidInputError: as ``images.read_image`` and ``Frame``.
        """
        ...

    def frame_path(self, index: int) -> Path: ...

    def motor_command(self, index: int) -> Float64Array | None:
        """[M] the platform's command or speed at frame ``index``, or None where the recording has none."""
        ...

    @property
    def motor_names(self) -> tuple[str, ...]:
        """M names of the numbers of ``motor_command``, with their units; empty where the recording has none."""
        ...

    @property
    def trajectory(self) -> Trajectory | None:
        """Where the camera was, or None where the recording does not say.

        Raises:
            DatasetError: of the reader; the file is read when it is asked for.
        """
        ...


@dataclass(frozen=True, eq=False)
class FileRecording:
    """A recording of image files; the readers of all formats build this.

    Args:
        name, root, format, camera, imu: as in ``Recording``.
        frame_timestamps_ns: [F] int64, strictly increasing.
        frame_paths: F image files.
        motor_commands: [F, M] or None.
        motor_names: M names of its columns; empty without.
        limits: on every image that is decoded.
        read_trajectory: reads the poses of the camera when they are first asked for; None: there are none.
        camera_name: as in ``Recording``.

    Raises:
        DatasetError: ``no_frames``.
    """

    name: str
    root: Path
    format: str
    camera: PinholeCamera | None
    imu: ImuLog
    frame_timestamps_ns: Int64Array
    frame_paths: tuple[Path, ...]
    motor_commands: Float64Array | None = None
    motor_names: tuple[str, ...] = ()
    limits: ImageLimits = field(default_factory=ImageLimits)
    read_trajectory: Callable[[], Trajectory | None] | None = None
    camera_name: str | None = None

    def __post_init__(self) -> None:
        if not self.frame_paths:
            raise DatasetError(f"{self.root}: expected at least one frame, found none", code="no_frames")
        assert len(self.frame_paths) == self.frame_timestamps_ns.size
        assert (np.diff(self.frame_timestamps_ns) > 0).all()
        columns = 0 if self.motor_commands is None else self.motor_commands.shape[1]
        assert columns == len(self.motor_names)
        assert self.motor_commands is None or len(self.motor_commands) == len(self.frame_paths)

    def __len__(self) -> int:
        return len(self.frame_paths)

    def frame(self, index: int) -> Frame:
        path = self.frame_path(index)
        image = read_image(path, limits=self.limits, field="image")
        return Frame(int(self.frame_timestamps_ns[index]), image)

    def frame_path(self, index: int) -> Path:
        if not -len(self) <= index < len(self):
            raise IndexError(f"{self.name}: frame {index} of {len(self)}")
        return self.frame_paths[index]

    def motor_command(self, index: int) -> Float64Array | None:
        self.frame_path(index)
        return None if self.motor_commands is None else np.asarray(self.motor_commands[index])

    @cached_property
    def trajectory(self) -> Trajectory | None:
        return None if self.read_trajectory is None else self.read_trajectory()


def choose_camera(root: Path, cameras: Sequence[str], wanted: str | None) -> str:
    """The wanted camera, else the first.

    Args:
        root: the recording, for the message.
        cameras: those that it has, at least one.
        wanted: a name, or None.

    Raises:
        DatasetError: ``camera_unknown``.
    """
    chosen = wanted or cameras[0]
    if chosen not in cameras:
        raise DatasetError(
            f"{root}: expected one of {', '.join(cameras)}, found camera {chosen!r}", code="camera_unknown"
        )
    return chosen
