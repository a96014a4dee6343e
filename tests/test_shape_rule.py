"""The shape rules on masks whose sides are known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from viflow_anomaly.config import RegionConfig, ShapeRuleName
from viflow_anomaly.regions import find_regions
from viflow_anomaly.shape_rule import Shape, ShapeLimits, judge_shape, oriented_sides_px, thickness_px

LIMITS = ShapeLimits(min_x_px=6.0, min_y_px=8.0, max_aspect_ratio=5.0)


def diagonal(length: int = 40, width: int = 3) -> NDArray[np.bool_]:
    y, x = np.mgrid[:length, :length]
    return np.asarray(np.abs(x - y) < width)


def judged(rule: ShapeRuleName, mask: NDArray[np.bool_]) -> Shape:
    return judge_shape(rule, mask, thickness_px(mask), LIMITS)


@pytest.mark.parametrize("rule", ["axis_aligned", "oriented", "thickness", "none"])
def test_a_square_passes_every_rule(rule: ShapeRuleName) -> None:
    shape = judged(rule, np.ones((20, 20), np.bool_))
    assert shape.passes
    assert shape.nearness_to_band == pytest.approx({"axis_aligned": 8 / 20, "none": 0.0}.get(rule, 6 / 20), abs=0.02)


@pytest.mark.parametrize(
    ("rule", "verdict"),
    [
        ("axis_aligned", "extended_in_x_and_y"),  # the paper's rule sees a box of 40 by 40
        ("oriented", "narrow_across"),
        ("thickness", "narrow_across"),
        ("none", "shape_not_judged"),
    ],
)
def test_a_diagonal_band(rule: ShapeRuleName, verdict: str) -> None:
    assert judged(rule, diagonal()).verdict == verdict


@pytest.mark.parametrize("rule", ["axis_aligned", "oriented", "thickness"])
@pytest.mark.parametrize("transposed", [False, True])
def test_an_upright_band_fails_every_rule_but_none(rule: ShapeRuleName, transposed: bool) -> None:
    band = np.ones((4, 60), np.bool_)
    band = band.T if transposed else band
    assert not judged(rule, band).passes
    assert judged("none", band).passes


def test_a_ring_is_thin_but_extended() -> None:
    y, x = np.mgrid[-20:21, -20:21]
    ring = np.abs(np.hypot(x, y) - 18) < 2
    assert judged("oriented", ring).passes
    assert judged("thickness", ring).verdict == "narrow_across"


def test_sides_of_the_turned_rectangle() -> None:
    assert oriented_sides_px(np.ones((4, 9), np.bool_)) == (9.0, 4.0)
    assert oriented_sides_px(np.ones((1, 1), np.bool_)) == (1.0, 1.0)
    long_px, short_px = oriented_sides_px(diagonal(41, 1))
    assert long_px == pytest.approx(1 + 40 * np.sqrt(2), abs=0.1)
    assert short_px == pytest.approx(1.0, abs=0.1)


def test_regions_follow_the_configured_rule() -> None:
    evidence = np.zeros((80, 80), np.float32)
    evidence[20:60, 20:60][diagonal()] = 60
    config = RegionConfig(smoothing_fraction=0, opening_fraction=0, closing_fraction=0, min_area_fraction=0)
    inside = np.ones(evidence.shape, np.bool_)
    labels = {}
    for rule in ("axis_aligned", "oriented", "thickness", "none"):
        (region,) = find_regions(evidence, inside, config.model_copy(update={"shape_rule": rule})).regions
        labels[rule] = region.label
        assert (region.score >= 0.5) == (region.label == "independent_motion")
    motion, error = "independent_motion", "model_error"
    assert labels == {"axis_aligned": motion, "oriented": error, "thickness": error, "none": motion}
