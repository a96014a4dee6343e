"""What is true of the pixels that an evidence head learns from: bits of each, and where things have their middles."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.config import EVIDENCE_BLOCK_PX, MAX_OFFSET_BLOCKS
from viflow_anomaly.datasets.ground_truth_folder import GroundTruthFolder
from viflow_anomaly.evaluation.labelled_pairs import labels_of
from viflow_anomaly.sensor_data import Uint8Array

MOVING, IGNORED, SEAM = 1, 2, 4
"""Bits of ``truth``: a counted mover; what counts neither way; a moving pixel near another moving thing."""
SIZE_SHIFT = 3
"""Above the three bits: the logarithm to base 2, rounded, of the area in pixels of the mover that a pixel is of."""
SEAM_REACH_PX = 3


class Scene(NamedTuple):
    """One frame: moving (counted movers) and ignored, both [H, W] bool, and instances [H, W], 0 is none."""

    moving: NDArray[np.bool_]
    ignored: NDArray[np.bool_]
    instances: Uint8Array


def scene_of(ground_truth: GroundTruthFolder, source_timestamp_ns: int) -> Scene:
    """The masks of one frame; errors as ``labels_of``."""
    pixels = labels_of(ground_truth, source_timestamp_ns).pixels
    assert pixels is not None
    return Scene(pixels.moving, pixels.ignored, ground_truth.instances(source_timestamp_ns))


def truth_of(scene: Scene) -> Uint8Array:
    """[H, W] bits: ``MOVING``, ``IGNORED``, ``SEAM``, and of what moves its size."""
    truth = np.where(scene.moving, MOVING, 0).astype(np.uint8)
    truth[scene.ignored] = IGNORED
    block = np.ones((2 * SEAM_REACH_PX + 1,) * 2, np.uint8)
    for thing in np.unique(scene.instances[scene.instances > 0]):
        itself = scene.instances == thing
        near = cv2.dilate(itself.astype(np.uint8), block) != 0
        truth[near & ~itself & scene.moving] |= SEAM
        size = round(math.log2(np.count_nonzero(itself)))
        truth[itself & scene.moving] |= size << SIZE_SHIFT
    return truth


def offsets_of(instances: Uint8Array, blocks: tuple[int, ...]) -> NDArray[Any]:
    """[2, h, w] int8 blocks (y, x) from each block to the middle of the thing at its own middle; 0 where there is none.

    Args:
        instances: [H, W] numbers of things, 0 is none.
        blocks: h and w, of the padded image.
    """
    offsets = np.zeros((2, *blocks), dtype=np.int8)
    middle = EVIDENCE_BLOCK_PX // 2
    owners = instances[middle::EVIDENCE_BLOCK_PX, middle::EVIDENCE_BLOCK_PX]
    for thing in np.unique(owners[owners > 0]):
        pixels, mine = np.nonzero(instances == thing), np.nonzero(owners == thing)
        for axis in range(2):
            centre = (pixels[axis].mean() + 0.5) / EVIDENCE_BLOCK_PX - 0.5
            offsets[axis][mine] = np.clip(np.rint(centre - mine[axis]), -MAX_OFFSET_BLOCKS, MAX_OFFSET_BLOCKS)
    return offsets
