"""A component of probable motion with several peaks, divided where the valley between them is deep.

Where one thing passes before another, the head is less sure along the edge between them than inside either, often
without marking a seam. As the level rises, such a component falls apart; a part counts where its peak stands high
enough above the level at which it came off (its topological persistence: Edelsbrunner, Letscher and Zomorodian, 2002),
so that noise on a plateau divides nothing.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.regions import BoolArray, LabelArray

LEVELS = (0.6, 0.7, 0.8, 0.9, 0.95, 0.98)
"""Probabilities at which a component is looked at."""
MIN_PERSISTENCE = 1.5
"""By how much the logit of a part's peak exceeds the level at which the part came off."""
_ODDS = [level / (1 - level) * math.exp(MIN_PERSISTENCE) for level in LEVELS]
NEEDED_PEAKS = tuple(odds / (1 + odds) for odds in _ODDS)
"""The probability of such a peak, for each level."""
MIN_PART_PX = 30
MIN_PART_SHARE = 0.05
"""Of all that is above the level."""
MIN_BOX_PX = 4 * MIN_PART_PX
"""Smaller things are not looked at."""
SAMPLES = 4096
"""Of a thing's box, evenly spread: more would say where it falls apart no better than to a few pixels."""
MAX_DIVIDED = 64
"""A picture full of specks has nothing to divide, and no picture holds more than so many parts that are worth it."""


def divided_at_valleys(things: LabelArray, motion: Float32Array) -> LabelArray:
    """[h, w] things (1..) of which those with several peaks are divided; a divided thing's first part keeps its number.

    Args:
        things: [h, w], 0 is none; not changed.
        motion: [h, w] probability.
    """
    from scipy.ndimage import find_objects  # noqa: PLC0415  # a part of scikit-image's start-up

    boxes = find_objects(things)
    if len(boxes) > MAX_DIVIDED:
        return things
    divided, made = things, len(boxes)
    waiting = [(number, 0, box) for number, box in enumerate(boxes, start=1) if box is not None]
    while waiting and made < MAX_DIVIDED:
        number, first, box = waiting.pop()
        own = divided[box] == number
        if own.size < MIN_BOX_PX:
            continue
        level, parts = _parts(own, motion[box], first)
        if parts is None:
            continue
        if divided is things:
            divided = things.copy()
        others = range(2, int(parts.max()) + 1)
        for part in others:
            divided[box][own & (parts == part)] = made + part - 1
        waiting += [(number, level + 1, box), *((made + part - 1, level + 1, box) for part in others)]
        made += len(others)
    return divided


def _parts(own: BoolArray, motion: Float32Array, first: int) -> tuple[int, LabelArray | None]:
    """Where a thing falls apart: the first of ``LEVELS`` that divides it, from number ``first`` on, and the part (1..)
    of each pixel, [h, w]; None where none does. What is below the level belongs to the nearest part."""
    pitch = max(1, round((own.size / SAMPLES) ** 0.5))
    some = (slice(None, None, pitch),) * 2
    own, sampled = np.ascontiguousarray(own[some]), np.ascontiguousarray(motion[some])
    highest = cv2.minMaxLoc(sampled, own.view(np.uint8))[1]
    for number in range(first, len(LEVELS)):
        needed = NEEDED_PEAKS[number]
        if highest < needed:
            break
        above = own & (sampled > np.float32(LEVELS[number]))
        count, labels = cv2.connectedComponents(above.view(np.uint8), connectivity=4)
        if count < 3:
            continue
        areas = np.bincount(labels.reshape(-1))[1:]
        large = np.flatnonzero((areas * pitch**2 >= MIN_PART_PX) & (areas >= MIN_PART_SHARE * areas.sum())) + 1
        if len(large) < 2:
            continue
        kept = [int(one) for one in large if cv2.minMaxLoc(sampled, (labels == one).view(np.uint8))[1] >= needed]
        if len(kept) > 1:
            parts = _nearest(np.asarray(labels), kept).repeat(pitch, axis=0).repeat(pitch, axis=1)
            return number, parts[: motion.shape[0], : motion.shape[1]]
    return len(LEVELS), None


def _nearest(labels: LabelArray, kept: list[int]) -> LabelArray:
    """[h, w] which of the kept labels is nearest: 1 for the first of them, and so on."""
    part_of = np.zeros(int(labels.max()) + 1, dtype=np.intp)
    part_of[kept] = np.arange(1, len(kept) + 1)
    parts = part_of[labels]
    inside = parts > 0
    _, seeds = cv2.distanceTransformWithLabels((~inside).view(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    part_of_seed = np.zeros(int(seeds.max()) + 1, dtype=np.intp)
    part_of_seed[seeds[inside]] = parts[inside]
    return np.asarray(part_of_seed[seeds])
