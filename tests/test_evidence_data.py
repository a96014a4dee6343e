"""Examples for the evidence head: what is true of a pixel, what is kept on disk, what a crop is."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evidence_world import SMALL, recording
from simulated_truth import add_ground_truth, add_movers
from worlds import make_world

from viflow_anomaly.config import CorrectionConfig, DetectorConfig
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.evidence_augmentation import Augment
from viflow_anomaly.evidence_cues import GEOMETRIC_CUES
from viflow_anomaly.evidence_data import (
    ACROSS,
    EvidenceData,
    Examples,
    extract_examples,
    kept_examples,
    load_examples,
)
from viflow_anomaly.evidence_truth import IGNORED, MOVING, SIZE_SHIFT, offsets_of


@pytest.fixture(scope="module")
def detector() -> AnomalyDetector:
    return AnomalyDetector.from_checkpoint(with_evidence=False)


def test_a_mirrored_thing_has_mirrored_offsets() -> None:
    instances = np.zeros((32, 64), np.uint8)
    instances[4:12, 10:42] = 1  # not on the blocks' borders
    blocks, nothing = (8, 16), np.full((1, 3, 32, 64), 128, np.uint8)
    geometric = np.full((1, len(GEOMETRIC_CUES), *blocks), 128, np.uint8)
    truth = np.where(instances, MOVING, 0).astype(np.uint8)[None]
    data = EvidenceData([Examples(nothing, geometric, truth, offsets_of(instances, blocks)[None])], SMALL)
    rows, columns = np.mgrid[0:8, 0:16]
    for step in range(12):
        batch = data.sample(step)
        for truth_of_crop, offsets in zip(batch.truth, batch.offsets, strict=True):
            y, x = np.nonzero(truth_of_crop)
            moving = (truth_of_crop.reshape(8, 4, 16, 4)[:, 1:3, :, 1:3] != 0).all(axis=(1, 3))
            votes = np.stack([rows + offsets[0], columns + offsets[1]])[:, moving]
            middle = np.array([(y.mean() + 0.5) / 4 - 0.5, (x.mean() + 0.5) / 4 - 0.5])
            assert np.abs(votes - middle[:, None]).max() <= 0.5


def test_examples_are_seen_through_the_recordings_own_camera(tmp_path: Path, detector: AnomalyDetector) -> None:
    path = recording(tmp_path / "drone_1")
    plain, worse = (kept_examples(detector, path, tmp_path / "cues", augment=Augment(3, share)) for share in (0.0, 1.0))
    assert not np.array_equal(plain.photometric, worse.photometric)
    again = kept_examples(detector, path, tmp_path / "cues", augment=Augment(3, 1.0))
    np.testing.assert_array_equal(worse.photometric, again.photometric)
    np.testing.assert_array_equal(plain.offsets, worse.offsets)


def test_examples_are_bytes_of_the_detectors_cues(tmp_path: Path, detector: AnomalyDetector) -> None:
    examples = extract_examples(detector, recording(tmp_path / "drone_1"))
    count, height, width = examples.truth.shape
    assert (count, height % 32, width % 32) == (2, 0, 0)
    assert examples.photometric.shape == (2, 3, height, width)
    assert examples.geometric.shape == (2, len(GEOMETRIC_CUES), height // 4, width // 4)
    assert (examples.truth & MOVING).any()


def test_a_large_picture_is_seen_at_the_size_it_is_judged_at(tmp_path: Path, detector: AnomalyDetector) -> None:
    world = make_world(frames=2, width=416, height=352)
    world = replace(world, camera=replace(world.camera, fx=320.0, fy=320.0))
    path = add_movers(add_ground_truth(tmp_path / "large", world), times=4)
    small = extract_examples(detector.with_config(DetectorConfig(internal_short_side_px=176)), path)
    own = extract_examples(detector.with_config(DetectorConfig(internal_short_side_px=0)), path)
    assert (small.truth.shape, own.truth.shape) == ((1, 192, 224), (1, 352, 416))
    np.testing.assert_array_equal(small.truth[0, 20:40, 60:88] & MOVING, own.truth[0, 41:81:2, 121:177:2] & MOVING)
    assert (small.truth[0, 25, 70] >> SIZE_SHIFT, own.truth[0, 51, 141] >> SIZE_SHIFT) == (9, 11)
    np.testing.assert_array_equal(small.truth[0, 176:], IGNORED)  # beyond the picture
    kept = tmp_path / "cues"
    large = detector.with_config(DetectorConfig(internal_short_side_px=176))
    for share, height in ((0.0, 192), (1.0, 352)):
        assert kept_examples(large, path, kept, augment=Augment(3, 0.0, share)).truth.shape[1] == height


def test_what_was_kept_is_read_as_long_as_it_would_be_the_same(tmp_path: Path, detector: AnomalyDetector) -> None:
    path, kept = recording(tmp_path / "drone_1"), tmp_path / "cues"
    first = kept_examples(detector, path, kept)
    file = kept / "drone_1.npz"
    before = file.stat().st_mtime_ns
    again = kept_examples(detector, path, kept)
    assert file.stat().st_mtime_ns == before
    np.testing.assert_array_equal(first.geometric, again.geometric)
    other = detector.with_config(DetectorConfig(correction=CorrectionConfig(depth_rounds=0)))
    kept_examples(other, path, kept)
    assert file.stat().st_mtime_ns != before
    assert [one.name for one in kept.iterdir()] == ["drone_1.npz"]


def test_another_recording_of_the_same_name_is_read(tmp_path: Path, detector: AnomalyDetector) -> None:
    one, two = recording(tmp_path / "a" / "drone_1"), recording(tmp_path / "b" / "drone_1", frames=4)
    assert [len(kept_examples(detector, path, tmp_path / "cues")) for path in (one, two, one)] == [2, 3, 2]


def test_what_is_no_recording_is_told_before_any_is_read(tmp_path: Path, detector: AnomalyDetector) -> None:
    with pytest.raises(DatasetError, match="nothing there"):
        load_examples(detector, [recording(tmp_path / "drone_1"), tmp_path / "drone_2"], tmp_path / "cues")
    assert not (tmp_path / "cues").exists()


def test_a_damaged_file_is_named(tmp_path: Path, detector: AnomalyDetector) -> None:
    path, kept = recording(tmp_path / "drone_1"), tmp_path / "cues"
    kept_examples(detector, path, kept)
    file = kept / "drone_1.npz"
    data = file.read_bytes()
    for damaged in (data[: len(data) // 2], b"no archive", b""):
        file.write_bytes(damaged)
        with pytest.raises(DatasetError, match=r"drone_1\.npz.*delete it") as caught:
            kept_examples(detector, path, kept)
        assert caught.value.code == "evidence_data_malformed"


def test_arrays_of_another_shape_are_named(tmp_path: Path, detector: AnomalyDetector) -> None:
    path, kept = recording(tmp_path / "drone_1"), tmp_path / "cues"
    examples = kept_examples(detector, path, kept)
    with np.load(kept / "drone_1.npz") as arrays:
        about = arrays["about"]
    assert json.loads(str(about))["every"] == 1
    np.savez(
        kept / "drone_1.npz",
        about=about,
        photometric=examples.photometric[:, :2],
        geometric=examples.geometric,
        truth=examples.truth,
        offsets=examples.offsets,
    )
    with pytest.raises(DatasetError, match="photometric of shape"):
        kept_examples(detector, path, kept)


def test_recordings_need_movers_and_names_of_their_own(tmp_path: Path, detector: AnomalyDetector) -> None:
    static = add_ground_truth(tmp_path / "static", make_world(frames=2))
    with pytest.raises(DatasetError):
        extract_examples(detector, static)
    one, two = recording(tmp_path / "a" / "drone_1"), recording(tmp_path / "b" / "drone_1")
    with pytest.raises(DatasetError, match="several 'drone_1'") as caught:
        load_examples(detector, [one, two], tmp_path / "cues")
    assert caught.value.code == "recordings_share_a_name"


def drawn(height: int, width: int, *, seed: int = 0) -> Examples:
    rng = np.random.default_rng(seed)
    truth = np.zeros((2, height, width), np.uint8)
    truth[:, 4:12, 8:20] = MOVING
    geometric = rng.integers(0, 256, (2, len(GEOMETRIC_CUES), height // 4, width // 4), dtype=np.uint8)
    offsets = rng.integers(-5, 6, (2, 2, height // 4, width // 4), dtype=np.int8)
    return Examples(rng.integers(0, 256, (2, 3, height, width), dtype=np.uint8), geometric, truth, offsets)


def test_a_batch_is_a_function_of_seed_and_step() -> None:
    data = EvidenceData([drawn(64, 96), drawn(32, 64, seed=1)], SMALL)
    assert len(data) == 4
    first, again, other = data.sample(3), data.sample(3), data.sample(4)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(first.photometric, other.photometric)
    assert first.photometric.shape == (2, 3, 32, 64)
    assert first.geometric.shape == (2, len(GEOMETRIC_CUES), 8, 16)
    assert first.truth.shape == (2, 32, 64)
    assert first.offsets.shape == (2, 2, 8, 16)
    assert np.abs(first.photometric).max() <= 1.0


def test_crops_of_small_images_are_filled_with_nothing() -> None:
    wide = SMALL.model_copy(update={"crop_width": 128})
    batch = EvidenceData([drawn(32, 64)], wide).sample(0)
    filled = (batch.truth & IGNORED) != 0
    assert filled.mean() == pytest.approx(0.5)
    assert np.abs(batch.photometric.transpose(0, 2, 3, 1)[filled]).max() < 0.01


def test_a_mirror_changes_the_side_of_what_lies_across() -> None:
    examples = drawn(32, 64)
    values = examples.geometric.copy()
    values[:, ACROSS] = 255
    data = EvidenceData([replace(examples, geometric=values)], SMALL)
    seen = {float(crop[ACROSS].mean()) for step in range(20) for crop in data.sample(step).geometric}
    assert seen == {1.0, -1.0}
