"""Pixel centres lie at integer coordinates: an integer shift is exact, half a pixel is the mean of two."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import textured_image

from viflow_anomaly.errors import TooLargeError
from viflow_anomaly.geometry import pixel_grid
from viflow_anomaly.residual import (
    compensate_exposure,
    half_range_gray,
    photometric_residual,
    reconstruct,
    texture_normalised,
)

H, W = 40, 56
IMAGE = textured_image(W, H)


def test_identity_reconstructs_every_pixel_exactly() -> None:
    reconstruction, inside = reconstruct(IMAGE, pixel_grid(H, W))
    assert reconstruction.dtype == np.float32
    np.testing.assert_array_equal(reconstruction, IMAGE)
    assert inside.all()
    assert not photometric_residual(IMAGE, reconstruction, inside).any()


@pytest.mark.parametrize(("du", "dv"), [(3, 0), (0, -2), (-4, 5)])
def test_an_integer_shift_is_exact(du: int, dv: int) -> None:
    target = np.roll(IMAGE, (dv, du), axis=(0, 1))
    reconstruction, inside = reconstruct(target, pixel_grid(H, W) + np.float32([du, dv]))
    u, v = np.meshgrid(np.arange(W) + du, np.arange(H) + dv)
    np.testing.assert_array_equal(inside, (u >= 0) & (u < W) & (v >= 0) & (v < H))
    np.testing.assert_array_equal(reconstruction[inside], IMAGE[inside])
    assert not photometric_residual(IMAGE, reconstruction, inside).any()


def test_half_a_pixel_is_the_mean_of_two() -> None:
    reconstruction, inside = reconstruct(IMAGE, pixel_grid(H, W) + np.float32([0.5, 0.0]))
    expected = 0.5 * (IMAGE[:, :-1].astype(np.float64) + IMAGE[:, 1:])
    np.testing.assert_allclose(reconstruction[:, :-1], expected, atol=1e-3)
    assert not inside[:, -1].any()


def test_the_source_may_have_another_size_than_the_target() -> None:
    reconstruction, inside = reconstruct(IMAGE, pixel_grid(H // 2, W // 2) * 2)
    np.testing.assert_array_equal(reconstruction, IMAGE[::2, ::2])
    assert inside.all()


@pytest.mark.parametrize("coordinate", [np.nan, np.inf, -np.inf, 1e30, -1e30, -0.01, W - 0.99])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_coordinate_beyond_the_image_is_outside(coordinate: float, axis: int) -> None:
    coordinates = pixel_grid(H, W)
    coordinates[7, 9, axis] = coordinate
    reconstruction, inside = reconstruct(IMAGE, coordinates)
    residual = photometric_residual(IMAGE, reconstruction, inside)
    assert not inside[7, 9]
    assert np.count_nonzero(~inside) == 1
    assert np.isfinite(reconstruction).all()
    assert residual[7, 9] == 0


def test_residual_is_the_absolute_difference_inside() -> None:
    inside = np.ones((H, W), dtype=np.bool_)
    inside[:, :5] = False
    residual = photometric_residual(IMAGE, np.full((H, W), 100.0, dtype=np.float32), inside)
    np.testing.assert_array_equal(residual[:, 5:], np.abs(IMAGE[:, 5:].astype(np.float32) - 100.0))
    assert not residual[:, :5].any()
    assert residual.dtype == np.float32


@pytest.mark.parametrize(
    ("target_shape", "source_shape"),
    [((32768, 1), (2, 2)), ((1, 32768), (2, 2)), ((2, 2), (32768, 1)), ((2, 2), (1, 32768))],
)
def test_sides_beyond_what_opencv_can_address(target_shape: tuple[int, int], source_shape: tuple[int, int]) -> None:
    with pytest.raises(TooLargeError, match="32767") as caught:
        reconstruct(np.zeros(target_shape, np.uint8), np.zeros((*source_shape, 2), np.float32))
    assert caught.value.code == "image_too_large"


# --- normalised by texture


def test_a_flat_picture_doubles_the_residual_and_a_strong_edge_lowers_it() -> None:
    source = np.full((9, 12), 50, np.uint8)
    source[:, 6:] = 250
    residual = np.full((9, 12), 20.0, np.float32)
    evidence = texture_normalised(residual, half_range_gray(source), 10.0)
    np.testing.assert_allclose(evidence[:, :5], 40.0)
    np.testing.assert_allclose(evidence[:, 5:7], 20.0 / (200 * 0.5 / 20 + 0.5))
    np.testing.assert_allclose(evidence[:, 7:], 40.0)


def test_at_twice_the_softening_the_residual_stays() -> None:
    source = np.zeros((8, 8), np.uint8)
    source[:, ::2] = 20
    np.testing.assert_allclose(texture_normalised(np.full((8, 8), 7.0, np.float32), half_range_gray(source), 10.0), 7.0)


def test_without_softening_it_is_the_papers_residual() -> None:
    residual = np.random.default_rng(0).random((H, W), dtype=np.float32)
    assert texture_normalised(residual, half_range_gray(IMAGE), 0.0) is residual


def test_a_misplaced_picture_leaves_less_evidence_than_something_new() -> None:
    shifted = np.abs(np.roll(IMAGE, 1, axis=1).astype(np.float32) - IMAGE)
    evidence = texture_normalised(shifted, half_range_gray(IMAGE), 10.0)
    flat = texture_normalised(shifted, half_range_gray(np.full_like(IMAGE, 128)), 10.0)
    assert evidence.mean() < 0.7 * flat.mean()


def test_a_change_of_exposure_is_undone_and_a_mover_is_not() -> None:
    source = textured_image(120, 90, seed=3)
    reconstruction = (source.astype(np.float32) - 12) / 1.25
    reconstruction[30:50, 40:60] += 60
    inside = np.ones(source.shape, np.bool_)
    inside[:, :10] = False
    compensated = compensate_exposure(reconstruction, source, inside)
    error = np.abs(compensated - source)
    rest = inside.copy()
    rest[30:50, 40:60] = False
    assert error[rest].max() < 1.0
    np.testing.assert_allclose(error[30:50, 40:60], 75, atol=1.0)
    np.testing.assert_array_equal(compensated[:, :10], reconstruction[:, :10])


def test_an_unchanged_exposure_stays() -> None:
    source = textured_image(120, 90, seed=3)
    same = compensate_exposure(source.astype(np.float32), source, np.ones(source.shape, np.bool_))
    np.testing.assert_allclose(same, source, atol=1e-3)


def test_nothing_is_compensated_where_nothing_can_be_told() -> None:
    source = textured_image(120, 90, seed=3)
    faint = source.astype(np.float32) / 4  # a gain of 4 is no exposure
    few = np.zeros(source.shape, np.bool_)
    few[:5, :5] = True
    assert compensate_exposure(faint, source, np.ones(source.shape, np.bool_)) is faint
    assert compensate_exposure(faint, source, few) is faint
