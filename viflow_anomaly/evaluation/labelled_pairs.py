"""Pairs of frames with what moves by itself in them: boxes to find, boxes to leave out, pixels where there are masks.

Two kinds: simulated sequences (masks of every mover, how far each moved), and KITTI drives with labels (boxes on some
frames, no masks). ``open_labelled`` tells which a folder is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.config import MotorSource
from viflow_anomaly.datasets import kitti_raw
from viflow_anomaly.datasets.ground_truth_folder import GroundTruthFolder
from viflow_anomaly.datasets.kitti_labels import (
    LABELLED_CAMERA,
    MOTION_FILE,
    Box,
    LabelledObject,
    label_scale,
    read_labelled_objects,
)
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.evaluation.flow_run import group_of
from viflow_anomaly.evaluation.flow_truth import RecordingTruth
from viflow_anomaly.regions import BoundingBox
from viflow_anomaly.sensor_data import FramePair

BoolArray = NDArray[np.bool_]

MIN_INDEPENDENT_FLOW_PX = 1.0
"""A mover that shifts less between the frames, or happens to move with the static flow, is neither found nor missed."""
MIN_AREA_PX = 30


@dataclass(frozen=True)
class TrueObject:
    """One moving thing in one frame.

    Attributes:
        bbox: in source pixels.
        independent_flow_px: how far it moved beyond what a resting thing would have; None: not known.
        counted: False: too small, too slow, or not known to move; neither a hit nor a false alarm.
    """

    bbox: BoundingBox
    independent_flow_px: float | None
    counted: bool

    @property
    def box_area_px(self) -> int:
        return self.bbox.width * self.bbox.height


class Pixels(NamedTuple):
    """The movers' pixels, [H, W] each: ``moving`` of the counted, ``ignored`` of the others."""

    moving: BoolArray
    ignored: BoolArray


@dataclass(frozen=True, eq=False)
class Labels:
    """All movers of a frame, and their pixels where they are known (None: boxes only)."""

    objects: tuple[TrueObject, ...]
    pixels: Pixels | None = field(default=None, repr=False)


class LabelledPairs(Protocol):
    """Pairs of adjacent frames whose source has labels, of one sequence."""

    @property
    def sequence(self) -> str:
        """Its name."""

    @property
    def group(self) -> str:
        """What its figures are added up with."""

    def __len__(self) -> int:
        """How many pairs."""

    def pair(self, index: int, motor_source: MotorSource | None = None) -> FramePair:
        """Both frames with the motor command that a network wants beside them (None: none).

        Raises:
            InvalidInputError: a pair that cannot be used; it is left out and counted.
            DatasetError: a recording that cannot be read.
        """

    def labels(self, index: int) -> Labels:
        """What moves in the source frame.

        Raises:
            DatasetError: ``ground_truth_missing``, ``ground_truth_malformed``.
        """


class SimulatedPairs:
    """A simulated sequence.

    Args:
        path: the recording.
        group: None: its name up to the first underscore.

    Raises:
        DatasetError: ``ground_truth_missing`` without ground truth, masks of movers or pairs; as ``open_recording``.
    """

    def __init__(self, path: Path, *, group: str | None = None) -> None:
        self._truth = RecordingTruth(path)
        self.sequence = self._truth.sequence
        self.group = group_of(self.sequence) if group is None else group
        instances = self._truth.ground_truth.folder / "instances"
        if not instances.is_dir():
            raise DatasetError(
                f"{path}: expected masks of what moves ({instances}), found static ground truth alone",
                code="ground_truth_missing",
                field="recordings",
            )

    def __len__(self) -> int:
        return len(self._truth)

    def pair(self, index: int, motor_source: MotorSource | None = None) -> FramePair:
        return self._truth.pair(index, motor_source)

    def labels(self, index: int) -> Labels:
        return labels_of(self._truth.ground_truth, self._truth.name(index).source_timestamp_ns)


