"""Where things may move in a KITTI drive."""

from __future__ import annotations

from pathlib import Path

from viflow_anomaly.datasets.kitti_labels import Box, read_labelled_objects


def read_doubtful_boxes(drive: Path) -> dict[int, list[Box]]:
    """{frame number: boxes of what moves, may move, or is not said to rest} of every frame that has labels.

    Without the motion file every labelled object may move, ``DontCare`` regions always may.

    Raises:
        DatasetError: as ``read_labelled_objects``.
    """
    return {
        number: [thing.box for thing in objects if thing.motion != "resting"]
        for number, objects in read_labelled_objects(drive).items()
    }
