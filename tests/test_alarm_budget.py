from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chi2, poisson

from viflow_anomaly.alarm_budget import (
    ScoredFootage,
    ThresholdChoice,
    choose_threshold,
    expected_rate,
    hours_to_promise,
    rate_bound,
)

BLOCK_HOURS = 10.0 / 3600.0


def footage(scores: list[float], blocks: list[int] | None = None, *, count: int = 360) -> ScoredFootage:
    """``count`` blocks of 10 s; each score in a block of its own where nothing is said."""
    places = list(range(len(scores))) if blocks is None else blocks
    return ScoredFootage(
        np.full(count, BLOCK_HOURS), np.array(scores, dtype=np.float64), np.array(places, dtype=np.int64)
    )


def choose(seen: ScoredFootage, budget_per_hour: float, confidence: float = 0.95) -> ThresholdChoice:
    return choose_threshold(seen, budget_per_hour=budget_per_hour, confidence=confidence)


# --- rates in closed form


@pytest.mark.parametrize("confidence", [0.5, 0.9, 0.95, 0.99])
def test_no_alarm_bounds_the_rate_by_minus_the_logarithm(confidence: float) -> None:
    assert rate_bound(0, 2.0, confidence=confidence) == pytest.approx(-math.log(1 - confidence) / 2.0)


def test_rule_of_three() -> None:
    assert rate_bound(0, 1.0, confidence=0.95) == pytest.approx(3.0, abs=0.01)
    assert hours_to_promise(10.0, confidence=0.95) == pytest.approx(0.3, abs=0.001)


@given(alarms=st.integers(0, 500), hours=st.floats(0.01, 100), confidence=st.floats(0.01, 0.999))
def test_the_bound_is_garwoods(alarms: int, hours: float, confidence: float) -> None:
    """It is the rate at which so few alarms, or fewer, have the probability 1 - confidence."""
    bound = rate_bound(alarms, hours, confidence=confidence)
    assert bound == pytest.approx(chi2.ppf(confidence, 2 * alarms + 2) / 2 / hours, rel=1e-9)
    assert poisson.cdf(alarms, bound * hours) == pytest.approx(1 - confidence, rel=1e-6)


@given(clumps=st.integers(0, 50), size=st.integers(1, 40))
def test_clumps_of_one_size_are_counted_as_clumps(clumps: int, size: int) -> None:
    bound = rate_bound(clumps * size, 3.0, confidence=0.95, clump=size)
    assert bound == pytest.approx(size * rate_bound(clumps, 3.0, confidence=0.95))
    assert expected_rate(clumps * size, 3.0, clump=size) == pytest.approx(size * (clumps + 1) / 3.0)


@given(clump=st.floats(1, 50), confidence=st.floats(0.5, 0.999), budget=st.floats(0.1, 1000))
def test_the_footage_needed_is_just_enough(clump: float, confidence: float, budget: float) -> None:
    hours = hours_to_promise(budget, confidence=confidence, clump=clump)
    assert rate_bound(0, hours, confidence=confidence, clump=clump) == pytest.approx(budget)


# --- the choice


def test_no_region_at_all_leaves_the_lowest_threshold() -> None:
    choice = choose(footage([]), 10.0)
    assert (choice.motion_score, choice.promised, choice.alarms, choice.clump) == (0.5, True, 0, 1.0)
    assert choice.bound_per_hour == pytest.approx(-math.log(0.05))
    assert choice.expected_per_hour == 1.0


def test_as_many_alarms_are_let_through_as_the_bound_allows() -> None:
    """One hour, budget 10: the bound of 4 alarms is 9.15, of 5 it is 10.5."""
    scores = [0.51 + 0.01 * k for k in range(20)]
    choice = choose(footage(scores), 10.0)
    assert choice.promised
    assert choice.alarms == 4
    assert choice.motion_score == 0.6601  # just above the fifth from the top
    assert choice.bound_per_hour == pytest.approx(9.154, abs=0.001)
    assert choice.expected_per_hour == pytest.approx(5.0)


def test_the_threshold_lets_exactly_the_counted_alarms_through() -> None:
    scores = [0.5, 0.8156, 0.8156, 0.81564, 0.9, 1.0]
    for budget in (4.0, 5.0, 7.0, 8.0, 9.5, 12.0, 13.0):
        choice = choose(footage(scores), budget)
        assert sum(score >= choice.motion_score for score in scores) == choice.alarms
        assert rate_bound(choice.alarms, 1.0, confidence=0.95, clump=choice.clump) <= budget
    assert choose(footage(scores), 1000.0).motion_score == 0.5


