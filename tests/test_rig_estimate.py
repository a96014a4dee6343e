"""What the IMU and its mounting get wrong, against closed forms: bias, clock offset, mounting; outliers; resuming."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from turning_detector import TurningDetector, corrected
from worlds import T_CAM_IMU_PERMUTED, in_memory, make_world

from viflow_anomaly.batch_job import BatchOptions, run_batch
from viflow_anomaly.batch_rig import RigJournal
from viflow_anomaly.config import RigEstimateConfig
from viflow_anomaly.correction import MeasuredTurn
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.geometry import so3_exp, so3_log
from viflow_anomaly.rig_estimate import (
    MOUNTING,
    STATES,
    UNKNOWNS,
    RigEstimate,
    TurnObservation,
    corrected_pair,
    observe,
    turn_design,
    update,
)
from viflow_anomaly.sensor_data import Float64Array, Frame, FramePair, ImuSamples, PinholeCamera
from viflow_anomaly.stream import DetectionStream, StreamConfig, StreamState

CONFIG = RigEstimateConfig()
INTERVAL_S = 0.05
IMAGE = np.zeros((32, 32), np.uint8)
R_CAM_IMU = T_CAM_IMU_PERMUTED[:3, :3]
Rates = Callable[[Float64Array], Float64Array]


def constant(*rate_rad_s: float) -> Rates:
    return lambda times_s: np.tile(rate_rad_s, (times_s.size, 1))


def waves(amplitude: float = 0.6, hertz: float = 0.7) -> Rates:
    """Rates about all three axes, each with a phase and a pace of its own."""
    paces, phases = 2 * np.pi * hertz * np.array([1.0, 1.3, 0.8]), np.array([0.0, 1.0, 2.0])
    return lambda times_s: amplitude * np.sin(times_s[:, None] * paces + phases)


def pair_at(rates: Rates, start_s: float = 1.0, *, T_cam_imu: Float64Array | None = T_CAM_IMU_PERMUTED) -> FramePair:
    """A pair whose gyro reads ``rates``; samples at 1 kHz."""
    times_s = np.arange(start_s - 0.1, start_s + INTERVAL_S + 0.1, 1e-3)
    imu = ImuSamples(
        np.round(times_s * 1e9).astype(np.int64), rates(times_s), np.tile((0.0, 0.0, 9.81), (times_s.size, 1))
    )
    camera = PinholeCamera(30.0, 30.0, 15.5, 15.5, 32, 32, T_cam_imu=T_cam_imu)
    source_ns = round(start_s * 1e9)
    return FramePair(Frame(source_ns, IMAGE), Frame(source_ns + round(INTERVAL_S * 1e9), IMAGE), imu, camera)


def turn(rates: Rates, start_s: float, *, truth: Float64Array) -> Float64Array:
    """[3] how the camera truly turned between the frames, as a rotation vector of the summed true rates."""
    times_s = start_s + float(truth[3]) + np.linspace(0.0, INTERVAL_S, 2001)
    summed = np.trapezoid(rates(times_s) - truth[:3], times_s, axis=0)
    return np.asarray(so3_exp(truth[MOUNTING]) @ R_CAM_IMU @ summed)


def turned_beside_the_gyro(rates: Rates, start_s: float, truth: Float64Array) -> Float64Array:
    """[3] what a correction finds that begins at the gyro's turn."""
    true, believed = turn(rates, start_s, truth=truth), turn(rates, start_s, truth=np.zeros(UNKNOWNS))
    return so3_log(so3_exp(-true) @ so3_exp(-believed).T)


def unknowns(
    bias: tuple[float, ...] = (0, 0, 0), offset: float = 0, mounting: tuple[float, ...] = (0, 0, 0)
) -> Float64Array:
    return np.array([*bias, offset, *mounting], dtype=np.float64)


TRUTH = unknowns((0.02, -0.015, 0.03), 0.008, (0.01, -0.008, 0.012))


def observations(
    rates: Rates, truth: Float64Array, *, count: int = 400, noise_rad: float = 3e-4, seed: int = 0
) -> Iterator[TurnObservation]:
    rng = np.random.default_rng(seed)
    for k in range(count):
        start_s = 1.0 + k * INTERVAL_S
        pair = pair_at(rates, start_s)
        turned = turned_beside_the_gyro(rates, start_s, truth) + noise_rad * rng.standard_normal(3)
        observation = observe(pair, corrected(turned), CONFIG)
        assert observation is not None
        yield observation


