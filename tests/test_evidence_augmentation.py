"""A worse camera: drawn once for each recording, the same every time, and within its limits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worlds import in_memory, make_world

from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.evaluation.perturbed_pairs import unperturbed
from viflow_anomaly.evidence_augmentation import NO_AUGMENT, Augment, bend_lens, change_contrast
from viflow_anomaly.sensor_data import FramePair


@pytest.fixture
def pair(tmp_path: Path) -> FramePair:
    return RecordingPairs(in_memory(make_world(frames=2), tmp_path))[0]


def test_a_recording_has_its_own_camera_every_time(pair: FramePair) -> None:
    first, again, other = (Augment(0, 1.0).of(name)(pair) for name in ("a", "a", "b"))
    np.testing.assert_array_equal(first.source.image, again.source.image)
    np.testing.assert_array_equal(first.imu.timestamps_ns, again.imu.timestamps_ns)
    assert not np.array_equal(first.source.image, other.source.image)


def test_as_many_are_perturbed_as_asked_for() -> None:
    assert all(NO_AUGMENT.of(f"r{k}") is unperturbed for k in range(50))
    touched = sum(Augment(1, 0.6).of(f"r{k}") is not unperturbed for k in range(500))
    assert 250 < touched < 350


def test_as_many_are_at_their_own_size_as_asked_for() -> None:
    draws = [Augment(1, 0.6, 0.5).at_own_size(f"r{k}") for k in range(500)]
    assert 200 < sum(draws) < 300
    assert draws == [Augment(1, 0.0, 0.5).at_own_size(f"r{k}") for k in range(500)]
    assert not any(Augment(1, 0.6).at_own_size(f"r{k}") for k in range(50))


def test_contrast_spreads_both_images_alike(pair: FramePair) -> None:
    spread = change_contrast(pair, factor=2.0, pivot_gray=0.0)
    pivot = float(pair.source.image.mean())
    for before, after in ((pair.source, spread.source), (pair.target, spread.target)):
        expected = np.clip(np.rint((before.image - pivot) * 2.0 + pivot), 0, 255)
        np.testing.assert_array_equal(after.image, expected)


def test_a_lens_bends_the_corners_and_leaves_the_middle(pair: FramePair) -> None:
    bent = bend_lens(pair, by=0.01)
    height, width = pair.source.image.shape
    middle = (slice(height // 2 - 2, height // 2 + 2), slice(width // 2 - 2, width // 2 + 2))
    difference = np.abs(bent.source.image.astype(int) - pair.source.image)
    assert difference[middle].max() <= 2
    assert difference[:8, :8].mean() > difference[middle].mean()
    assert bent.source.timestamp_ns == pair.source.timestamp_ns
    grid = np.add.outer(np.arange(height), np.arange(width)).astype(np.uint8)  # a pixel further along x is one brighter
    ramp = replace(pair, source=replace(pair.source, image=np.broadcast_to(grid[0] // 2, (height, width)).copy()))
    diagonal = float(np.hypot(width - 1, height - 1))
    expected = -0.01 * diagonal * (width - 1) / diagonal / 2  # outwards, along x alone, half a gray level a pixel
    seen = bend_lens(ramp, by=-0.01).source.image.astype(float) - ramp.source.image
    assert seen[0, 0] == pytest.approx(-expected, abs=1.0)
    same = bend_lens(pair, by=0.0)
    np.testing.assert_array_equal(same.target.image, pair.target.image)
