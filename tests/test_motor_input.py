"""The motor stream: displacement clusters and commands, from the recording to the network's answer."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from simulated_truth import add_ground_truth
from worlds import car_world, make_world, write_euroc, write_kitti_raw, write_lines, write_plain

from viflow_anomaly import prediction
from viflow_anomaly.batch import collate
from viflow_anomaly.checkpoint import load_checkpoint, save_checkpoint
from viflow_anomaly.checkpoint_record import CheckpointRecord
from viflow_anomaly.cli.main import run
from viflow_anomaly.config import (
    CorrectionConfig,
    ModelConfig,
    MotionInputs,
    MotionWindowConfig,
    MotorConfig,
    TrainingConfig,
    ViewConfig,
)
from viflow_anomaly.correction import RigidMotion, rigid_flow_px
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import ConfigError, DatasetError, InvalidInputError
from viflow_anomaly.evaluation.endpoint_error import require_ground_truth
from viflow_anomaly.geometry import so3_exp
from viflow_anomaly.measured_flow import MeasuredFlow
from viflow_anomaly.model.builder import build_model
from viflow_anomaly.model_input import prepare
from viflow_anomaly.motor_input import (
    clustering_error_m,
    encode,
    fitted_motor,
    motor_input,
    nearest_cluster,
    require_supported,
)
from viflow_anomaly.prediction import correct, view_rays
from viflow_anomaly.runtime.export import export_network
from viflow_anomaly.runtime.interface import Hypotheses
from viflow_anomaly.runtime.loading import load_runtime
from viflow_anomaly.sensor_data import FramePair
from viflow_anomaly.training import train
from viflow_anomaly.training_data import load_training_data

WINDOW = MotionWindowConfig(samples_before=2, samples_between=4)
VIEW = ViewConfig(focal_px=80.0)
THREE = MotorConfig(clusters=3, centroids_m=((-1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 2.0)))
SPEED = MotorConfig(mean=(10.0,), deviation=(2.0,))
STEP_M = np.array([0.02, 0.01, 0.3])


def config(inputs: MotionInputs, motor: MotorConfig = THREE, **changes: Any) -> ModelConfig:
    values = {"preset": "compact", "hypotheses": 4, "view": VIEW, "motion_window": WINDOW, **changes}
    return ModelConfig(motion_inputs=inputs, motor=motor, **values)


def write_moving(folder: Path, *, frames: int = 4, seed: int = 0) -> Path:
    """A recording in EuRoC's layout whose camera moves ``STEP_M`` a frame along its own axes, without turning."""
    world = make_world(frames=frames, seed=seed)
    write_euroc(folder, world)
    T_body_cam = np.array([[0, -1.0, 0, 0.2], [1.0, 0, 0, 0], [0, 0, 1.0, 0.1], [0, 0, 0, 1.0]]) @ np.linalg.inv(
        np.asarray(world.camera.T_cam_imu)
    )
    step_body = T_body_cam[:3, :3] @ STEP_M
    rows = [
        ",".join(map(str, [stamp, *(k * (1 + 0.1 * (k % 3)) * step_body), 1, 0, 0, 0]))
        for k, stamp in enumerate(world.frame_timestamps_ns)
    ]
    write_lines(folder / "mav0" / "state_groundtruth_estimate0" / "data.csv", ["#timestamp,p,p,p,q,q,q,q", *rows])
    return folder


def pair_with(tmp_path: Path, command: object) -> FramePair:
    pair = RecordingPairs(open_recording(write_plain(tmp_path, make_world(frames=2))))[0]
    return replace(pair, motor_command=command)


# --- encoding


def test_a_displacement_becomes_one_hot_by_its_nearest_centroid(tmp_path: Path) -> None:
    for command, expected in [([-0.6, 0, 0], [1, 0, 0]), ([-0.4, 0.3, 0], [0, 1, 0]), ([0, 0, 9.0], [0, 0, 1])]:
        encoded = motor_input(pair_with(tmp_path, command), config("sffms"))
        assert encoded is not None
        assert encoded.tolist() == expected


