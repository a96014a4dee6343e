"""What both readers of KITTI odometry sequences begin with: cameras, images, stamps, where the dataset is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from viflow_anomaly.datasets.kitti_files import stamp_of
from viflow_anomaly.datasets.tables import check_increasing
from viflow_anomaly.sensor_data import Int64Array

CAMERAS = ("image_0", "image_2", "image_1", "image_3")


def cameras_of(sequence: Path) -> list[str]:
    """The folders of images, the preferred camera first."""
    return [name for name in CAMERAS if (sequence / name).is_dir()]


def dataset_of(sequence: Path) -> Path:
    """The folder that holds ``sequences/``; at the root of a file system, the root."""
    return sequence.resolve().parent.parent


def frame_stamps(path: Path, stamps: dict[int, int], numbers: Sequence[int]) -> tuple[Int64Array, Int64Array]:
    """Stamps of the frames whose image is there [F], and of all frames of the sequence [N], which the poses belong to.

    Args:
        path: the file of stamps, for messages.
        stamps: {frame number: nanoseconds}, in the order of the file.
        numbers: of the frames whose image is there.

    Raises:
        DatasetError: ``timestamps_missing``; ``timestamps_not_increasing``, also at a frame whose image is missing.
    """
    frames = np.array([stamp_of(path, stamps, number) for number in numbers], dtype=np.int64)
    check_increasing(path, list(stamps.values()), [number + 1 for number in stamps])
    return frames, np.array(list(stamps.values()), dtype=np.int64)