def followed(seen: Iterator[TurnObservation], config: RigEstimateConfig = CONFIG) -> RigEstimate:
    estimate = RigEstimate.prior(config)
    for observation in seen:
        estimate = update(estimate, observation, config)
    return estimate


# --- signs and sizes of the model


def test_a_resting_camera_turns_by_the_bias_the_other_way() -> None:
    """The gyro reads +bias, so it says that the scene turned by -bias T; the images say that it did not."""
    bias = (0.02, -0.01, 0.03)
    found = turn_design(pair_at(constant(*bias)), R_CAM_IMU) @ unknowns(bias)
    np.testing.assert_allclose(found, INTERVAL_S * R_CAM_IMU @ bias, atol=1e-6)
    np.testing.assert_allclose(found, turned_beside_the_gyro(constant(*bias), 1.0, unknowns(bias)), atol=1e-6)


def test_a_constant_rate_with_a_bias() -> None:
    rates = constant(0.9, -0.4, 0.3)
    truth = unknowns((0.02, -0.01, 0.03))
    found = turn_design(pair_at(rates), R_CAM_IMU) @ truth
    np.testing.assert_allclose(found, turned_beside_the_gyro(rates, 1.0, truth), atol=2e-6)


def test_a_swinging_rate_with_an_offset() -> None:
    rates = waves()
    offset_s = 0.004
    found = turn_design(pair_at(rates), R_CAM_IMU) @ unknowns(offset=offset_s)
    start, end = rates(np.array([1.0, 1.0 + INTERVAL_S]))
    np.testing.assert_allclose(found, -offset_s * R_CAM_IMU @ (end - start), atol=5e-5)
    np.testing.assert_allclose(found, turned_beside_the_gyro(rates, 1.0, unknowns(offset=offset_s)), atol=5e-5)
    assert np.abs(found).max() > 5e-4


def test_a_turned_mounting() -> None:
    rates, mounting = constant(0.9, -0.4, 0.3), (0.01, -0.02, 0.015)
    found = turn_design(pair_at(rates), R_CAM_IMU) @ unknowns(mounting=mounting)
    np.testing.assert_allclose(found, np.cross(turn(rates, 1.0, truth=unknowns()), mounting), atol=3e-5)
    np.testing.assert_allclose(found, turned_beside_the_gyro(rates, 1.0, unknowns(mounting=mounting)), atol=2e-5)


@given(
    truth=st.tuples(*[st.floats(-0.05, 0.05)] * 3, st.floats(-0.005, 0.005), *[st.floats(-0.02, 0.02)] * 3).map(
        np.array
    ),
    start_s=st.floats(1.0, 9.0),
)
@settings(max_examples=50, deadline=None)
def test_the_model_is_the_truth_to_first_order(truth: Float64Array, start_s: float) -> None:
    start_s = round(start_s, 3)
    found = turn_design(pair_at(waves(), start_s), R_CAM_IMU) @ truth
    np.testing.assert_allclose(found, turned_beside_the_gyro(waves(), start_s, truth), atol=2e-4)


def test_the_calibrated_offset_is_where_the_rates_are_taken() -> None:
    pair = pair_at(waves())
    assert pair.camera is not None
    ahead = replace(pair, camera=replace(pair.camera, time_offset_s=0.02))
    there = turn_design(pair_at(waves(), 1.02), R_CAM_IMU)
    np.testing.assert_allclose(turn_design(ahead, R_CAM_IMU), there, atol=1e-9)


# --- a stream of pairs


def test_all_of_it_is_found_in_a_moving_stream() -> None:
    estimate = followed(observations(waves(), TRUTH))
    errors = estimate.mean[:UNKNOWNS] - TRUTH
    assert (np.abs(errors) < 4 * estimate.sigmas).all()
    assert np.abs(errors[:3]).max() < 0.01
    assert estimate.time_offset_s == pytest.approx(TRUTH[3], abs=1e-3)
    np.testing.assert_allclose(estimate.mounting_rad, TRUTH[MOUNTING], atol=3e-3)
    assert (estimate.pairs, estimate.rejected) == (400, 0)