def test_a_command_is_standardised_and_given_over_the_interval(tmp_path: Path) -> None:
    encoded = motor_input(pair_with(tmp_path, [14.0]), config("imu+motor", SPEED))
    np.testing.assert_allclose(encoded, [2.0, 2.0 * 0.05 * 10], rtol=1e-6)


def test_a_model_without_a_motor_stream_looks_at_no_command(tmp_path: Path) -> None:
    assert motor_input(pair_with(tmp_path, [1.0, 2.0]), config("imu")) is None


@pytest.mark.parametrize(
    ("inputs", "motor", "command", "code", "says"),
    [
        ("sffms", THREE, None, "motor_command_missing", "displacement x y z"),
        ("imu+sffms", THREE, [1.0], "motor_command_length", "found 1 numbers"),
        ("motor", SPEED, None, "motor_command_missing", "expects 1 numbers"),
        ("imu+motor", SPEED, [1.0, 2.0], "motor_command_length", "expects 1 numbers"),
    ],
)
def test_a_missing_or_wrong_command_is_named(
    tmp_path: Path, inputs: MotionInputs, motor: MotorConfig, command: object, code: str, says: str
) -> None:
    with pytest.raises(InvalidInputError, match=says) as raised:
        prepare(pair_with(tmp_path, command), config(inputs, motor))
    assert (raised.value.code, raised.value.field) == (code, "motor_command")


def test_a_command_that_nobody_would_look_at_is_refused(tmp_path: Path) -> None:
    pair = pair_with(tmp_path, [1.0])
    require_supported(pair, "command")
    require_supported(pair_with(tmp_path, None), None)
    with pytest.raises(InvalidInputError) as raised:
        require_supported(pair, None)
    assert raised.value.code == "motor_command_unsupported"


@pytest.mark.parametrize(("inputs", "motor", "count"), [("sffms", THREE, 3), ("motor", SPEED, 1)])
@pytest.mark.parametrize("value", [1e7, -1e300])
def test_a_command_that_nothing_moves_by_is_refused(
    tmp_path: Path, inputs: MotionInputs, motor: MotorConfig, count: int, value: float
) -> None:
    with pytest.raises(InvalidInputError, match="at most 1e\\+06 in size") as raised:
        motor_input(pair_with(tmp_path, [value] * count), config(inputs, motor))
    assert raised.value.code == "motor_command_invalid"


def test_more_numbers_than_a_command_has_are_refused() -> None:
    with pytest.raises(ConfigError, match="at most 64 numbers, found 65") as raised:
        fitted_motor(np.zeros((3, 65)), config("motor", MotorConfig()), seed=0)
    assert raised.value.code == "config_invalid"


@pytest.mark.parametrize("inputs", ["sffms", "motor"])
def test_a_record_without_fitted_values_is_no_checkpoint(inputs: MotionInputs) -> None:
    with pytest.raises(ConfigError, match="expected the values that a training fits"):
        CheckpointRecord.from_mapping(
            {"name": "n", "version": "1", "sha256": "ab" * 32, "model": config(inputs, MotorConfig()).model_dump()},
            where="test",
        )


def test_a_training_that_diverges_says_so(tmp_path: Path) -> None:
    training = TRAINING.model_copy(update={"learning_rate": 1e18, "steps": 30, "warmup_steps": 0})
    with pytest.raises(ConfigError, match="the training has diverged") as raised:
        train([write_moving(tmp_path / "a")], tmp_path / "run", model=config("imu"), training=training, progress=False)
    assert raised.value.code == "training_diverged"


@pytest.mark.parametrize("inputs", ["sffms", "motor"])
def test_values_that_no_training_fitted_are_an_error(inputs: MotionInputs) -> None:
    with pytest.raises(ConfigError) as raised:
        encode(np.zeros((1, 3)), np.array([0.1]), config(inputs, MotorConfig()))
    assert raised.value.code == "motor_not_fitted"


