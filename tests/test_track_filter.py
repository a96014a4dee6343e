"""The filter in closed form: exact motion is followed exactly, doubt grows with time and shrinks with sightings."""

from __future__ import annotations

import math

import numpy as np
import pytest

from viflow_anomaly.regions import BoundingBox
from viflow_anomaly.track_filter import BoxNoise, BoxState, Channel, measure

NOISE = BoxNoise(
    center_sigma=0.1,
    log_side_sigma=0.2,
    own_speed_px_s=100.0,
    growth_s=0.5,
    acceleration_px_s=40.0,
    growth_change_s=0.3,
)


def test_a_channel_is_the_textbooks_filter() -> None:
    dt, shift, density, measured, variance = 0.1, 3.0, 7.0, 9.0, 0.5
    channel = Channel(4.0, 2.0, 1.5, 0.4, 6.0)
    F = np.array([[1.0, dt], [0.0, 1.0]])
    P = np.array([[1.5, 0.4], [0.4, 6.0]])
    Q = density * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    x, P = F @ (4.0, 2.0) + (shift, 0.0), F @ P @ F.T + Q
    carried = channel.predicted(dt, shift, density)
    np.testing.assert_allclose(carried, [*x, P[0, 0], P[0, 1], P[1, 1]])
    K = P[:, 0] / (P[0, 0] + variance)
    x, P = x + K * (measured - x[0]), P - np.outer(K, P[0])
    np.testing.assert_allclose(carried.updated(measured, variance), [*x, P[0, 0], P[0, 1], P[1, 1]])


def test_a_new_box_is_where_it_was_measured_and_at_rest() -> None:
    state = BoxState.seen_first(BoundingBox(10, 20, 8, 5), NOISE)
    assert state.center_px == (13.5, 22.0)
    assert state.own_velocity_px_s == (0.0, 0.0)
    assert (state.log_width.value, state.log_height.value) == (math.log(8), math.log(5))
    assert state.u.value_variance == pytest.approx(0.8**2)
    assert state.v.value_variance == pytest.approx(0.5**2)
    assert state.u.rate_variance == 100.0**2
    assert state.log_width.rate_variance == 0.5**2


def test_a_box_that_rests_in_the_world_goes_where_the_world_goes_and_gains_no_speed() -> None:
    state = BoxState.seen_first(BoundingBox(100, 50, 20, 20), NOISE)
    for step in range(1, 6):
        state = state.predicted(0.05, (-7.0, 3.0), NOISE)
        state = state.updated(measure(BoundingBox(100 - 7 * step, 50 + 3 * step, 20, 20), NOISE))
    assert state.center_px == pytest.approx((109.5 - 35, 59.5 + 15))
    assert state.own_velocity_px_s == pytest.approx((0.0, 0.0), abs=1e-9)


def test_own_speed_is_found_beside_the_worlds() -> None:
    state = BoxState.seen_first(BoundingBox(100, 50, 20, 20), NOISE)
    for step in range(1, 20):  # the world goes 7 px to the left, the box 3 px to the right
        state = state.predicted(0.05, (-7.0, 0.0), NOISE)
        state = state.updated(measure(BoundingBox(100 + 3 * step, 50, 20, 20), NOISE))
    assert state.own_velocity_px_s == pytest.approx((200.0, 0.0), abs=2.0)
    assert state.predicted(0.05, (-7.0, 0.0), NOISE).center_px[0] == pytest.approx(109.5 + 60, abs=0.3)


def test_doubt_grows_unseen_and_shrinks_when_seen() -> None:
    first = BoxState.seen_first(BoundingBox(100, 50, 20, 20), NOISE)
    unseen = first.predicted(0.05, (0.0, 0.0), NOISE)
    longer = unseen.predicted(0.05, (0.0, 0.0), NOISE)
    seen = unseen.updated(measure(BoundingBox(100, 50, 20, 20), NOISE))
    for before, after, much_after, corrected in zip(first, unseen, longer, seen, strict=True):
        assert before.value_variance < after.value_variance < much_after.value_variance
        assert corrected.value_variance < before.value_variance
        assert corrected.rate_variance < after.rate_variance


def test_two_short_steps_are_one_long_one() -> None:
    state = BoxState.seen_first(BoundingBox(100, 50, 20, 20), NOISE)._replace(u=Channel(5.0, 2.0, 1.0, 0.2, 3.0))
    once = state.predicted(0.1, (4.0, -2.0), NOISE)
    twice = state.predicted(0.04, (1.0, -1.0), NOISE).predicted(0.06, (3.0, -1.0), NOISE)
    for one, two in zip(once, twice, strict=True):
        assert two == pytest.approx(one)