def test_outliers_are_counted_and_change_little() -> None:
    seen = [*observations(waves(), TRUTH)]
    rng = np.random.default_rng(1)
    wrong = [
        replace(one, turned_rad=one.turned_rad + rng.choice((-0.05, 0.05), 3)) if k > 50 and k % 10 == 0 else one
        for k, one in enumerate(seen)
    ]
    clean, estimate = followed(iter(seen)), followed(iter(wrong))
    assert estimate.rejected == 34
    assert (np.abs(estimate.mean - clean.mean)[:UNKNOWNS] < clean.sigmas).all()


def test_what_is_a_little_off_counts_less() -> None:
    seen = [*observations(waves(), TRUTH, count=100)]
    off = replace(seen[-1], turned_rad=seen[-1].turned_rad + 0.004)
    robust, plain = (
        followed(iter([*seen[:-1], off]), CONFIG.model_copy(update={"huber_sigmas": k})) for k in (0.5, 100.0)
    )
    before = followed(iter(seen[:-1]))
    assert 0 < np.linalg.norm(robust.mean - before.mean) < np.linalg.norm(plain.mean - before.mean)


def test_without_rotation_offset_and_mounting_stay_unknown() -> None:
    estimate = followed(observations(constant(0.0, 0.0, 0.0), unknowns((0.02, -0.01, 0.03))))
    np.testing.assert_allclose(estimate.gyro_bias_rad_s, (0.02, -0.01, 0.03), atol=0.01)
    np.testing.assert_array_equal(estimate.mean[3:UNKNOWNS], 0.0)
    prior = RigEstimate.prior(CONFIG).sigmas
    np.testing.assert_allclose(estimate.sigmas[3:], prior[3:], rtol=1e-9)
    assert (estimate.sigmas[:3] < 0.3 * prior[:3]).all()
    assert estimate.known(CONFIG.model_copy(update={"apply_bias_sigma_rad_s": 0.02})) == ("gyro_bias",)


def test_a_constant_rate_tells_no_offset() -> None:
    estimate = followed(observations(constant(0.5, 0.2, -0.3), unknowns(mounting=(0.01, 0.0, 0.0))))
    assert estimate.time_offset_s == pytest.approx(0.0, abs=1e-9)
    assert estimate.sigmas[3] == pytest.approx(CONFIG.offset_sigma_s, rel=1e-6)
    # A turn about one axis: a bias explains what a mounting does, so neither is sure.
    assert estimate.sigmas[MOUNTING].max() > 0.5 * CONFIG.mounting_sigma_rad


def test_an_error_that_lasts_a_second_is_not_taken_for_a_sure_bias() -> None:
    lasting = unknowns((0.03, 0.0, 0.0))
    estimate = followed(observations(constant(0.0, 0.0, 0.0), lasting, count=20))
    assert estimate.sigmas[:3].min() > 0.02
    assert "gyro_bias" not in estimate.known(CONFIG)


def test_the_same_stream_gives_the_same_numbers_and_leaves_states_alone() -> None:
    seen = [*observations(waves(), TRUTH, count=50)]
    halfway = followed(iter(seen[:25]))
    before = halfway.mean.copy(), halfway.covariance.copy()
    ends = [update(halfway, seen[25], CONFIG) for _ in range(2)]
    np.testing.assert_array_equal(ends[0].mean, ends[1].mean)
    np.testing.assert_array_equal(ends[0].covariance, ends[1].covariance)
    np.testing.assert_array_equal(halfway.mean, before[0])
    np.testing.assert_array_equal(halfway.covariance, before[1])


@given(seed=st.integers(0, 2**32 - 1), gap_s=st.floats(0, 1e6), scale=st.floats(0, 10))
@settings(max_examples=50, deadline=None)
def test_the_covariance_stays_positive_and_below_the_prior(seed: int, gap_s: float, scale: float) -> None:
    rng = np.random.default_rng(seed)
    estimate = RigEstimate.prior(CONFIG)
    for k in range(5):
        root = rng.standard_normal((3, 3)) * 1e-3
        observation = TurnObservation(
            source_ns=round(k * gap_s * 1e9),
            target_ns=round(k * gap_s * 1e9) + 1,
            design=rng.standard_normal((3, UNKNOWNS)),
            turned_rad=scale * rng.standard_normal(3),
            covariance_rad2=root @ root.T,
        )
        estimate = update(estimate, observation, CONFIG)
    assert np.isfinite(estimate.mean).all()
    np.testing.assert_array_equal(estimate.covariance, estimate.covariance.T)
    assert np.linalg.eigvalsh(estimate.covariance).min() > 0
    assert (estimate.sigmas <= RigEstimate.prior(CONFIG).sigmas * (1 + 1e-9)).all()
    assert estimate.pairs + estimate.rejected == 5


