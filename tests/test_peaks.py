"""Two things in one component are two where the head was less sure between them, and one where that is noise."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.measure import label

from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.peaks import MAX_DIVIDED, divided_at_valleys
from viflow_anomaly.regions import LabelArray

SIDE = 40


def beside(valley: float, *, left: float = 0.99, right: float = 0.99) -> Float32Array:
    """Two things of 20x16 pixels with two columns of ``valley`` between them."""
    motion = np.zeros((SIDE, SIDE), np.float32)
    motion[10:30, 2:19] = left
    motion[10:30, 19:21] = valley
    motion[10:30, 21:38] = right
    return motion


def things_of(motion: Float32Array) -> LabelArray:
    return (motion > 0.5).astype(np.intp)


def test_a_deep_valley_divides() -> None:
    motion = beside(0.65)
    parts = divided_at_valleys(things_of(motion), motion)
    assert set(np.unique(parts)) == {0, 1, 2}
    assert len(set(parts[10:30, 2:19].flat)) == 1
    assert len(set(parts[10:30, 21:38].flat)) == 1
    assert parts[20, 5] != parts[20, 35]
    assert np.array_equal(parts > 0, motion > 0.5)  # the valley's own pixels go to the nearer part


def test_a_shallow_one_does_not() -> None:
    motion = beside(0.96)
    things = things_of(motion)
    assert divided_at_valleys(things, motion) is things


def test_nor_does_one_beside_a_low_peak() -> None:
    """0.75 is hardly more than the level of 0.7 at which it comes off."""
    motion = beside(0.65, right=0.75)
    assert divided_at_valleys(things_of(motion), motion).max() == 1


def test_a_speck_is_no_part() -> None:
    motion = beside(0.65)
    motion[10:30, 21:38] = 0.65
    motion[19:23, 28:32] = 0.999
    assert divided_at_valleys(things_of(motion), motion).max() == 1


def test_three_in_a_row_are_three_though_they_part_at_different_levels() -> None:
    motion = np.full((20, 62), 0.999, np.float32)
    motion[:, 20:22] = 0.65
    motion[:, 41:43] = 0.93
    parts = divided_at_valleys(things_of(motion), motion)
    assert len({int(parts[10, column]) for column in (5, 30, 55)}) == 3


def test_other_things_keep_their_numbers_and_nothing_is_changed_in_place() -> None:
    motion = beside(0.65)
    motion[34:39, 2:38] = 0.9
    things = things_of(motion)
    things[34:39] *= 2
    before = things.copy()
    parts = divided_at_valleys(things, motion)
    assert np.array_equal(things, before)
    assert set(parts[34:39, 2:38].flat) == {2}
    assert set(np.unique(parts)) == {0, 1, 2, 3}


def test_a_picture_full_of_specks_is_left_alone() -> None:
    things = np.kron(np.arange(MAX_DIVIDED + 1, dtype=np.intp) + 1, np.ones((12, 12), dtype=np.intp))
    motion = np.random.default_rng(0).uniform(0.5, 1, things.shape).astype(np.float32)
    assert divided_at_valleys(things, motion) is things


def test_so_many_parts_and_hardly_more() -> None:
    """Eight things of sixteen parts each."""
    one = np.full((100, 100), 0.55, np.float32)
    for row in range(2, 100, 25):
        for column in range(2, 100, 25):
            one[row : row + 21, column : column + 21] = 0.999
    assert divided_at_valleys(things_of(one), one).max() == 16
    motion = np.tile(np.pad(one, 2), (2, 4))
    things = np.asarray(label(motion > 0.5), dtype=np.intp)
    parts = divided_at_valleys(things, motion)
    assert MAX_DIVIDED <= parts.max() < MAX_DIVIDED + 16
    assert np.array_equal(parts > 0, things > 0)


@given(seed=st.integers(0, 2**32 - 1), sigma=st.floats(0.1, 3.0))
@settings(max_examples=40, deadline=None)
def test_no_pixel_is_lost_or_won_and_numbers_have_no_gaps(seed: int, sigma: float) -> None:
    rng = np.random.default_rng(seed)
    logits = np.kron(rng.normal(0, sigma, (6, 6)), np.ones((7, 7))) + rng.normal(0, 0.3, (42, 42))
    motion = (1 / (1 + np.exp(-logits))).astype(np.float32)
    things = things_of(motion)
    parts = divided_at_valleys(things, motion)
    assert np.array_equal(parts > 0, things > 0)
    found = set(np.unique(parts)) - {0}
    assert found == set(range(1, len(found) + 1))
    again = divided_at_valleys(things, motion)
    assert np.array_equal(parts, again)
