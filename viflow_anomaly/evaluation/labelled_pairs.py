"""What moves by itself in a frame, from a simulated sequence's ground truth: boxes to find, boxes to leave out."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.datasets.simulated_ground_truth import SimulatedGroundTruth
from viflow_anomaly.regions import BoundingBox

BoolArray = NDArray[np.bool_]

MIN_INDEPENDENT_FLOW_PX = 1.0
"""A mover that shifts less between the frames, or happens to move with the static flow, is neither found nor missed."""
MIN_AREA_PX = 30


@dataclass(frozen=True)
class TrueObject:
    """One moving thing in one frame.

    Attributes:
        bbox: in source pixels.
        independent_flow_px: how far it moved beyond what a resting thing would have.
        counted: False: too small or too slow to judge; neither a hit nor a false alarm.
    """

    bbox: BoundingBox
    independent_flow_px: float
    counted: bool


@dataclass(frozen=True, eq=False)
class Labels:
    """All movers of a frame, and their pixels: ``moving`` [H, W] of the counted, ``ignored`` [H, W] of the others."""

    objects: tuple[TrueObject, ...]
    moving: BoolArray = field(repr=False)
    ignored: BoolArray = field(repr=False)


def labels_of(truth: SimulatedGroundTruth, source_timestamp_ns: int) -> Labels:
    """The movers of one frame of a simulated sequence.

    Raises:
        DatasetError: as ``SimulatedGroundTruth.instances`` and ``objects``.
    """
    instances = truth.instances(source_timestamp_ns)
    moving = np.zeros(instances.shape, dtype=np.bool_)
    ignored = np.zeros(instances.shape, dtype=np.bool_)
    objects = []
    for thing in truth.objects(source_timestamp_ns):
        fast = thing.independent_flow_px >= MIN_INDEPENDENT_FLOW_PX
        counted = fast and thing.area_px >= MIN_AREA_PX
        box = BoundingBox(thing.u_min, thing.v_min, thing.u_max - thing.u_min + 1, thing.v_max - thing.v_min + 1)
        objects.append(TrueObject(box, thing.independent_flow_px, counted))
        (moving if counted else ignored)[instances == thing.instance_id] = True
    return Labels(tuple(objects), moving, ignored)
