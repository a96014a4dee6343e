"""Maps as pictures: fixed scales, directions that can be told apart, nothing invented where nothing is known."""

from __future__ import annotations

import numpy as np

from viflow_anomaly.heat_maps import UNKNOWN_GRAY, draw_evidence, draw_flow, draw_residual


def test_residuals_of_two_pictures_can_be_compared() -> None:
    faint, strong = (draw_residual(np.full((4, 6), gray, np.float32)) for gray in (8.0, 80.0))
    assert faint.shape == (4, 6, 3)
    assert faint.sum() < strong.sum()
    assert np.array_equal(strong, draw_residual(np.full((4, 6), 200.0, np.float32)))
    assert np.array_equal(
        draw_residual(np.full((4, 6), np.nan, np.float32)), draw_residual(np.zeros((4, 6), np.float32))
    )


def test_evidence_is_shown_in_its_own_unit() -> None:
    one = np.ones((2, 2), np.float32)
    assert np.array_equal(draw_evidence(one, learned=True), draw_evidence(80 * one, learned=False))
    assert not np.array_equal(draw_evidence(one, learned=True), draw_evidence(one, learned=False))


def test_a_flow_says_its_direction_and_where_it_is_not_known() -> None:
    flow = np.zeros((2, 3, 2), np.float32)
    flow[0, 0] = (5, 0)
    flow[0, 1] = (-5, 0)
    flow[0, 2] = (np.nan, 0)
    picture = draw_flow(flow)
    right, left, unknown = picture[0].tolist()
    assert right[2] > right[0]  # red
    assert left[0] > left[2]
    assert unknown == [UNKNOWN_GRAY] * 3
    assert picture[1].tolist() == [[255, 255, 255]] * 3
    assert (draw_flow(np.full((2, 2, 2), np.inf, np.float32)) == UNKNOWN_GRAY).all()
