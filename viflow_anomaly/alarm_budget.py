"""Which score must a region reach, so that false alarms stay within a budget: statistics of scores, nothing else.

The footage is cut into blocks of seconds that are taken to be exchangeable with blocks to come. Alarms come in clumps
(one badly explained edge gives regions in many pairs), so a count k tells as much as k / c independent ones; the clump
size c is the variance of the blocks' counts over their mean, at least 1. The bound on the rate is Garwood's exact one
for a Poisson count, of clumps: ``c * gammaincinv(k / c + 1, confidence) / hours``. With c = 1 it is exact for single
alarms, with clumps of one size for clumps; for other sizes the variance counts a clump as larger than its mean.

The rate falls as the threshold rises, so the lowest threshold is taken down to which *every* bound from the top on is
within the budget: the choice costs no confidence [Bates et al., Distribution-Free, Risk-Controlling Prediction Sets,
2021]. Where not even a count of zero can promise the budget, the expectation (k + c) / hours takes the bound's place:
for c = 1 the conformal (k + 1) / hours, which is the mean rate of what will score above the (k + 1)-th score from the
top. Its c is of the k alarms alone; a bound's, where they are few, is at least that of a lower threshold with more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LOWEST_THRESHOLD = 0.5
"""No region that scores less is ever labelled as motion (``RegionConfig.motion_score``)."""
STEPS_PER_SCORE = 10_000
"""Thresholds have four decimals, as written scores have."""
MIN_ALARM_BLOCKS = 30
"""A clump size seen in fewer blocks with alarms (and fewer than half of all) says little: the next lower threshold with
as many then speaks, too."""


@dataclass(frozen=True, eq=False)
class ScoredFootage:
    """Scores of the regions in footage without movers that some threshold would label as motion.

    Attributes:
        block_hours: [M] > 0, how long each block is.
        scores: [K], of ``LOWEST_THRESHOLD`` and more.
        blocks: [K] in 0..M-1, which block each is in.
        hours_for_promise: shorter footage promises nothing, whatever its scores.
    """

    block_hours: FloatArray
    scores: FloatArray
    blocks: IntArray
    hours_for_promise: float = 0.0

    def __post_init__(self) -> None:
        assert self.block_hours.ndim == 1
        assert self.block_hours.size
        assert (self.block_hours > 0).all()
        assert self.scores.shape == self.blocks.shape
        assert not self.blocks.size or 0 <= self.blocks.min() <= self.blocks.max() < self.block_hours.size

    @property
    def hours(self) -> float:
        return float(self.block_hours.sum())


class ThresholdChoice(NamedTuple):
    """A threshold, and what the footage says of it.

    Attributes:
        motion_score: regions from this score on are alarms.
        promised: the bound is within the budget; False: the footage is too short, the expectation was taken instead.
        alarms: regions of the footage that reach the threshold.
        alarm_blocks: blocks with such regions.
        clump: how many of them come together.
        bound_per_hour: upper confidence bound on the rate of alarms.
        expected_per_hour: point estimate.
        lowest_bound_per_hour: what the highest threshold, with no alarm at all, can be promised.
        hours_needed: of footage without an alarm, to promise the budget.
    """

    motion_score: float
    promised: bool
    alarms: int
    alarm_blocks: int
    clump: float
    bound_per_hour: float
    expected_per_hour: float
    lowest_bound_per_hour: float
    hours_needed: float


class _Levels(NamedTuple):
    """[L] thresholds from the highest on, with what reaches them."""

    thresholds: FloatArray
    alarms: IntArray
    alarm_blocks: IntArray
    own_clumps: FloatArray
    clumps: FloatArray


def rate_bound(alarms: float, hours: float, *, confidence: float, clump: float = 1.0) -> float:
    """Upper confidence bound on the alarms an hour, given so many in ``hours``; exact for clumps of one size."""
    from scipy.special import gammaincinv  # noqa: PLC0415  # who applies a threshold does not wait for scipy

    return clump * float(gammaincinv(alarms / clump + 1.0, confidence)) / hours


def expected_rate(alarms: float, hours: float, *, clump: float = 1.0) -> float:
    """Alarms an hour to expect of a threshold just above the next score."""
    return (alarms + clump) / hours


def hours_to_promise(budget_per_hour: float, *, confidence: float, clump: float = 1.0) -> float:
    """Footage without a single alarm that promises the budget: about three over the budget at 95 %."""
    return clump * -math.log1p(-confidence) / budget_per_hour


def choose_threshold(footage: ScoredFootage, *, budget_per_hour: float, confidence: float) -> ThresholdChoice:
    """The lowest threshold within the budget.

    Args:
        footage: without movers; those that it has count as false alarms.
        budget_per_hour: alarms an hour, > 0.
        confidence: in (0, 1), with which the promise is kept.
    """
    assert budget_per_hour > 0
    assert 0 < confidence < 1
    levels, hours = _levels(footage), footage.hours
    found = list(zip(levels.alarms.tolist(), levels.clumps.tolist(), strict=True))
    bounds = [rate_bound(alarms, hours, confidence=confidence, clump=clump) for alarms, clump in found]
    expected = [
        expected_rate(alarms, hours, clump=clump)
        for alarms, clump in zip(levels.alarms.tolist(), levels.own_clumps.tolist(), strict=True)
    ]
    promised = bounds[0] <= budget_per_hour and hours >= footage.hours_for_promise
    chosen = _last_within(bounds if promised else expected, budget_per_hour)
    clump = found[chosen][1]
    needed = hours_to_promise(budget_per_hour, confidence=confidence, clump=found[0][1])
    return ThresholdChoice(
        motion_score=float(levels.thresholds[chosen]),
        promised=promised,
        alarms=found[chosen][0],
        alarm_blocks=int(levels.alarm_blocks[chosen]),
        clump=clump,
        bound_per_hour=bounds[chosen],
        expected_per_hour=expected[chosen],
        lowest_bound_per_hour=bounds[0],
        hours_needed=max(footage.hours_for_promise, needed),
    )


def _last_within(rates: list[float], budget_per_hour: float) -> int:
    """Index of the last rate before the first one above the budget; 0 where already the first is."""
    over = next((index for index, rate in enumerate(rates) if rate > budget_per_hour), len(rates))
    return max(0, over - 1)


def _levels(footage: ScoredFootage) -> _Levels:
    """Thresholds just above each score, and the lowest of all."""
    above = np.floor(np.round(footage.scores * STEPS_PER_SCORE, 6)) + 1.0
    thresholds = np.unique(np.append(above / STEPS_PER_SCORE, LOWEST_THRESHOLD))[::-1]
    ascending = np.argsort(footage.scores, kind="stable")
    descending = ascending[::-1]
    alarms = footage.scores.size - np.searchsorted(footage.scores[ascending], thresholds, side="left")
    alarm_blocks, clumps = _clumps(footage.blocks[descending], footage.block_hours)
    alarm_blocks, clumps = alarm_blocks[alarms], clumps[alarms]
    enough = np.flatnonzero(alarm_blocks >= min(MIN_ALARM_BLOCKS, (footage.block_hours.size + 1) // 2))
    reference = int(enough[0]) if enough.size else thresholds.size - 1
    own_clumps = clumps.copy()
    clumps[:reference] = np.maximum(clumps[:reference], clumps[reference])
    return _Levels(thresholds, alarms, alarm_blocks, own_clumps, clumps)


def _clumps(blocks: IntArray, block_hours: FloatArray) -> tuple[IntArray, FloatArray]:
    """Of the first 0, 1, .. K alarms: in how many blocks they are [K + 1], and their clump size [K + 1].

    With x of k alarms in a block of h hours of H, the clump size is M / (M - 1) * sum((x - k h / H)^2) / k: of equal
    blocks variance over mean. One block alone, or all alarms in one, is one clump.
    """
    count, order = blocks.size, np.argsort(blocks, kind="stable")
    starts = np.searchsorted(blocks[order], blocks[order], side="left")
    earlier = np.empty(count, np.int64)  # in the same block
    earlier[order] = np.arange(count) - starts
    alarms = np.arange(count + 1)
    squares = np.append(0, np.cumsum(2 * earlier + 1))  # sum of x^2
    shares = np.append(0.0, np.cumsum(block_hours[blocks])) / block_hours.sum()  # sum of x h / H
    spread = float(np.square(block_hours / block_hours.sum()).sum())
    deviations = squares - 2.0 * alarms * shares + np.square(alarms) * spread
    many = block_hours.size
    sizes = alarms if many == 1 else many / (many - 1) * deviations / np.maximum(alarms, 1)
    return np.append(0, np.cumsum(earlier == 0)), np.maximum(sizes, 1.0).astype(np.float64)
