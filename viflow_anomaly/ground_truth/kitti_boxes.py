"""Where things may move in a KITTI drive: the boxes of ``label_2`` and what ``label_motion_derived.csv`` says of them.

```
drive/
  label_2/0000000109.txt       KITTI's object labels of some frames, boxes in image_02 at its full size
  label_motion_derived.csv     frame,track,type,left,top,right,bottom,...,moving: 1, 0 or ? (not KITTI's; optional)
```
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from viflow_anomaly.datasets.kitti_files import malformed, numbered_files
from viflow_anomaly.datasets.tables import parse_numbers, read_csv, read_lines

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
RESTING = "0"
MOTION_NAME = "label_motion_derived.csv"


@dataclass(frozen=True)
class Box:
    """Edges in pixels of image_02 at its full size."""

    left: float
    top: float
    right: float
    bottom: float


def read_doubtful_boxes(drive: Path) -> dict[int, list[Box]]:
    """{frame number: boxes of what moves, may move, or is not said to rest} of every frame that has labels.

    Without the motion file every labelled object may move, ``DontCare`` regions always may.

    Raises:
        DatasetError: ``labels_malformed``, ``csv_malformed``, ``file_name_malformed``, ``text_not_utf8``.
    """
    motion_file = drive / MOTION_NAME
    resting: dict[int, set[Box]] = {}
    doubtful: dict[int, list[Box]] = {}
    if motion_file.is_file():
        for number, box, moving in _motions(motion_file):
            resting.setdefault(number, set())
            boxes = doubtful.setdefault(number, [])
            if moving == RESTING:
                resting[number].add(box)
            else:
                boxes.append(box)
    for number, path in _label_files(drive).items():
        boxes = [box for box in _labels(path) if box not in resting.get(number, ())]
        doubtful[number] = [*doubtful.get(number, []), *boxes]
    return doubtful


def label_files(drive: Path) -> list[Path]:
    """All files that ``read_doubtful_boxes`` reads.

    Raises:
        DatasetError: ``file_name_malformed``.
    """
    return [path for path in (drive / MOTION_NAME, *_label_files(drive).values()) if path.is_file()]


def _label_files(drive: Path) -> dict[int, Path]:
    folder = drive / "label_2"
    return numbered_files(folder, (".txt",)) if folder.is_dir() else {}


def _motions(path: Path) -> Iterator[tuple[int, Box, str]]:
    for line, cells in read_csv(path, MOTION_COLUMNS, header="names"):
        if not cells[0].isdecimal() or len(cells[0]) > 10 or cells[-1] not in {"0", "1", "?", ""}:
            problem = f"expected a frame's number and 0, 1, ? or nothing for moving, found {cells[0]!r:.40}, "
            raise malformed(path, line, "labels_malformed", problem + f"{cells[-1]!r:.40}")
        yield int(cells[0]), Box(*parse_numbers(path, line, cells[3:7])), cells[-1]


def _labels(path: Path) -> Iterator[Box]:
    for line in read_lines(path):
        cells = line.text.split()
        if len(cells) != LABEL_COLUMNS:
            raise malformed(
                path, line.number, "labels_malformed", f"expected {LABEL_COLUMNS} cells, found {len(cells)}"
            )
        yield Box(*parse_numbers(path, line.number, cells[4:8]))