@pytest.mark.parametrize(
    "values",
    [
        {"clusters": 3, "centroids_m": [[0, 0, 0]]},
        {"mean": [1.0], "deviation": []},
        {"mean": [1.0], "deviation": [0.0]},
    ],
)
def test_half_fitted_values_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as raised:
        MotorConfig.from_mapping(values, where="test")
    assert raised.value.code == "config_invalid"


# --- clustering


def test_clusters_are_found_where_the_displacements_are() -> None:
    rng = np.random.default_rng(0)
    centres = np.array([[0, 0, 0], [0, 0, 1.0], [0.5, 0, 0]])
    displacements = np.concatenate([centre + rng.normal(0, 0.01, (50, 3)) for centre in centres])
    fitted = fitted_motor(displacements, config("sffms", MotorConfig(clusters=3)), seed=1)
    np.testing.assert_allclose(fitted.motor.centroids_m, centres, atol=0.01)  # in lexicographic order
    error = clustering_error_m(displacements, fitted.motor)
    assert error.shape == (150, 3)
    assert error.std() == pytest.approx(0.01, rel=0.2)
    assert fitted_motor(displacements, config("sffms", MotorConfig(clusters=3)), seed=1) == fitted


@given(st.integers(0, 2**32 - 1), st.integers(1, 12))
def test_no_displacement_is_nearer_to_another_centroid(seed: int, clusters: int) -> None:
    displacements = np.random.default_rng(seed).normal(0, 1, (60, 3))
    motor = fitted_motor(displacements, config("sffms", MotorConfig(clusters=clusters)), seed=seed).motor
    distances = np.linalg.norm(displacements[:, None] - np.array(motor.centroids_m), axis=-1)
    chosen = nearest_cluster(displacements, motor)
    assert (distances[np.arange(60), chosen] == distances.min(axis=1)).all()
    one_hot = encode(displacements, np.ones(60), config("sffms", motor))
    assert (one_hot.sum(axis=1) == 1).all()
    assert (one_hot.argmax(axis=1) == chosen).all()


def test_more_clusters_than_displacements_are_refused() -> None:
    with pytest.raises(ConfigError, match="training data, 2, found 20") as raised:
        fitted_motor(np.array([[0.0, 0, 0], [0, 0, 1], [0, 0, 1]]), config("sffms", MotorConfig()), seed=0)
    assert raised.value.code == "config_invalid"


def test_a_command_that_never_changes_is_standardised_without_a_division_by_zero() -> None:
    fitted = fitted_motor(np.full((5, 2), 3.0), config("motor", MotorConfig()), seed=0)
    np.testing.assert_allclose(encode(np.full((1, 2), 3.02), np.array([0.1]), fitted), 0.02, atol=1e-6)


# --- from recordings


def test_pairs_carry_the_displacement_in_the_source_cameras_axes(tmp_path: Path) -> None:
    pairs = RecordingPairs(open_recording(write_moving(tmp_path)), motor_source="displacement")
    command = pairs[0].motor_command
    assert command is not None
    np.testing.assert_allclose(command, 1.1 * STEP_M, atol=1e-9)


def test_a_recording_without_poses_cannot_give_displacements(tmp_path: Path) -> None:
    recording = open_recording(write_plain(tmp_path))
    with pytest.raises(DatasetError, match="expected poses of the camera") as raised:
        RecordingPairs(recording, motor_source="displacement")
    assert (raised.value.code, raised.value.field) == ("trajectory_missing", "motor_command")


def test_pairs_beyond_the_poses_are_excluded_from_training(tmp_path: Path) -> None:
    folder = write_moving(tmp_path / "a", frames=5)
    states = folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    states.write_text("".join(states.read_text().splitlines(keepends=True)[:-2]))
    data = load_training_data([folder], config("sffms", MotorConfig(clusters=2)), (1,))
    assert data.excluded == {"trajectory_not_covering": 2}
    assert data.motor is not None
    assert data.motor.shape == (2, 3)