def test_a_score_of_one_can_be_kept_out() -> None:
    assert choose(footage([1.0]), 4.0).motion_score == 1.0001


def test_equal_scores_pass_together() -> None:
    assert choose(footage([0.7] * 20), 10.0).motion_score == 0.7001
    assert choose(footage([0.7] * 4 + [0.6] * 3), 10.0).motion_score == 0.6001


def test_alarms_of_one_block_are_one_clump() -> None:
    apart = choose(footage([0.7] * 6), 15.0)
    together = choose(footage([0.7] * 6, [3] * 6), 15.0)
    assert (apart.alarms, apart.clump) == (6, 1.0)
    assert together.clump == pytest.approx(6.0)
    assert not together.promised  # even none of them bounds the rate by 6 * 3 only
    assert together.lowest_bound_per_hour == pytest.approx(6 * -math.log(0.05))
    assert together.hours_needed == pytest.approx(6 * -math.log(0.05) / 15)


def test_the_clump_size_of_equal_blocks_is_variance_over_mean() -> None:
    counts = [3, 0, 0, 5, 1, 0, 0, 0, 4, 2]
    seen = footage([0.7] * sum(counts), list(np.repeat(np.arange(10), counts)), count=10)
    assert choose(seen, 1e9).clump == pytest.approx(np.var(counts, ddof=1) / np.mean(counts))


def test_the_clump_size_of_unequal_blocks_counts_their_length() -> None:
    """As many alarms as each block is long: nothing clumps."""
    seen = ScoredFootage(np.array([1.0, 2.0, 5.0]), np.full(8, 0.7), np.repeat(np.arange(3), [1, 2, 5]))
    assert choose(seen, 1e9).clump == 1.0


def test_one_block_is_one_clump() -> None:
    choice = choose(footage([0.6, 0.7, 0.8], [0, 0, 0], count=1), 1e9)
    assert (choice.alarms, choice.clump) == (3, 3.0)


def test_few_alarms_borrow_the_clump_size_of_a_lower_threshold() -> None:
    blocks = list(np.repeat(np.arange(40), 4))
    clumped = footage([0.6] * 160 + [0.9], [*blocks, 200])
    choice = choose(clumped, 40.0)
    assert choice.alarms == 1
    assert 3.0 < choice.clump < 4.0


# --- footage that is too short


def test_short_footage_promises_nothing_and_says_what_it_can() -> None:
    """Six minutes, budget 25: no alarm promises 30 an hour; two alarms would give 30 to be expected, one 20."""
    choice = choose(footage([0.9, 0.8, 0.7, 0.6], count=36), 25.0)
    assert not choice.promised
    assert choice.alarms == 1
    assert choice.motion_score == 0.8001
    assert choice.expected_per_hour == pytest.approx(20.0)
    assert choice.lowest_bound_per_hour == pytest.approx(-math.log(0.05) / 0.1)
    assert choice.bound_per_hour == pytest.approx(rate_bound(1, 0.1, confidence=0.95))
    assert choice.hours_needed == pytest.approx(-math.log(0.05) / 25.0)


def test_footage_too_short_even_for_the_estimate_takes_the_highest_threshold() -> None:
    choice = choose(footage([0.9, 0.8], count=1, blocks=[0, 0]), 10.0)
    assert (choice.promised, choice.alarms, choice.motion_score) == (False, 0, 0.9001)
    assert choice.expected_per_hour == pytest.approx(360.0)


def test_fewer_hours_than_a_promise_needs_promise_nothing() -> None:
    seen = ScoredFootage(
        np.full(20, BLOCK_HOURS), np.zeros(0), np.zeros(0, np.int64), hours_for_promise=21 * BLOCK_HOURS
    )
    choice = choose(seen, 1000.0)
    assert not choice.promised
    assert choice.hours_needed == pytest.approx(21 * BLOCK_HOURS)
    assert choose(ScoredFootage(np.full(21, BLOCK_HOURS), seen.scores, seen.blocks), 1000.0).promised


# --- the promise


Draw = Callable[[np.random.Generator], tuple[ScoredFootage, Callable[[float], float]]]


def single_alarms(per_hour: float, hours: float) -> Draw:
    """Alarms that come one by one; scores uniform over 0.5 to 1."""
    blocks = max(1, round(hours / BLOCK_HOURS))

    def draw(rng: np.random.Generator) -> tuple[ScoredFootage, Callable[[float], float]]:
        count = rng.poisson(per_hour * blocks * BLOCK_HOURS)
        seen = ScoredFootage(np.full(blocks, BLOCK_HOURS), rng.uniform(0.5, 1.0, count), rng.integers(0, blocks, count))
        return seen, lambda threshold: per_hour * max(0.0, 1.0 - threshold) / 0.5

    return draw


