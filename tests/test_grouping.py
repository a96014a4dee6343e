"""Things that touch are told apart by their votes; one thing stays one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.grouping import middles_of, things_of_pixels

SHAPE = (64, 128)


def offsets_of(*boxes: tuple[int, int, int, int], noise: float = 0.0, seed: int = 0) -> Float32Array:
    """Blocks' exact offsets to the middles of boxes (x, y, width, height in pixels), and what a head gets wrong."""
    rows, columns = np.mgrid[0 : SHAPE[0] // 4, 0 : SHAPE[1] // 4].astype(np.float32)
    offsets = np.zeros((2, *rows.shape), np.float32)
    for x, y, width, height in boxes:
        mine = (columns >= x // 4) & (columns < (x + width) // 4) & (rows >= y // 4) & (rows < (y + height) // 4)
        offsets[0][mine] = (y + height / 2) / 4 - 0.5 - rows[mine]
        offsets[1][mine] = (x + width / 2) / 4 - 0.5 - columns[mine]
    return offsets + np.random.default_rng(seed).normal(0, noise, offsets.shape).astype(np.float32)


def components_of(*boxes: tuple[int, int, int, int]) -> np.ndarray:
    labels = np.zeros(SHAPE, np.intp)
    for x, y, width, height in boxes:
        labels[y : y + height, x : x + width] = 1
    return labels


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_two_that_touch_are_two(noise: float) -> None:
    boxes = (16, 16, 32, 32), (48, 16, 32, 32)
    things = things_of_pixels(components_of(*boxes), offsets_of(*boxes, noise=noise), (0, 0))
    assert set(np.unique(things)) == {0, 1, 2}
    left, right = things[16:48, 16:48], things[16:48, 48:80]
    for half in (left, right):
        assert np.bincount(half.ravel()).max() > 0.97 * half.size
    assert np.bincount(left.ravel()).argmax() != np.bincount(right.ravel()).argmax()


@given(st.integers(0, 1000), st.integers(2, 14), st.integers(2, 8))
def test_one_thing_stays_one(seed: int, columns: int, rows: int) -> None:
    box = (8, 8, 4 * columns, 4 * rows)
    things = things_of_pixels(components_of(box), offsets_of(box, noise=0.3, seed=seed), (0, 0))
    assert set(np.unique(things)) == {0, 1}


def test_a_cut_out_knows_where_it_is() -> None:
    boxes = (16, 16, 32, 32), (48, 16, 32, 32)
    whole = things_of_pixels(components_of(*boxes), offsets_of(*boxes), (0, 0))
    part = things_of_pixels(components_of(*boxes)[13:50, 15:90], offsets_of(*boxes), (13, 15))
    np.testing.assert_array_equal(whole[13:50, 15:90], part)


def test_every_pixel_of_a_component_belongs_to_a_thing() -> None:
    rng = np.random.default_rng(1)
    labels = np.where(rng.random(SHAPE) < 0.5, rng.integers(1, 4, SHAPE), 0)
    offsets = rng.normal(0, 20, (2, SHAPE[0] // 4, SHAPE[1] // 4)).astype(np.float32)
    things = things_of_pixels(labels, offsets, (0, 0))
    np.testing.assert_array_equal(things > 0, labels > 0)
    for thing in range(1, things.max() + 1):
        assert len(np.unique(labels[things == thing])) == 1


def test_votes_without_a_middle_are_one_thing() -> None:
    scattered = np.random.default_rng(0).uniform(0, 500, (40, 2))
    assert middles_of(scattered).shape == (1, 2)