def labels_of(truth: GroundTruthFolder, source_timestamp_ns: int) -> Labels:
    """The movers of one frame of a simulated sequence.

    Raises:
        DatasetError: as ``GroundTruthFolder.instances`` and ``objects``.
    """
    instances = truth.instances(source_timestamp_ns)
    pixels = Pixels(np.zeros(instances.shape, dtype=np.bool_), np.zeros(instances.shape, dtype=np.bool_))
    objects = []
    for thing in truth.objects(source_timestamp_ns):
        fast = thing.independent_flow_px >= MIN_INDEPENDENT_FLOW_PX
        counted = fast and thing.area_px >= MIN_AREA_PX
        box = BoundingBox(thing.u_min, thing.v_min, thing.u_max - thing.u_min + 1, thing.v_max - thing.v_min + 1)
        objects.append(TrueObject(box, thing.independent_flow_px, counted))
        (pixels.moving if counted else pixels.ignored)[instances == thing.instance_id] = True
    return Labels(tuple(objects), pixels)


class KittiPairs:
    """The labelled frames of a KITTI raw drive, each with the next frame.

    A box counts when the motion file says that it moves, and is background when it says that it rests. All others
    (no flag, as of most pedestrians and cyclists; ``?``; ``DontCare``; not in the motion file) are left out.

    Args:
        path: the drive; ``image_02``, at any size.

    Raises:
        DatasetError: ``ground_truth_missing`` without a labelled frame that has a next one; as ``open_recording`` and
            ``read_labelled_objects``.
    """

    def __init__(self, path: Path) -> None:
        recording = open_recording(path, format="kitti_raw", camera=LABELLED_CAMERA)
        self._height, self._width = recording.frame(0).image.shape
        self._scale = label_scale(recording.root, self._width, self._height)
        objects = read_labelled_objects(recording.root)
        pairs = RecordingPairs(recording, motor_source=None)
        numbers = [int(recording.frame_path(source).stem) for source, _ in pairs.indices]
        self._chosen = [(index, objects[number]) for index, number in enumerate(numbers) if number in objects]
        self._pairs: dict[MotorSource | None, RecordingPairs] = {None: pairs}
        self.sequence = recording.name
        self.group = f"kitti {self._width}x{self._height}"
        if not self._chosen:
            raise DatasetError(
                f"{path}: expected labels (label_2, {MOTION_FILE}) of a frame with a next one, found none",
                code="ground_truth_missing",
                field="recordings",
            )

    def __len__(self) -> int:
        return len(self._chosen)

    def pair(self, index: int, motor_source: MotorSource | None = None) -> FramePair:
        if motor_source not in self._pairs:
            self._pairs[motor_source] = RecordingPairs(self._pairs[None].recording, motor_source=motor_source)
        return self._pairs[motor_source][self._chosen[index][0]]

    def labels(self, index: int) -> Labels:
        boxes = [(self._stored(thing.box), thing) for thing in self._chosen[index][1] if thing.motion != "resting"]
        return Labels(tuple(_true_object(box, thing) for box, thing in boxes if box.width > 0 and box.height > 0))

    def _stored(self, box: Box) -> BoundingBox:
        """In whole pixels of the stored image, inside it."""
        (scale_u, scale_v), sizes = self._scale, (self._width, self._height)
        left, top = (max(0, math.floor(edge)) for edge in (box.left * scale_u, box.top * scale_v))
        ends = (box.right * scale_u, box.bottom * scale_v)
        right, bottom = (min(size, math.floor(edge) + 1) for edge, size in zip(ends, sizes, strict=True))
        return BoundingBox(left, top, right - left, bottom - top)


def _true_object(box: BoundingBox, thing: LabelledObject) -> TrueObject:
    counted = thing.motion == "moving" and box.width * box.height >= MIN_AREA_PX
    return TrueObject(box, None, counted)


def open_labelled(path: Path) -> LabelledPairs:
    """A KITTI drive with ``label_motion_derived.csv``, else a simulated sequence.

    Raises:
        DatasetError: as ``KittiPairs`` and ``SimulatedPairs``.
    """
    if kitti_raw.find_root(path) is not None and (path / MOTION_FILE).is_file():
        return KittiPairs(path)
    return SimulatedPairs(path)


def every_nth(pairs: Sequence[LabelledPairs], every: int) -> list[tuple[LabelledPairs, int]]:
    """(pairs, index) of every n-th pair of each sequence."""
    return [(some, index) for some in pairs for index in range(0, len(some), every)]