def test_a_mirrored_pair_has_a_mirrored_displacement(tmp_path: Path) -> None:
    left, right = (-STEP_M[0], *STEP_M[1:]), tuple(STEP_M)
    two = MotorConfig(clusters=2, centroids_m=(left, right))
    data = load_training_data([write_moving(tmp_path, frames=2)], config("imu+sffms", two), (1,))
    batch = data.sample(seed=0, step=0, batch_size=16, device="cpu")
    assert batch.motor is not None
    unmirrored = torch.tensor([torch.equal(one, batch.source[0]) for one in batch.source])
    side = batch.motor.argmax(dim=1)
    assert 0 < int(unmirrored.sum()) < 16
    assert side[unmirrored].unique().numel() == side[~unmirrored].unique().numel() == 1
    assert side[unmirrored][0] != side[~unmirrored][0]


# --- networks


@pytest.mark.parametrize(
    ("preset", "inputs"), [("compact", "sffms"), ("compact", "imu+sffms"), ("calibrated", "imu+sffms")]
)
def test_the_motor_stream_moves_the_flow(preset: str, inputs: MotionInputs) -> None:
    network = build_model(config(inputs, preset=preset), seed=0)
    source, motion, interval_s = torch.rand(2, 1, 64, 64), torch.zeros(2, WINDOW.rows, 6), torch.full((2,), 0.1)
    with torch.no_grad():
        flow = network(source[:1].repeat(2, 1, 1, 1), motion, interval_s, torch.eye(3)[:2]).flow_px
    assert not torch.allclose(flow[0], flow[1])