def test_a_rig_that_changed_is_learnt_anew() -> None:
    before, after = unknowns((0.01, 0.0, 0.0)), unknowns((0.5, 0.0, 0.0))
    still = constant(0.0, 0.0, 0.0)
    seen = [*observations(still, before, count=300), *observations(still, after, count=120)]
    seen = [replace(one, source_ns=k * 50_000_000) for k, one in enumerate(seen)]
    config = CONFIG.model_copy(update={"bias_sigma_rad_s": 0.2})
    estimate = followed(iter(seen), config)
    assert estimate.rejected >= config.reopen_after
    assert estimate.gyro_bias_rad_s[0] == pytest.approx(0.5, abs=0.05)


# --- what a pair may say


def test_a_pair_says_nothing_without_a_mounting_a_turn_or_agreement() -> None:
    pair, good = pair_at(waves()), corrected(np.zeros(3))
    endless = good._replace(turn=MeasuredTurn(np.zeros(3), np.full((3, 3), np.inf)))
    assert observe(pair, good, CONFIG) is not None
    assert observe(pair, None, CONFIG) is None
    assert observe(pair, good._replace(turn=None), CONFIG) is None
    assert observe(pair, good._replace(inlier_share=0.1), CONFIG) is None
    assert observe(pair, endless, CONFIG) is None
    assert observe(replace(pair, camera=None), good, CONFIG) is None
    assert observe(pair_at(waves(), T_cam_imu=None), good, CONFIG) is None


def test_an_observation_survives_json_to_the_last_bit() -> None:
    (one,) = observations(waves(), TRUTH, count=1)
    again = TurnObservation.from_json((one.source_ns, one.target_ns), json.loads(json.dumps(one.to_json())))
    assert (again.source_ns, again.target_ns) == (one.source_ns, one.target_ns)
    for name in ("design", "turned_rad", "covariance_rad2"):
        np.testing.assert_array_equal(getattr(again, name), getattr(one, name))


@pytest.mark.parametrize(
    "broken",
    [
        {"design": [[0.0] * 6] * 3},
        {"turned_rad": [0.0, 1.0]},
        {"turned_rad": [0.0, 1.0, float("nan")]},
        {"covariance_rad2": "text"},
        {"design": None},
    ],
)
def test_a_malformed_observation_is_refused(broken: dict[str, Any]) -> None:
    (one,) = observations(waves(), TRUTH, count=1)
    with pytest.raises(InvalidInputError) as caught:
        TurnObservation.from_json((1, 2), one.to_json() | broken)
    assert caught.value.code == "rig_observation_malformed"
    with pytest.raises(InvalidInputError, match="turned_rad"):
        TurnObservation.from_json(
            (1, 2), {name: value for name, value in one.to_json().items() if name != "turned_rad"}
        )


# --- applying it


def test_a_corrected_pair_has_the_true_turn() -> None:
    """Gyro, clock and mounting put right, nothing is left to be found, and what was applied is added back."""
    pair = corrected_pair(pair_at(waves()), TRUTH)
    camera = pair.camera
    assert camera is not None
    assert camera.R_cam_imu is not None
    assert camera.time_offset_s == TRUTH[3]
    np.testing.assert_allclose(pair.imu.gyro_rad_s, pair_at(waves()).imu.gyro_rad_s - TRUTH[:3])
    times_s = pair.imu.timestamps_ns * 1e-9 - TRUTH[3]
    fine_s = np.linspace(1.0, 1.0 + INTERVAL_S, 501)
    read = np.stack([np.interp(fine_s, times_s, pair.imu.gyro_rad_s[:, axis]) for axis in range(3)], axis=1)
    found = camera.R_cam_imu @ np.trapezoid(read, fine_s, axis=0)
    np.testing.assert_allclose(found, turn(waves(), 1.0, truth=TRUTH), atol=1e-6)
    observation = observe(pair, corrected(np.zeros(3)), CONFIG, TRUTH)
    assert observation is not None
    np.testing.assert_allclose(observation.design @ TRUTH, observation.turned_rad)


