"""The measured flow on shifts whose answer is known, and how far it trusts itself."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import textured_image

from viflow_anomaly.measured_flow import measure_flow
from viflow_anomaly.sensor_data import Uint8Array


def windows(du: int, dv: int, *, height: int = 96, width: int = 128) -> tuple[Uint8Array, Uint8Array]:
    texture = textured_image(width + 32, height + 32, seed=3)
    source, target = texture[16 : 16 + height, 16 : 16 + width], texture[16 - dv :, 16 - du :][:height, :width]
    return np.ascontiguousarray(source), np.ascontiguousarray(target)


@pytest.mark.parametrize("stride", [1, 4])
@pytest.mark.parametrize(("du", "dv"), [(0, 0), (3, 0), (-2, 4), (7, -5)])
def test_a_shift_is_measured(du: int, dv: int, stride: int) -> None:
    measured = measure_flow(*windows(du, dv), stride=stride)
    assert measured.flow_px.shape == (96 // stride, 128 // stride, 2)
    assert measured.stride == stride
    middle = (slice(24 // stride, 72 // stride), slice(24 // stride, 104 // stride))
    np.testing.assert_allclose(np.median(measured.flow_px[middle], axis=(0, 1)), (du, dv), atol=0.15)
    assert measured.confidence[middle].mean() > 0.5


def test_a_plain_surface_and_a_straight_edge_are_not_trusted() -> None:
    edge = np.full((96, 128), 60, np.uint8)
    edge[:, 64:] = 200
    confidence = measure_flow(edge, edge, stride=4).confidence
    assert confidence.max() < 0.05


def test_what_does_not_match_is_not_trusted() -> None:
    source, target = windows(2, 0)
    other = textured_image(128, 96, seed=9)
    mixed = np.where(np.arange(128) < 64, target, other).astype(np.uint8)
    confidence = measure_flow(source, mixed, stride=4).confidence
    assert confidence[:, 18:].mean() < 0.4 * confidence[:, :14].mean()


@pytest.mark.parametrize(("height", "width"), [(31, 64), (64, 31), (1, 1), (8, 8)])
def test_a_view_too_small_to_measure_says_so(height: int, width: int) -> None:
    image = textured_image(64, 64, seed=1)[:height, :width].copy()
    measured = measure_flow(image, image, stride=1)
    assert measured.flow_px.shape == (height, width, 2)
    assert not measured.confidence.any()
