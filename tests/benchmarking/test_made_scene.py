from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from worlds import in_memory, make_world

from viflow_anomaly.benchmarking.made_scene import (
    FRAME_INTERVAL_NS,
    YAW_RATE_RAD_S,
    make_camera,
    make_images,
    make_pair,
    make_recording,
    repeated,
)
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.detector import AnomalyDetector


@pytest.mark.parametrize(("width", "height"), [(64, 64), (224, 224), (320, 200)])
def test_a_pair_has_the_size_that_is_asked_for_and_is_the_same_every_time(width: int, height: int) -> None:
    pair, again = make_pair(width, height), make_pair(width, height)
    assert pair.source.image.shape == pair.target.image.shape == (height, width)
    np.testing.assert_array_equal(pair.target.image, again.target.image)
    assert pair.imu.gyro_rad_s[:, 1].mean() == pytest.approx(YAW_RATE_RAD_S, abs=1e-3)


def test_the_world_shifts_as_the_gyro_says() -> None:
    """In the middle of the image, where a turn is a shift by f * angle."""
    camera = make_camera(256, 128)
    first, later = make_images(9, camera, patches=0, seed=0)[::8]
    shift_px = camera.fx * YAW_RATE_RAD_S * 8 * FRAME_INTERVAL_NS * 1e-9
    whole = round(shift_px)
    moved = np.abs(later[:, : 256 - whole].astype(float) - first[:, whole:]).mean()
    still = np.abs(later.astype(float) - first).mean()
    assert moved < 0.2 * still


def test_patches_are_what_moves() -> None:
    detector = AnomalyDetector.from_checkpoint(threads=1)
    found = [detector.detect(make_pair(224, 224, patches=patches)) for patches in (0, 3)]
    assert [(one.status, one.reasons) for one in found] == [("ok", ()), ("ok", ())]
    assert [len(one.rois) for one in found] == [0, 3]


def test_a_recording_turns_back_and_forth_over_few_images(tmp_path: Path) -> None:
    recording = make_recording(tmp_path / "frames", 20, 96, 64, distinct=4)
    assert len(recording) == 20
    assert len(set(recording.frame_paths)) == 4
    shown = [int(path.stem) for path in recording.frame_paths[:8]]
    assert shown == [0, 1, 2, 3, 2, 1, 0, 1]
    turns = [pair.imu.gyro_rad_s[len(pair.imu.gyro_rad_s) // 2, 1] for pair in RecordingPairs(recording)[:6]]
    assert [turn > 0 for turn in turns] == [True, True, True, False, False, False]


@pytest.mark.parametrize("frames", [3, 4, 10, 12])
def test_a_repeated_recording_gives_the_same_pairs_again(tmp_path: Path, frames: int) -> None:
    once = in_memory(make_world(frames=4), tmp_path / "frames")
    again = repeated(once, frames)
    pairs = RecordingPairs(again)
    assert len(again) == frames
    assert (np.diff(again.frame_timestamps_ns) == np.diff(once.frame_timestamps_ns)[0]).all()
    assert (np.diff(again.imu.timestamps_ns) > 0).all()
    for k in range(len(pairs)):
        if k % 4 < 3:
            pair, same = pairs[k], RecordingPairs(once)[k % 4]
            np.testing.assert_array_equal(pair.target.image, same.target.image)
            assert pair.interval_ns == same.interval_ns
