"""Labelled objects of a KITTI drive: the boxes of ``label_2`` and what ``label_motion_derived.csv`` says of them.

```
drive/
  label_2/0000000109.txt       KITTI's object labels of some frames, boxes in image_02 at its full size
  label_motion_derived.csv     frame,track,type,left,top,right,bottom,...,moving: 1, 0 or ? (not KITTI's; optional)
```

A frame without labels is not a frame without objects, and neither is a place without a box.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from viflow_anomaly.datasets.kitti_files import malformed, numbered_files, read_calibration
from viflow_anomaly.datasets.tables import parse_numbers, read_csv, read_lines

LABELLED_CAMERA = "image_02"
OFFICIAL_SIZE = (1242.0, 375.0)
LABEL_COLUMNS = 15
MOTION_COLUMNS = (
    "frame",
    "track",
    "type",
    "left",
    "top",
    "right",
    "bottom",
    "truncated",
    "occluded",
    "x_cam0",
    "y_cam0",
    "z_cam0",
    "world_speed_mps",
    "moving",
)
MOTION_FILE = "label_motion_derived.csv"

Motion = Literal["moving", "resting", "unknown"]
MOTIONS: dict[str, Motion] = {"1": "moving", "0": "resting", "?": "unknown", "": "unknown"}


@dataclass(frozen=True)
class Box:
    """Edges in pixels of image_02 at its full size."""

    left: float
    top: float
    right: float
    bottom: float


@dataclass(frozen=True)
class LabelledObject:
    """One box of one frame; ``kind`` is KITTI's type (``Car``, ``Pedestrian``, ``DontCare``, ...)."""

    kind: str
    box: Box
    motion: Motion


def read_labelled_objects(drive: Path) -> dict[int, list[LabelledObject]]:
    """{frame number: its objects}, of every frame that has labels in either place.

    An object of ``label_2`` that the motion file does not hold has the motion ``unknown``.

    Raises:
        DatasetError: ``labels_malformed``, ``csv_malformed``, ``file_name_malformed``, ``text_not_utf8``.
    """
    found: dict[int, list[LabelledObject]] = {}
    motion_file = drive / MOTION_FILE
    if motion_file.is_file():
        for number, thing in _motions(motion_file):
            found.setdefault(number, []).append(thing)
    for number, path in _label_files(drive).items():
        objects = found.setdefault(number, [])
        known = {thing.box for thing in objects}
        objects += [thing for thing in _labels(path) if thing.box not in known]
    return found


def label_files(drive: Path) -> list[Path]:
    """All files that ``read_labelled_objects`` reads.

    Raises:
        DatasetError: ``file_name_malformed``.
    """
    return [path for path in (drive / MOTION_FILE, *_label_files(drive).values()) if path.is_file()]


def _label_files(drive: Path) -> dict[int, Path]:
    folder = drive / "label_2"
    return numbered_files(folder, (".txt",)) if folder.is_dir() else {}


def label_scale(drive: Path, width: int, height: int) -> tuple[float, float]:
    """Stored pixels for a pixel of the labels, in u and in v: images may be stored smaller than they were labelled.

    Args:
        drive: its folder; the calibration beside it says the full size, without it 1242x375 is taken.
        width, height: of the images as they are stored.

    Raises:
        DatasetError: as ``read_calibration``.
    """
    path = drive.resolve().parent / "calib_cam_to_cam.txt"
    values = read_calibration(path, {"S_rect_02": 2}) if path.is_file() else {}
    full_width, full_height = values.get("S_rect_02", OFFICIAL_SIZE)
    return width / float(full_width), height / float(full_height)


def _motions(path: Path) -> Iterator[tuple[int, LabelledObject]]:
    for line, cells in read_csv(path, MOTION_COLUMNS, header="names"):
        if not cells[0].isdecimal() or len(cells[0]) > 10 or cells[-1] not in MOTIONS:
            problem = f"expected a frame's number and 0, 1, ? or nothing for moving, found {cells[0]!r:.40}, "
            raise malformed(path, line, "labels_malformed", problem + f"{cells[-1]!r:.40}")
        box = Box(*parse_numbers(path, line, cells[3:7]))
        yield int(cells[0]), LabelledObject(cells[2], box, MOTIONS[cells[-1]])


def _labels(path: Path) -> Iterator[LabelledObject]:
    for line in read_lines(path):
        cells = line.text.split()
        if len(cells) != LABEL_COLUMNS:
            raise malformed(
                path, line.number, "labels_malformed", f"expected {LABEL_COLUMNS} cells, found {len(cells)}"
            )
        yield LabelledObject(cells[0], Box(*parse_numbers(path, line.number, cells[4:8])), "unknown")
