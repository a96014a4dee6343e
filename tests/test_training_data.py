from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from worlds import make_world, textured_image, write_euroc, write_plain, write_png

from viflow_anomaly import training_data
from viflow_anomaly.batch import Batch
from viflow_anomaly.config import ModelConfig, MotionWindowConfig, SplitConfig, ViewConfig
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.datasets.splits import split_pairs
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.geometry import rigid_motion_flow
from viflow_anomaly.losses import warp
from viflow_anomaly.sensor_data import PinholeCamera
from viflow_anomaly.training_data import MIRRORED_MOTION_SIGNS, TrainingData, load_training_data

WINDOW = MotionWindowConfig(samples_before=2, samples_between=4)
CONFIG = ModelConfig(hypotheses=1, view=ViewConfig(focal_px=80.0), motion_window=WINDOW)


def load(*folders: Path, config: ModelConfig = CONFIG, look_aheads: tuple[int, ...] = (1,)) -> TrainingData:
    return load_training_data(folders, config, look_aheads)


def sample(data: TrainingData, *, step: int = 0, batch_size: int = 16, seed: int = 0) -> Batch:
    return data.sample(seed=seed, step=step, batch_size=batch_size, device="cpu")


def yaw_rates(batch: Batch) -> torch.Tensor:
    return batch.motion[:, WINDOW.samples_before :, 1].mean(dim=1)


def test_every_pair_of_every_look_ahead(tmp_path: Path) -> None:
    data = load(write_plain(tmp_path / "a", make_world(frames=5)), look_aheads=(1, 2))
    (bucket,) = data.buckets
    assert data.pair_count == 4 + 3
    assert data.excluded == {}
    assert bucket.frames.shape == (5, 64, 96)
    assert bucket.frames.dtype == np.uint8
    assert bucket.pairs.tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3], [2, 4], [3, 4]]
    assert bucket.motion.shape == (7, WINDOW.rows, 6)
    np.testing.assert_allclose(bucket.interval_s, [0.05, 0.1, 0.05, 0.1, 0.05, 0.1, 0.05])
    assert bucket.mirrorable.all()


def test_recordings_of_one_size_share_a_bucket(tmp_path: Path) -> None:
    first = write_plain(tmp_path / "a", make_world(frames=3))
    second = write_euroc(tmp_path / "b", make_world(frames=4, seed=1))
    wide = write_plain(tmp_path / "c", make_world(frames=3, width=128))
    data = load(first, second, wide)
    assert [bucket.frames.shape for bucket in data.buckets] == [(7, 64, 96), (3, 64, 128)]
    assert data.buckets[0].pairs.tolist() == [[0, 1], [1, 2], [3, 4], [4, 5], [5, 6]]
    assert data.pair_count == 7
    shapes = {tuple(sample(data, step=step, batch_size=2).source.shape) for step in range(30)}
    assert shapes == {(2, 1, 64, 96), (2, 1, 64, 128)}


def test_progress_counts_recordings(tmp_path: Path) -> None:
    folders = [write_plain(tmp_path / name, make_world(frames=2)) for name in "ab"]
    calls: list[tuple[int, int]] = []
    load_training_data(folders, CONFIG, (1,), on_progress=lambda done, total: calls.append((done, total)))
    assert calls == [(1, 2), (2, 2)]


# --- pairs that cannot be used


def test_unusable_pairs_are_counted_by_code(tmp_path: Path) -> None:
    world = make_world(frames=5)
    imu, frames = world.imu, world.frame_timestamps_ns
    assert imu.accel_m_s2 is not None
    # Nothing between frames 1 and 2 (a gap that hides the motion), and the log ends 5 ms after frame 3.
    kept = ((imu.timestamps_ns <= frames[1]) | (imu.timestamps_ns >= frames[2])) & (
        imu.timestamps_ns <= frames[3] + 5_000_000
    )
    cut = replace(
        imu,
        timestamps_ns=imu.timestamps_ns[kept],
        gyro_rad_s=imu.gyro_rad_s[kept],
        accel_m_s2=imu.accel_m_s2[kept],
    )
    data = load(write_plain(tmp_path / "a", replace(world, imu=cut)))
    assert data.excluded == {"imu_gap": 1, "imu_not_covering": 1}
    assert data.pair_count == 2
    assert data.buckets[0].pairs.tolist() == [[0, 1], [2, 3]]


