"""Moving pixels that touch, told apart by where the evidence head sees the middles of the things they belong to.

Every block votes for a place, its own plus its offset. Votes of one thing gather; a place where enough of them do is
the middle of a thing, and every block goes to the middle nearest to its vote (as in Panoptic-DeepLab, Cheng et al.,
CVPR 2020, without a second map for the middles).
"""

from __future__ import annotations

import cv2
import numpy as np

from viflow_anomaly.config import EVIDENCE_BLOCK_PX
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.regions import IndexArray, LabelArray
from viflow_anomaly.sensor_data import Float64Array

MAX_DIVIDED = 64
"""Of a picture full of specks no more than so many, the largest, are looked at."""
MIN_BLOCKS = 6
"""A component of fewer is one thing."""
REACH = 0.5
"""Votes gather within so many side lengths of a thing, taken as the root of the component's blocks..."""
MAX_REACH_BLOCKS = 5.0
"""...or within so many blocks."""
MIN_VOTES = 0.15
"""Of the component's votes, for a middle of its own."""


def middles_of(votes: Float64Array) -> Float64Array:
    """[M, 2] places where votes [N, 2] gather, M at least 1; both in blocks."""
    reach = min(REACH * np.sqrt(len(votes)), MAX_REACH_BLOCKS)
    side = 2 * round(reach / 2) + 1
    low = np.floor(votes.min(axis=0)).astype(int) - side
    high = np.ceil(votes.max(axis=0)).astype(int) + side + 1
    at = np.rint(votes).astype(int) - low
    cast = np.zeros(tuple(high - low), dtype=np.float32)
    np.add.at(cast, (at[:, 0], at[:, 1]), 1)
    gathered = np.asarray(cv2.boxFilter(cast, -1, (side, side), normalize=False), np.float32)
    gathered = np.asarray(cv2.GaussianBlur(gathered, (0, 0), side / 4), np.float32)
    block = np.ones((2 * side + 1, 2 * side + 1), np.uint8)
    peaks = (gathered >= cv2.dilate(gathered, block)) & (gathered >= MIN_VOTES * len(votes))
    if not peaks.any():
        return np.asarray(votes.mean(axis=0, keepdims=True))
    count, labels = cv2.connectedComponents(peaks.astype(np.uint8))
    middles = [np.argwhere(labels == k).mean(axis=0) for k in range(1, count)]
    return np.asarray(np.array(middles) + low, dtype=np.float64)


def things_of_blocks(rows: IndexArray, columns: IndexArray, offsets: Float32Array) -> IndexArray:
    """[N] number of the thing (0..) that each block of one component belongs to.

    Args:
        rows, columns: [N] of the blocks.
        offsets: [2, h, w] from every block to its thing's middle, in blocks (y, x).
    """
    if len(rows) < MIN_BLOCKS:
        return np.zeros(len(rows), dtype=np.intp)
    places = np.column_stack([rows, columns])
    votes = np.asarray(places + offsets[:, rows, columns].T, dtype=np.float64)
    middles = middles_of(votes)
    if len(middles) == 1:
        return np.zeros(len(rows), dtype=np.intp)
    distances = ((votes[:, None] - middles[None]) ** 2).sum(axis=-1)
    return np.asarray(np.unique(distances.argmin(axis=1), return_inverse=True)[1], dtype=np.intp)


def things_of_pixels(labels: LabelArray, offsets: Float32Array, origin: tuple[int, int]) -> LabelArray:
    """[H, W] components (1..) divided into things (1..); the largest keep their component's number.

    Args:
        labels: [H, W] components, 0 is none; a cut-out of the image.
        offsets: [2, h, w] of the whole image's blocks.
        origin: row and column of the cut-out's first pixel in the image.
    """
    at = np.flatnonzero(labels)
    component = labels.reshape(-1)[at]
    areas_px = np.bincount(component, minlength=1)
    largest = np.argsort(-areas_px, kind="stable")[:MAX_DIVIDED]
    divided = largest[areas_px[largest] >= MIN_BLOCKS * EVIDENCE_BLOCK_PX**2]
    if not divided.size:
        return labels
    things, made = labels.copy(), len(areas_px) - 1
    by_component = at[np.argsort(component, kind="stable")]
    ends = np.cumsum(areas_px)
    for number in divided:
        pixels = by_component[ends[number] - areas_px[number] : ends[number]]
        rows, columns = pixels // labels.shape[1] + origin[0], pixels % labels.shape[1] + origin[1]
        blocks = (rows // EVIDENCE_BLOCK_PX) * offsets.shape[2] + columns // EVIDENCE_BLOCK_PX
        own, which = np.unique(blocks, return_inverse=True)
        thing = things_of_blocks(own // offsets.shape[2], own % offsets.shape[2], offsets)[which]
        things.reshape(-1)[pixels] = np.where(thing == 0, number, made + thing)
        made += int(thing.max())
    return things
