"""Pixels, whose figures are shares of areas."""

from __future__ import annotations

import numpy as np
import pytest

from viflow_anomaly.evaluation.labelled_pairs import Pixels
from viflow_anomaly.evaluation.pixel_scores import MaskScores, PixelScores

SHAPE = (40, 60)
MOVING_PX = 100
INSIDE = np.ones(SHAPE, np.bool_)


def truth() -> Pixels:
    moving, ignored = np.zeros(SHAPE, np.bool_), np.zeros(SHAPE, np.bool_)
    moving[:10, :10] = True
    ignored[:10, 20:30] = True
    return Pixels(moving, ignored)


def scored(evidence: np.ndarray, inside: np.ndarray = INSIDE) -> PixelScores:
    scores = PixelScores()
    scores.add(evidence.astype(np.float32), inside, truth())
    return scores


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_perfect_evidence_in_any_unit(unit: float) -> None:
    scores = scored(unit * (truth().moving + 0.9 * truth().ignored))
    assert scores.average_precision() == pytest.approx(1.0)
    assert scores.best_iou() == pytest.approx(1.0)


def test_blind_evidence_has_the_share_of_what_moves() -> None:
    scores = scored(np.zeros(SHAPE))
    share = MOVING_PX / (40 * 60 - 100)
    assert scores.average_precision() == pytest.approx(share)
    assert scores.best_iou() == pytest.approx(share)


def test_evidence_on_half_of_the_mover_and_as_much_beside_it() -> None:
    evidence = np.zeros(SHAPE)
    evidence[:5, :10] = 1.0
    evidence[20:30, 20:25] = 1.0
    scores = scored(evidence)
    static_px = 40 * 60 - 100 - MOVING_PX
    rest = MOVING_PX / (MOVING_PX + static_px)
    assert scores.average_precision() == pytest.approx(0.5 * 0.5 + 0.5 * rest)
    assert scores.best_iou() == pytest.approx(50 / 150)


def test_what_left_the_image_does_not_count() -> None:
    scores = scored(truth().moving, ~truth().moving)
    assert (scores.average_precision(), scores.best_iou()) == (None, None)
    assert scored(-np.zeros(SHAPE)).average_precision() == scored(np.zeros(SHAPE)).average_precision()


def test_values_two_percent_apart_are_told_apart() -> None:
    for value in (1e-6, 0.3, 7.0, 255.0, 3e5):
        evidence = np.where(truth().moving, 1.02 * value, value)
        assert scored(evidence).average_precision() == pytest.approx(1.0)


def test_masks_at_the_operating_point() -> None:
    scores = MaskScores()
    assert scores.iou() is None
    found = np.zeros(SHAPE, np.bool_)
    found[:10, 5:25] = True  # 50 of the mover, 100 beside it, 50 ignored
    scores.add(found, INSIDE, truth())
    assert scores.iou() == pytest.approx(50 / 200)
    scores.merge(scores)
    assert scores.iou() == pytest.approx(50 / 200)


def test_parts_add_up() -> None:
    evidence = np.random.default_rng(0).random(SHAPE)
    twice = scored(evidence)
    twice.merge(scored(evidence))
    assert twice.frames == 2
    assert twice.average_precision() == pytest.approx(scored(evidence).average_precision() or 0)