@pytest.mark.parametrize(("rule", "straddling"), [("random", False), ("blocks", True)])
def test_what_a_test_needs_is_not_learnt_from(
    tmp_path: Path, rule: Literal["random", "blocks"], straddling: bool
) -> None:
    folder = write_plain(tmp_path / "a", make_world(frames=21))
    split = SplitConfig(rule=rule, block_s=0.2, seed=3)
    data = load_training_data([folder], CONFIG, (1, 2), split=split)
    parts = split_pairs(RecordingPairs(open_recording(folder), (1, 2)), rule, seed=3, block_s=0.2)
    assert data.pair_count == len(parts.train) > 0
    assert data.excluded["held_out"] == len(parts.test) > 0
    assert data.excluded["straddling"] == len(parts.straddling)
    assert bool(parts.straddling) == straddling
    frames_of_tests = {frame for k in parts.test for frame in RecordingPairs(open_recording(folder), (1, 2)).indices[k]}
    if rule == "blocks":
        assert data.buckets[0].frames.shape[0] == 21 - len(frames_of_tests)


def cut_short(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def of_another_size(path: Path) -> None:
    write_png(path, textured_image(128, 64))


@pytest.mark.parametrize("measure", [False, True])
@pytest.mark.parametrize("spoilt", [0, 2])
@pytest.mark.parametrize(
    ("spoil", "code"),
    [
        (cut_short, "image_truncated_or_corrupt"),
        (Path.unlink, "image_missing"),
        (of_another_size, "image_sizes_differ"),
    ],
)
def test_a_spoilt_frame_excludes_only_its_pairs(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    spoil: Callable[[Path], None],
    code: str,
    spoilt: int,
    measure: bool,
) -> None:
    folder = write_plain(tmp_path / "a", make_world(frames=5))

    def opened(path: Path) -> Recording:
        recording = open_recording(path)
        spoil(recording.frame_path(spoilt))  # between the opening and the reading: a missing file ends the former
        return recording

    monkeypatch.setattr(training_data, "open_recording", opened)
    data = load_training_data([folder], CONFIG, (1,), measure=measure)
    kept = [pair for pair in [(0, 1), (1, 2), (2, 3), (3, 4)] if spoilt not in pair]
    (bucket,) = data.buckets
    assert data.excluded == {code: 4 - len(kept)}
    assert bucket.frames.shape == (len({frame for pair in kept for frame in pair}), 64, 96)
    monkeypatch.undo()
    whole = load(write_plain(tmp_path / "b", make_world(frames=5))).buckets[0]
    for (source, target), wanted in zip(bucket.pairs, kept, strict=True):
        np.testing.assert_array_equal(bucket.frames[[source, target]], whole.frames[list(wanted)])


def test_frames_of_two_sizes_without_a_camera_are_two_buckets(tmp_path: Path) -> None:
    folder = write_plain(tmp_path / "a", make_world(frames=5), camera=False)
    for index in (0, 1):
        of_another_size(folder / f"images/{index:04d}.png")
    data = load(folder)
    assert [bucket.frames.shape for bucket in data.buckets] == [(3, 64, 96), (2, 64, 128)]
    assert data.excluded == {"image_sizes_differ": 1}


def test_frames_that_do_not_fit_the_camera_are_excluded(tmp_path: Path) -> None:
    folder = write_plain(tmp_path / "a", make_world(frames=5))
    for index in (0, 1):
        of_another_size(folder / f"images/{index:04d}.png")
    data = load(folder)
    assert data.excluded == {"camera_size_mismatch": 1, "image_sizes_differ": 1}
    assert data.pair_count == 2


def test_a_camera_that_cannot_be_used_is_said_at_once(tmp_path: Path) -> None:
    world = make_world(frames=2)
    folded = replace(world.camera, distortion_model="radtan", distortion_coeffs=(-50.0, 20.0, 0.0, 0.0))
    with pytest.raises(InvalidInputError) as raised:
        load(write_plain(tmp_path / "a", replace(world, camera=folded)))
    assert raised.value.code == "camera_invalid"


def test_no_usable_pair_is_an_error_that_says_why(tmp_path: Path) -> None:
    folder = write_plain(tmp_path / "a", make_world(frames=3), accel=False)
    left_out = r"in 1 recordings, found none \(left out: {'imu_accel_missing': 2}\)"
    with pytest.raises(DatasetError, match=left_out) as raised:
        load(folder)
    assert raised.value.code == "training_data_empty"


def test_no_recording_at_all_is_an_error() -> None:
    with pytest.raises(DatasetError, match="in 0 recordings") as raised:
        load()
    assert raised.value.code == "training_data_empty"


# --- batches


def test_a_batch_is_a_function_of_seed_and_step(tmp_path: Path) -> None:
    data = load(write_plain(tmp_path / "a"))
    one, again = sample(data, step=3), sample(data, step=3)
    assert all(torch.equal(a, b) for a, b in zip(one[:4], again[:4], strict=True))
    assert one.measured == again.measured == ()
    for other in (sample(data, step=4), sample(data, step=3, seed=1)):
        assert not torch.equal(one.source, other.source)


def test_sampling_changes_nothing_in_memory(tmp_path: Path) -> None:
    data = load(write_plain(tmp_path / "a"))
    (bucket,) = data.buckets
    before = (bucket.frames.copy(), bucket.motion.copy())
    sample(data)
    np.testing.assert_array_equal(bucket.frames, before[0])
    np.testing.assert_array_equal(bucket.motion, before[1])


def test_half_of_the_examples_are_mirrored(tmp_path: Path) -> None:
    data = load(write_plain(tmp_path / "a"))
    turning_left = float((yaw_rates(sample(data, batch_size=400)) < 0).float().mean())
    assert turning_left == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("case", ["no camera", "sensor axes"])
def test_nothing_is_mirrored_where_the_mounting_is_unknown(tmp_path: Path, case: str) -> None:
    folder = write_plain(tmp_path / "a", camera=case != "no camera")
    window = WINDOW.model_copy(update={"axes": "sensor"}) if case == "sensor axes" else WINDOW
    data = load(folder, config=CONFIG.model_copy(update={"motion_window": window}))
    (bucket,) = data.buckets
    assert not bucket.mirrorable.any()
    batch = sample(data, batch_size=32)
    known = {window.tobytes() for window in bucket.motion}
    assert all(window.numpy().tobytes() in known for window in batch.motion)


def test_mirrored_examples_still_obey_their_gyroscope(tmp_path: Path) -> None:
    """A turn to the right moves the picture to the left; the flow from the gyro reconstructs both kinds."""
    batch = sample(load(write_plain(tmp_path / "a")), batch_size=32)
    rates = yaw_rates(batch)
    assert 0 < int((rates < 0).sum()) < 32
    shift_px = -80.0 * rates * batch.interval_s
    errors = []
    for sign in (1, -1):
        flow = torch.zeros(32, 2, 64, 96)
        flow[:, 0] = sign * shift_px[:, None, None]
        reconstruction, _ = warp(batch.target, flow)
        errors.append((reconstruction - batch.source)[..., 8:-8].abs().mean(dim=(1, 2, 3)))
    assert float(errors[0].max()) < 0.02
    assert float(errors[1].min()) > 3 * float(errors[0].max())


def test_a_mirrored_rotation_gives_the_mirrored_flow() -> None:
    """Flow of a distant world under (x, y, z) rates, mirrored, is the flow under the mirrored rates."""
    camera = PinholeCamera(fx=80.0, fy=80.0, cx=47.5, cy=31.5, width=96, height=64)

    def flow_of(rates: NDArray[np.float64]) -> NDArray[np.float32]:
        turn = np.eye(4)
        turn[:3, :3] = torch.linalg.matrix_exp(
            torch.tensor([[0, rates[2], -rates[1]], [-rates[2], 0, rates[0]], [rates[1], -rates[0], 0]])
        ).numpy()
        return rigid_motion_flow(camera, np.full((64, 96), np.inf, np.float32), turn)[0]

    rates = np.array([0.05, -0.08, 0.11])
    mirrored = flow_of(rates)[:, ::-1] * (-1, 1)
    np.testing.assert_allclose(flow_of(rates * MIRRORED_MOTION_SIGNS[:3]), mirrored, atol=1e-4)


def test_the_mirror_of_a_mirror_is_the_original() -> None:
    assert np.array_equal(np.square(MIRRORED_MOTION_SIGNS), np.ones(6))
    # A force to the right becomes one to the left; up, down and forward stay.
    assert MIRRORED_MOTION_SIGNS[3:] == (-1, 1, 1)
