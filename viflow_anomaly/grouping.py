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
    rows, columns = high - low
    cast = (
        np.bincount(at[:, 0] * columns + at[:, 1], minlength=rows * columns).astype(np.float32).reshape(rows, columns)
    )
    gathered = np.asarray(cv2.boxFilter(cast, -1, (side, side), normalize=False), np.float32)
    gathered = np.asarray(cv2.GaussianBlur(gathered, (0, 0), side / 4), np.float32)
    block = np.ones((2 * side + 1, 2 * side + 1), np.uint8)
    peaks = (gathered >= cv2.dilate(gathered, block)) & (gathered >= MIN_VOTES * len(votes))
    if not peaks.any():
        return np.asarray(votes.mean(axis=0, keepdims=True))
    _, _, _, middles = cv2.connectedComponentsWithStats(peaks.view(np.uint8))
    return np.asarray(middles[1:, ::-1] + low, dtype=np.float64)


def things_of_pixels(labels: LabelArray, offsets: Float32Array, origin: tuple[int, int]) -> LabelArray:
    """[H, W] components (1..) divided into things (1..); the first of each keeps its component's number.

    Args:
        labels: [H, W] components, 0 is none; a cut-out of the image.
        offsets: [2, h, w] from every block of the whole image to its thing's middle, in blocks (y, x).
        origin: row and column of the cut-out's first pixel in the image.
    """
    middle = EVIDENCE_BLOCK_PX // 2
    first = [-(-max(start - middle, 0) // EVIDENCE_BLOCK_PX) for start in origin]  # blocks whose middles are inside
    starts = [block * EVIDENCE_BLOCK_PX + middle - start for block, start in zip(first, origin, strict=True)]
    at_blocks = labels[starts[0] :: EVIDENCE_BLOCK_PX, starts[1] :: EVIDENCE_BLOCK_PX]
    counts = np.bincount(at_blocks.reshape(-1), minlength=1)
    counts[0] = 0
    largest = np.argsort(-counts, kind="stable")[:MAX_DIVIDED]
    things, made = labels, int(labels.max(initial=0))
    for number in largest[counts[largest] >= MIN_BLOCKS]:
        rows, columns = np.nonzero(at_blocks == number)
        rows, columns = rows + first[0], columns + first[1]
        votes = np.column_stack([rows, columns]) + offsets[:, rows, columns].T
        middles = middles_of(np.asarray(votes, dtype=np.float64))
        if len(middles) == 1:
            continue
        if things is labels:
            things = labels.copy()
        y, x = np.nonzero(labels == number)
        thing = _nearest(offsets, middles, (y + origin[0]) // EVIDENCE_BLOCK_PX, (x + origin[1]) // EVIDENCE_BLOCK_PX)
        things[y, x] = np.where(thing == 0, number, made + thing)
        made += len(middles) - 1
    return things


def _nearest(offsets: Float32Array, middles: Float64Array, rows: IndexArray, columns: IndexArray) -> IndexArray:
    """[N] number of the middle that is nearest to the vote of the block at each row and column [N]."""
    y, x = rows + offsets[0, rows, columns], columns + offsets[1, rows, columns]
    return np.asarray(np.argmin([(y - at_y) ** 2 + (x - at_x) ** 2 for at_y, at_x in middles], axis=0), dtype=np.intp)