def test_nothing_to_apply_leaves_the_pair() -> None:
    pair = pair_at(waves())
    assert corrected_pair(pair, np.zeros(UNKNOWNS)) is pair
    bare, unmounted = replace(pair, camera=None), pair_at(waves(), T_cam_imu=None)
    assert corrected_pair(bare, TRUTH) is bare
    assert corrected_pair(unmounted, TRUTH) is unmounted


def test_only_what_is_known_well_is_applied_and_only_on_request() -> None:
    sure = RigEstimate(np.full(STATES, 0.01), 1e-12 * np.eye(STATES))
    applying = CONFIG.model_copy(update={"apply": True})
    np.testing.assert_array_equal(sure.applicable(CONFIG), 0.0)
    np.testing.assert_array_equal(sure.applicable(applying), 0.01)
    np.testing.assert_array_equal(sure.applicable(applying.model_copy(update={"enabled": False})), 0.0)
    one_axis = sure.covariance.copy()
    one_axis[1, 1] = 1.0
    np.testing.assert_array_equal(replace(sure, covariance=one_axis).applicable(applying), [0.0] * 3 + [0.01] * 4)
    np.testing.assert_array_equal(RigEstimate.prior(applying).applicable(applying), 0.0)
    assert sure.report(applying)["applied"] == ["gyro_bias", "time_offset", "mounting"]
    assert sure.report(CONFIG)["applied"] == []


# --- batch and stream

EAGER = RigEstimateConfig(
    apply=True, apply_bias_sigma_rad_s=10, apply_offset_sigma_s=1, apply_mounting_sigma_rad=1, bias_sigma_rad_s=0.5
)
FRAMES = 9


class StoppedError(Exception):
    """Stands for a kill."""


def lines(out: Path) -> list[dict[str, Any]]:
    found = [json.loads(line) for line in (out / "detections.jsonl").read_text().splitlines()]
    return [line | {"timings_ms": None} for line in found]


def rig_of(out: Path) -> dict[str, Any]:
    report: dict[str, Any] = json.loads((out / "run.json").read_text())["rig_estimate"]
    return report


@pytest.mark.parametrize("config", [CONFIG, EAGER])
@pytest.mark.parametrize("at", [1, 5])
@pytest.mark.parametrize("lost", [0, 1])
def test_a_resumed_run_learns_what_an_uninterrupted_one_does(
    tmp_path: Path, config: RigEstimateConfig, at: int, lost: int
) -> None:
    """Also where the last observations did not reach the disk: their pairs are judged again."""
    recording = in_memory(make_world(frames=FRAMES, square_px=24), tmp_path / "frames")
    whole, out = tmp_path / "whole", tmp_path / "out"
    run_batch(recording, uninterrupted := TurningDetector(), BatchOptions(out_dir=whole, rig_estimate=config))

    def stop(pair: FramePair) -> None:
        if pair.source.timestamp_ns == recording.frame_timestamps_ns[at]:
            raise StoppedError

    options = BatchOptions(out_dir=out, rig_estimate=config, resume=True)
    with pytest.raises(StoppedError):
        run_batch(recording, TurningDetector(on_pair=stop), options)
    journal = out / "rig_estimate.jsonl"
    told = journal.read_bytes().splitlines(keepends=True)
    assert len(told) == at
    if at > lost:
        journal.write_bytes(b"".join(told[: at - lost]) + b'{"source_timestamp_ns": 12')
    summary = run_batch(recording, resumed := TurningDetector(), options)
    assert summary.reused == at - (lost if at > lost else 0)
    assert rig_of(out) == rig_of(whole)
    assert lines(out) == lines(whole)
    assert journal.read_bytes() == (whole / "rig_estimate.jsonl").read_bytes()
    for ours, theirs in zip(reversed(resumed.gyros), reversed(uninterrupted.gyros), strict=False):
        np.testing.assert_array_equal(ours, theirs)
    assert rig_of(whole)["pairs"] in (FRAMES - 2, FRAMES - 3)
    assert rig_of(whole)["applied"] == (["gyro_bias", "time_offset", "mounting"] if config.apply else [])