def clumped_alarms(per_hour: float, hours: float, sizes: NDArray[np.int64]) -> Draw:
    """Clumps in one block, of equally likely sizes; the regions of a clump have one score."""
    blocks = max(1, round(hours / BLOCK_HOURS))

    def draw(rng: np.random.Generator) -> tuple[ScoredFootage, Callable[[float], float]]:
        count = rng.poisson(per_hour / sizes.mean() * blocks * BLOCK_HOURS)
        size = rng.choice(sizes, count)
        scores, places = rng.uniform(0.5, 1.0, count), rng.integers(0, blocks, count)
        seen = ScoredFootage(np.full(blocks, BLOCK_HOURS), np.repeat(scores, size), np.repeat(places, size))
        return seen, lambda threshold: per_hour * max(0.0, 1.0 - threshold) / 0.5

    return draw


def broken_promises(draw: Draw, budget_per_hour: float, confidence: float, *, runs: int, seed: int) -> tuple[int, int]:
    """How often footage of the same kind has more alarms than promised, and how often something was promised."""
    rng = np.random.default_rng(seed)
    broken = promised = 0
    for _ in range(runs):
        seen, true_rate = draw(rng)
        choice = choose(seen, budget_per_hour, confidence)
        promised += choice.promised
        broken += choice.promised and true_rate(choice.motion_score) > budget_per_hour
    return broken, promised


def allowed(confidence: float, runs: int) -> float:
    """Four standard deviations over what the confidence allows."""
    share = 1 - confidence
    return runs * share + 4 * math.sqrt(runs * share * confidence)


@settings(max_examples=8)
@given(
    per_hour=st.floats(20, 2000),
    hours=st.floats(0.2, 3),
    budget=st.floats(5, 200),
    confidence=st.sampled_from([0.8, 0.9, 0.95]),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_promise_holds_for_single_alarms(
    per_hour: float, hours: float, budget: float, confidence: float, seed: int
) -> None:
    broken, _ = broken_promises(single_alarms(per_hour, hours), budget, confidence, runs=150, seed=seed)
    assert broken <= allowed(confidence, 150)


@settings(max_examples=6)
@given(
    sizes=st.lists(st.integers(1, 30), min_size=1, max_size=5),
    hours=st.floats(0.5, 3),
    clumps_per_hour=st.floats(50, 400),
    budget_clumps=st.floats(8, 50),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_promise_holds_for_clumps(
    sizes: list[int], hours: float, clumps_per_hour: float, budget_clumps: float, seed: int
) -> None:
    some = np.array(sizes, dtype=np.int64)
    draw = clumped_alarms(clumps_per_hour * float(some.mean()), hours, some)
    broken, _ = broken_promises(draw, budget_clumps * float(some.mean()), 0.9, runs=150, seed=seed)
    assert broken <= allowed(0.9, 150)


def test_single_alarms_are_not_held_back_for_nothing() -> None:
    """The promise is made, and hardly more confidence is bought than was asked for."""
    broken, promised = broken_promises(single_alarms(1000.0, 1.0), 100.0, 0.8, runs=400, seed=5)
    assert promised == 400
    assert broken > 0.1 * 400


def test_ignoring_clumps_would_break_the_promise() -> None:
    """What the blocks are for: the same alarms, each in a block of its own, promise too much."""
    rng, broken = np.random.default_rng(3), 0
    draw = clumped_alarms(1000.0, 1.0, np.array([10]))
    for _ in range(200):
        seen, true_rate = draw(rng)
        apart = ScoredFootage(np.full(5000, 1.0 / 5000), seen.scores, np.arange(seen.scores.size))
        broken += true_rate(choose(apart, 100.0, 0.9).motion_score) > 100.0
    assert broken > allowed(0.9, 200)


def test_the_estimate_is_right_on_average() -> None:
    """(k + 1) / hours for single alarms: the mean rate of what passes the threshold is no more."""
    rng, draw, rates, told = np.random.default_rng(1), single_alarms(600.0, 0.1), [], []
    for _ in range(2000):
        seen, true_rate = draw(rng)
        choice = choose(seen, 25.0, 0.999)
        assert not choice.promised
        rates.append(true_rate(choice.motion_score))
        told.append(choice.expected_per_hour)
    assert np.mean(told) == pytest.approx(20.0, rel=0.01)
    assert np.mean(rates) == pytest.approx(20.0, rel=0.08)
