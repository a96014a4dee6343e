"""Whole sequences: the tree, its ground truth against its pictures, and what a second run does."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from small_sequences import small

from viflow_anomaly.datasets.ground_truth_folder import GroundTruthFolder
from viflow_anomaly.errors import ConfigError, MissingDependencyError
from viflow_anomaly.geometry import pixel_grid
from viflow_anomaly.simulator import run
from viflow_anomaly.simulator.config import SimulatorConfig
from viflow_anomaly.simulator.run import simulate


def stamps_of(sequence: Path) -> list[int]:
    return sorted(int(path.stem) for path in (sequence / "mav0/cam0/data").glob("*.png"))


def image(sequence: Path, stamp: int) -> np.ndarray:
    found = cv2.imread(str(sequence / f"mav0/cam0/data/{stamp}.png"), cv2.IMREAD_UNCHANGED)
    assert found is not None
    return found


def contents(sequence: Path) -> dict[str, bytes]:
    return {str(p.relative_to(sequence)): p.read_bytes() for p in sorted(sequence.rglob("*")) if p.is_file()}


def test_tree_is_euroc(sequence: Path) -> None:
    mav0 = sequence / "mav0"
    stamps = stamps_of(sequence)
    assert len(stamps) == 4
    rows = (mav0 / "cam0/data.csv").read_text().splitlines()
    assert rows == ["#timestamp [ns],filename", *(f"{stamp},{stamp}.png" for stamp in stamps)]
    camera = yaml.safe_load((mav0 / "cam0/sensor.yaml").read_text())
    assert camera["camera_model"] == "pinhole"
    assert camera["distortion_model"] == "radial-tangential"
    assert camera["resolution"] == [64, 48]
    imu = yaml.safe_load((mav0 / "imu0/sensor.yaml").read_text())
    assert imu["T_BS"]["data"] == np.eye(4).ravel().tolist()
    assert imu["rate_hz"] in (100, 200)
    states = (mav0 / "state_groundtruth_estimate0/data.csv").read_text().splitlines()[1:]
    assert {row.count(",") for row in states} == {16}
    assert {str(stamp) for stamp in stamps} <= {row.split(",")[0] for row in states}
    picture = image(sequence, stamps[0])
    assert picture.shape == (48, 64)
    assert picture.dtype == np.uint8
    assert 25 < picture.mean() < 210
    assert picture.std() > 5
    for name, count in (("depth", 4), ("instances", 4), ("flow", 3), ("static_flow", 3)):
        assert len(list((mav0 / "groundtruth0" / name).glob("*.png"))) == count


def test_static_flow_carries_the_target_onto_the_source(sequence: Path) -> None:
    truth = GroundTruthFolder(sequence)
    stamps = stamps_of(sequence)
    warped_errors, identity_errors = [], []
    for source_ns, target_ns in itertools.pairwise(stamps):
        flow, valid = truth.static_flow(source_ns, target_ns)
        source, target = (image(sequence, stamp).astype(np.float32) for stamp in (source_ns, target_ns))
        place = pixel_grid(*source.shape) + flow
        warped = cv2.remap(target, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderValue=-1.0)
        judged = valid & (warped >= 0) & (truth.instances(source_ns) == 0)
        warped_errors.append(np.median(np.abs(warped - source)[judged]))
        identity_errors.append(np.median(np.abs(target - source)[judged]))
    assert np.mean(warped_errors) < 0.7 * np.mean(identity_errors)  # what is left is noise and occlusion


def test_flow_is_static_flow_but_on_movers(sequence: Path) -> None:
    truth = GroundTruthFolder(sequence)
    stamps = stamps_of(sequence)
    moved = 0
    for source_ns, target_ns in itertools.pairwise(stamps):
        static, static_valid = truth.static_flow(source_ns, target_ns)
        flow, valid = truth.flow(source_ns)
        instances = truth.instances(source_ns)
        still = instances == 0
        np.testing.assert_array_equal(flow[still], static[still])
        np.testing.assert_array_equal(valid[still], static_valid[still])
        for thing in truth.objects(source_ns):
            mask = instances == thing.instance_id
            assert mask.sum() == thing.area_px
            rows, columns = np.nonzero(mask)
            box = (columns.min(), rows.min(), columns.max(), rows.max())
            assert box == (thing.u_min, thing.v_min, thing.u_max, thing.v_max)
            judged = mask & valid & static_valid
            difference = np.median(np.linalg.norm(flow - static, axis=-1)[judged])
            assert thing.independent_flow_px == pytest.approx(difference, abs=0.05)
            moved += thing.independent_flow_px > 0.05
        numbers = [thing.instance_id for thing in truth.objects(source_ns)]
        assert numbers == sorted(set(instances.ravel()) - {0})
    assert moved > 0


def test_stored_flow_agrees_with_depth_and_poses(sequence: Path) -> None:
    truth = GroundTruthFolder(sequence)
    source_ns, target_ns = stamps_of(sequence)[:2]
    stored, _ = truth.static_flow(source_ns, target_ns)
    (sequence / f"mav0/groundtruth0/static_flow/{source_ns}.png").rename(sequence / "aside.png")
    try:
        again = GroundTruthFolder(sequence)
        computed, _ = again.static_flow(source_ns, target_ns)
    finally:
        (sequence / "aside.png").rename(sequence / f"mav0/groundtruth0/static_flow/{source_ns}.png")
    assert np.abs(stored - computed).max() < 0.1


def test_two_short_flows_compose_to_a_long_one(sequence: Path) -> None:
    truth = GroundTruthFolder(sequence)
    first, _, third = stamps_of(sequence)[:3]
    flow, valid = truth.static_flow(first, third)
    short, _ = truth.static_flow(first, stamps_of(sequence)[1])
    assert valid.mean() > 0.8
    assert np.median(np.linalg.norm(flow, axis=-1)) > 1.2 * np.median(np.linalg.norm(short, axis=-1))


@pytest.mark.parametrize("rig", ["drone", "car"])
def test_static_camera_shows_no_static_flow(gl: None, tmp_path: Path, rig: str) -> None:
    sequence = simulate(small(rig, motion="static", frames=2), tmp_path)[0]
    truth = GroundTruthFolder(sequence)
    first, second = stamps_of(sequence)
    flow, valid = truth.static_flow(first, second)
    assert valid.all()
    assert np.abs(flow).max() == 0.0


def test_rotation_flow_does_not_depend_on_depth(gl: None, tmp_path: Path) -> None:
    sequence = simulate(small("drone", motion="rotation", frames=2, movers=(0, 0)), tmp_path)[0]
    truth = GroundTruthFolder(sequence)
    first, second = stamps_of(sequence)
    assert np.ptp(truth.depth(first)) > 0.2
    flow, valid = truth.static_flow(first, second)
    smooth = cv2.GaussianBlur(flow, (5, 5), 1.0)
    assert np.abs(flow - smooth)[3:-3, 3:-3].max() < 0.05
    assert valid.all()
    assert np.linalg.norm(flow, axis=-1).max() > 0.02


def test_without_movers_masks_are_empty(gl: None, tmp_path: Path) -> None:
    sequence = simulate(small("car", movers=(0, 0), frames=2), tmp_path)[0]
    truth = GroundTruthFolder(sequence)
    for stamp in stamps_of(sequence):
        assert not truth.instances(stamp).any()
        assert truth.objects(stamp) == []


def test_same_seed_same_bytes_whatever_the_run(gl: None, tmp_path: Path) -> None:
    config = small("drone", frames=2, imu_errors=True, seed=10)
    alone = simulate(config.model_copy(update={"seed": 11}), tmp_path / "alone")
    several = simulate(config.model_copy(update={"sequences": 2, "jobs": 2}), tmp_path / "several")
    assert [place.name for place in several] == ["drone_000010", "drone_000011"]
    assert contents(several[1]) == contents(alone[0])
    first, second = (image(place, stamps_of(place)[0]) for place in several)
    assert (first != second).mean() > 0.5


def test_a_second_run_does_only_what_is_missing(gl: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = small("car", frames=2, ground_truth=False)
    first = simulate(config, tmp_path)[0]
    assert not (first / "mav0/groundtruth0").exists()
    marker = first / "mav0/cam0/data.csv"
    marker.write_text("kept")
    (tmp_path / ".car_000001.partial").mkdir()
    (tmp_path / ".car_000001.partial/left_by_a_killed_run").touch()
    seen: list[tuple[int, int]] = []
    both = simulate(
        config.model_copy(update={"sequences": 2}), tmp_path, on_progress=lambda done, of: seen.append((done, of))
    )
    assert marker.read_text() == "kept"
    assert seen == [(2, 2)]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["car_000000", "car_000001"]
    assert not list(both[1].glob("left*"))
    seen.clear()
    monkeypatch.setattr(run, "write_sequence", None)
    simulate(config, tmp_path, on_progress=lambda done, of: seen.append((done, of)))
    assert seen == [(1, 1)]


def test_a_failed_sequence_leaves_nothing(gl: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(config: SimulatorConfig, seed: int, folder: Path) -> None:
        (folder / "half").touch()
        raise MissingDependencyError("gone", code="gl_missing")

    monkeypatch.setattr(run, "write_sequence", fail)
    with pytest.raises(MissingDependencyError):
        simulate(small("car"), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_errors_of_worker_processes_keep_their_code(gl: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "no_such_backend")  # the children import mujoco anew
    with pytest.raises(MissingDependencyError, match="no_such_backend") as raised:
        simulate(small("car", sequences=2, jobs=2), tmp_path)
    assert raised.value.code == "gl_missing"


@pytest.mark.parametrize("note", [None, "not json", "[]"])
def test_a_directory_that_is_no_simulation_is_refused(gl: None, tmp_path: Path, note: str | None) -> None:
    place = tmp_path / "drone_000000"
    place.mkdir()
    if note is not None:
        (place / "simulation.json").write_text(note)
    with pytest.raises(ConfigError, match="without a readable") as raised:
        simulate(small("drone"), tmp_path)
    assert raised.value.code == "simulation_exists"


def test_another_configuration_is_refused(sequence: Path) -> None:
    rig, seed = sequence.name.split("_")
    with pytest.raises(ConfigError, match="expected nothing or a sequence of this configuration") as raised:
        simulate(small(rig, seed=int(seed), frames=5), sequence.parent)
    assert raised.value.code == "simulation_exists"
    record = json.loads((sequence / "simulation.json").read_text())
    assert record["config"]["sequence_seed"] == int(seed)
    assert "jobs" not in record["config"]


def test_sizes_follow_the_rig() -> None:
    assert (SimulatorConfig().width, SimulatorConfig().height) == (384, 256)
    assert (SimulatorConfig(rig="car").width, SimulatorConfig(rig="car").height) == (416, 128)
    assert SimulatorConfig(rig="car", width=100).width == 100


@pytest.mark.parametrize(
    "values",
    [
        {"movers": (-1, 2)},
        {"movers": (3, 2)},
        {"movers": (0, 9)},
        {"rig": "boat"},
        {"frames": 1},
        {"seed": -1},
        {"wheels": 4},
        [],
    ],
)
def test_nonsense_is_refused(values: object) -> None:
    with pytest.raises(ConfigError) as raised:
        SimulatorConfig.from_mapping(values, where="test")
    assert raised.value.code == "config_invalid"