def test_a_rotation_that_nobody_knows_is_found_on_the_target_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A turn of 50 mrad that little was measured of: the prior of a gyro that was seen would hold it back."""
    model = config("sffms", hypotheses=1)
    one = prepare(pair_with(tmp_path, np.zeros(3)), model)
    assert not one.rotation_known
    rows, columns = (side // 4 for side in one.source.shape)
    rays = view_rays(rows, columns, 4, *one.source.shape, one.view.focal_px)
    turn = RigidMotion(so3_exp(np.array([0.0, 0.05, 0.0])), np.zeros(3))
    flow = rigid_flow_px(rays, np.ones((rows, columns), np.float32), turn, one.view.focal_px)
    seen = MeasuredFlow(flow, np.full((rows, columns), 0.01, np.float32), 4)
    monkeypatch.setattr(prediction, "measure_flow", lambda *_, **__: seen)
    still = Hypotheses(np.zeros((1, rows, columns, 2), np.float32), 4, None)
    unknown, known = (
        correct(still, replace(one, rotation_known=known), CorrectionConfig(), focal_px=80.0).flow_px
        for known in (False, True)
    )
    assert np.abs(unknown - flow).mean() < 0.1
    assert np.abs(known - flow).mean() > 0.5


def test_a_calibrated_model_needs_the_gyro() -> None:
    with pytest.raises(ValueError, match="one with 'imu' for the preset 'calibrated'"):
        config("sffms", preset="calibrated")


def test_without_an_imu_stream_the_imu_changes_nothing() -> None:
    network = build_model(config("sffms"), seed=0)
    source, interval_s, motor = torch.rand(1, 1, 64, 64), torch.full((1,), 0.1), torch.eye(3)[:1]
    with torch.no_grad():
        flows = [
            network(source, rate * torch.ones(1, WINDOW.rows, 6), interval_s, motor).flow_px for rate in (0.0, 3.0)
        ]
    assert torch.equal(*flows)
    assert not any("motion_encoder" in name or "mounting" in name for name in network.state_dict())


@pytest.mark.parametrize(("inputs", "code_width"), [("imu", 512), ("sffms", 512), ("imu+sffms", 1024)])
def test_the_papers_streams_are_concatenated(inputs: MotionInputs, code_width: int) -> None:
    whole = config(
        inputs,
        preset="paper",
        view=ViewConfig(mode="center_crop", crop_size=32),
        motion_window=MotionWindowConfig(layout="paper_kitti"),
    )
    with torch.device("meta"):
        network = build_model(whole).to("meta")
        code, matrices = network.global_shifter(torch.empty(2, 20, 6), torch.empty(2, 3))
        flow = network(torch.empty(2, 1, 32, 32), torch.empty(2, 20, 6), torch.empty(2), torch.empty(2, 3)).flow_px
    assert code.shape == (2, code_width)
    assert matrices.shape == (2, 4, 2, 3)
    assert flow.shape == (2, 4, 2, 32, 32)


def test_a_command_stream_of_unknown_width_cannot_be_built() -> None:
    with pytest.raises(ConfigError) as raised:
        build_model(config("imu+motor", MotorConfig()))
    assert raised.value.code == "motor_not_fitted"


# --- training, checkpoint, detection

TRAINING = TrainingConfig(steps=2, batch_size=2, warmup_steps=1)


@pytest.mark.parametrize("preset", ["compact", "calibrated"])
def test_the_codebook_is_fitted_on_the_training_split_and_kept_in_the_checkpoint(tmp_path: Path, preset: str) -> None:
    folder = write_moving(tmp_path / "a", frames=5)
    wanted = config("imu+sffms", MotorConfig(clusters=3), preset=preset)
    path = train([folder], tmp_path / "run", model=wanted, training=TRAINING, progress=False)
    _, record = load_checkpoint(path)
    displacements = load_training_data([folder], wanted, TRAINING.look_aheads).motor
    assert displacements is not None
    assert record.model == fitted_motor(displacements, wanted, seed=TRAINING.seed)
    again = train([folder], tmp_path / "run", model=wanted, training=TRAINING, progress=False, resume=True)
    assert load_checkpoint(again)[1] == record
    pairs = RecordingPairs(open_recording(folder), motor_source="displacement")
    detector = AnomalyDetector.from_checkpoint(path)
    assert detector.motor_source == "displacement"
    assert detector.detect(pairs[0]).status == "ok"
    with pytest.raises(InvalidInputError) as raised:
        detector.detect(replace(pairs[0], motor_command=None))
    assert raised.value.code == "motor_command_missing"


def test_a_resumed_run_keeps_its_codebook(tmp_path: Path) -> None:
    """The recording grew since: clusters fitted anew would be other inputs than the weights were trained with."""
    folder = write_moving(tmp_path / "a", frames=5)
    wanted = config("imu+sffms", MotorConfig(clusters=3))
    first = load_checkpoint(train([folder], tmp_path / "run", model=wanted, training=TRAINING, progress=False))[1]
    (tmp_path / "run" / "model.safetensors").unlink()
    write_moving(tmp_path / "b" / "a", frames=9, seed=3)
    again = train(
        [tmp_path / "b" / "a"], tmp_path / "run", model=wanted, training=TRAINING, progress=False, resume=True
    )
    assert load_checkpoint(again)[1].model == first.model


def test_a_validation_recording_without_commands_is_found_before_the_training(tmp_path: Path) -> None:
    folder = add_ground_truth(tmp_path / "drone_1", make_world(frames=3))
    with pytest.raises(InvalidInputError) as raised:
        require_ground_truth([folder], config("imu+motor", SPEED))
    assert raised.value.code == "motor_command_missing"


def test_commands_of_two_lengths_cannot_be_learnt_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = [write_plain(tmp_path / name, make_world(frames=3)) for name in ("one", "two")]
    original = RecordingPairs.motor_command

    def numbers(self: RecordingPairs, index: int) -> np.ndarray:
        assert original(self, index) is None
        return np.ones(1 if self.recording.name == "one" else 2)

    monkeypatch.setattr(RecordingPairs, "motor_command", numbers)
    with pytest.raises(DatasetError, match=r"found \[1, 2\] numbers") as raised:
        load_training_data(folders, config("imu+motor", MotorConfig()), (1,))
    assert raised.value.code == "motor_commands_differ"
    fitted = load_training_data(folders[:1], config("imu+motor", MotorConfig()), (1,))
    assert fitted.model.motor.mean == (1.0,)
    assert not fitted.buckets[0].mirrorable.any()  # nobody knows what a command is for a mirrored picture
    batch = fitted.sample(seed=0, step=0, batch_size=3, device="cpu")
    assert batch.motor is not None
    assert batch.motor.shape == (3, 2)


def test_a_command_reaches_the_batch(tmp_path: Path) -> None:
    inputs = [prepare(pair_with(tmp_path, command), config("sffms")) for command in ([-1.0, 0, 0], [0, 0, 2.0])]
    motor = collate(inputs).motor
    assert motor is not None
    assert motor.tolist() == [[1, 0, 0], [0, 0, 1]]


def test_an_older_record_is_a_model_without_a_motor_stream(tmp_path: Path) -> None:
    imu = config("imu")
    path = save_checkpoint(tmp_path / "m.safetensors", build_model(imu), imu, name="old", version="1")
    record = json.loads(path.with_suffix(".json").read_text())
    del record["model"]["motor"], record["model"]["motion_inputs"]
    path.with_suffix(".json").write_text(json.dumps(record))
    assert load_checkpoint(path)[1].model.motor_source is None


# --- from the outside


@pytest.fixture(scope="module")
def speed_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    model = config("imu+motor", SPEED)
    path = tmp_path_factory.mktemp("speed") / "speed.safetensors"
    return save_checkpoint(path, build_model(model, seed=1), model, name="speed", version="1")


def test_the_command_line_takes_a_command(
    speed_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_plain(tmp_path, make_world(frames=2))
    stamps = open_recording(folder).frame_timestamps_ns
    arguments = ["detect", *(str(folder / "images" / f"000{k}.png") for k in (0, 1)), "--imu", str(folder / "imu.csv")]
    arguments += ["--source-timestamp-ns", str(stamps[0]), "--target-timestamp-ns", str(stamps[1]), "--json"]
    ours = ["--checkpoint", str(speed_model)]
    assert run([*arguments, *ours, "--motor-command", "12.5"]) == 0
    assert json.loads(capsys.readouterr().out)["model"]["name"] == "speed"
    for more, says in [
        (ours, "motor_command_missing"),
        ([*ours, "--motor-command", "1,2"], "motor_command_length"),
        ([*ours, "--motor-command", "fast"], "expected numbers separated by commas, found 'fast'"),
        (["--motor-command", "1"], "motor_command_unsupported"),
    ]:
        assert run([*arguments, *more]) == 2
        assert says in capsys.readouterr().err


def test_batch_takes_the_recordings_own_command(
    speed_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = write_kitti_raw(tmp_path, car_world(frames=3))
    assert run(["batch", str(drive), "--out", str(tmp_path / "out"), "--checkpoint", str(speed_model)]) == 0
    assert len((tmp_path / "out" / "detections.jsonl").read_text().splitlines()) == 2
    without = write_plain(tmp_path / "plain", make_world(frames=2))
    assert run(["batch", str(without), "--checkpoint", str(speed_model)]) == 3
    assert "motor_command_missing" in capsys.readouterr().err


@pytest.mark.parametrize("inputs", ["sffms", "imu+sffms"])
def test_openvino_takes_the_motor_stream(tmp_path: Path, inputs: MotionInputs) -> None:
    pytest.importorskip("openvino", reason="the extra 'openvino' is not installed")
    pytest.importorskip("onnxscript", reason="the extra 'export' is not installed")
    model = config(inputs, preset="compact")
    path = save_checkpoint(tmp_path / "m.safetensors", build_model(model, seed=1), model, name="m", version="1")
    export_network(path)
    one = prepare(pair_with(tmp_path / "pair", [0, 0, 2.0]), model)
    flows = [load_runtime(path, runtime=name).runtime.predict(one).flow_px for name in ("torch", "openvino")]
    np.testing.assert_allclose(flows[1], flows[0], atol=1e-3)