def test_an_estimate_that_is_off_is_not_written(tmp_path: Path) -> None:
    recording = in_memory(make_world(frames=4), tmp_path / "frames")
    options = BatchOptions(out_dir=tmp_path / "out", rig_estimate=RigEstimateConfig(enabled=False))
    run_batch(recording, TurningDetector(), options)
    assert rig_of(tmp_path / "out") is None
    assert not (tmp_path / "out" / "rig_estimate.jsonl").exists()


def test_overwriting_forgets_what_was_learnt(tmp_path: Path) -> None:
    recording = in_memory(make_world(frames=6), tmp_path / "frames")
    run_batch(recording, TurningDetector(), BatchOptions(out_dir=tmp_path / "out"))
    run_batch(recording, TurningDetector(), BatchOptions(out_dir=tmp_path / "out", overwrite=True, limit=2))
    assert len((tmp_path / "out" / "rig_estimate.jsonl").read_text().splitlines()) == 2


@pytest.mark.parametrize(
    "tail",
    [b"{}\n", b"null\n", b"text\n", b'{"source_timestamp_ns": 1, "target_timestamp_ns": 2, "observation": {}}\n'],
)
def test_a_damaged_end_of_the_observations_is_dropped(tmp_path: Path, tail: bytes) -> None:
    path = tmp_path / "rig_estimate.jsonl"
    (one,) = observations(waves(), TRUTH, count=1)
    assert not RigJournal(path).lacks((1, 2))
    journal = RigJournal(path)
    journal.append((one.source_ns, one.target_ns), one)
    journal.append((3, 4), None)
    good = path.read_bytes()
    path.write_bytes(good + tail)
    again = RigJournal(path)
    assert len(again) == 2
    found = again.observation((one.source_ns, one.target_ns))
    assert found is not None
    assert found.to_json() == one.to_json()
    assert not again.lacks((3, 4))
    assert (again.observation((3, 4)), again.observation((5, 6))) == (None, None)
    assert again.lacks((5, 6))
    assert path.read_bytes() == good


@pytest.mark.parametrize("config", [CONFIG, EAGER])
def test_a_stream_learns_what_a_batch_does(tmp_path: Path, config: RigEstimateConfig) -> None:
    world = make_world(frames=FRAMES, square_px=24)
    recording = in_memory(world, tmp_path / "frames")
    run_batch(recording, TurningDetector(), BatchOptions(out_dir=tmp_path / "out", rig_estimate=config))
    stream = DetectionStream(TurningDetector(), world.camera, StreamConfig(rig_estimate=config))
    assert world.imu.accel_m_s2 is not None
    imu = ImuSamples(world.imu.timestamps_ns, world.imu.gyro_rad_s, world.imu.accel_m_s2)
    state = stream.add_imu(StreamState(), imu).state
    for k, image in enumerate(world.images):
        state = stream.add_frame(state, Frame(int(world.frame_timestamps_ns[k]), image)).state
    assert state.rig is not None
    assert state.rig.report(config) == rig_of(tmp_path / "out")


def test_a_stream_waits_for_the_samples_that_its_offset_asks_for() -> None:
    world = make_world(frames=3)
    stream = DetectionStream(TurningDetector(), world.camera, StreamConfig(rig_estimate=EAGER))
    mean = np.zeros(STATES)
    mean[3] = 0.02
    state = StreamState(rig=RigEstimate(mean, 1e-12 * np.eye(STATES)))
    frames = [Frame(int(stamp), image) for stamp, image in zip(world.frame_timestamps_ns, world.images, strict=True)]
    until = int(np.searchsorted(world.imu.timestamps_ns, frames[1].timestamp_ns + 15_000_000))
    assert world.imu.accel_m_s2 is not None
    early, late = (
        ImuSamples(world.imu.timestamps_ns[rows], world.imu.gyro_rad_s[rows], world.imu.accel_m_s2[rows])
        for rows in (slice(0, until), slice(until, until + 4))
    )
    state = stream.add_frame(stream.add_frame(state, frames[0]).state, frames[1]).state
    step = stream.add_imu(state, early)
    assert step.detections == ()
    assert len(stream.add_imu(step.state, late).detections) == 1
