"""A recording in a room that is known in closed form: flow, occlusions, and how the folder is written."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from room import camera_pose, room_depth, room_flow, sample_room, write_ply, write_room_recording, write_states
from worlds import EUROC, START_NS

from viflow_anomaly.datasets.ground_truth_folder import GroundTruthFolder
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.evaluation.flow_truth import RecordingTruth
from viflow_anomaly.ground_truth.euroc_room import RoomSummary, render_room

CAMERA = EUROC.scaled_to(188, 120)
STEP_NS = 50_000_000
STAMPS = [START_NS + k * STEP_NS for k in range(5)]
# Sideways past the pillar, ahead, and turning: every part of the motion shows in the flow.
POSES = [camera_pose((-0.5 + 0.12 * k, -1.0 + 0.05 * k, 1.3), -0.1 + 0.02 * k, -0.05, 0.03 * k) for k in range(5)]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_room_recording(tmp_path_factory.mktemp("room") / "V9", CAMERA, POSES, sample_room(1500))


@pytest.fixture(scope="module")
def rendered(made: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[RoomSummary, GroundTruthFolder]:
    out = tmp_path_factory.mktemp("truth")
    summary = render_room(made, out=out)
    return summary, GroundTruthFolder(out)


@pytest.fixture
def recording(made: Path, tmp_path: Path) -> Path:
    """Two frames and few points, for what is not about accuracy."""
    folder = tmp_path / "V9"
    shutil.copytree(made, folder)
    lines = (folder / "mav0/cam0/data.csv").read_text().splitlines()
    (folder / "mav0/cam0/data.csv").write_text("\n".join(lines[:3]) + "\n")
    write_ply(folder / "mav0/pointcloud0/data.ply", sample_room(60))
    return folder


def errors(truth: GroundTruthFolder, source: int, target: int) -> NDArray[np.float64]:
    flow, valid = truth.static_flow(STAMPS[source], STAMPS[target])
    exact, _ = room_flow(CAMERA, POSES[source], POSES[target])
    assert valid.mean() > 0.99
    return np.asarray(np.linalg.norm(flow - exact, axis=-1)[valid])


def test_what_was_done_is_said(rendered: tuple[RoomSummary, GroundTruthFolder]) -> None:
    summary, truth = rendered
    assert (summary.frames, summary.rendered, summary.kept, summary.without_pose, summary.with_flow) == (5, 5, 0, 0, 4)
    assert summary.known_share == pytest.approx(1.0, abs=0.01)
    assert summary.folder == truth.folder
    assert truth.source_stamps == tuple(STAMPS)
    assert len(list((truth.folder / "static_flow").iterdir())) == 4


@pytest.mark.parametrize("source", range(4))
def test_flow_to_the_next_frame_is_exact(rendered: tuple[RoomSummary, GroundTruthFolder], source: int) -> None:
    """Closed form by another path: world coordinates and OpenCV's projection. It also tells the direction of time."""
    error = errors(rendered[1], source, source + 1)
    assert np.median(error) < 0.02
    assert np.percentile(error, 95) < 0.1
    there, _ = room_flow(CAMERA, POSES[source], POSES[source + 1])
    back, _ = room_flow(CAMERA, POSES[source + 1], POSES[source])
    assert np.median(np.linalg.norm(there - back, axis=-1)) > 3


@pytest.mark.parametrize(("source", "target"), [(0, 2), (0, 3), (0, 4), (4, 0), (2, 1)])
def test_flow_between_any_two_frames_is_exact(
    rendered: tuple[RoomSummary, GroundTruthFolder], source: int, target: int
) -> None:
    error = errors(rendered[1], source, target)
    assert np.median(error) < 0.05
    assert np.percentile(error, 95) < 0.2


@pytest.mark.parametrize(("source", "target"), [(0, 1), (0, 4), (3, 1)])
def test_occluded_is_what_the_pillar_hides(
    rendered: tuple[RoomSummary, GroundTruthFolder], source: int, target: int
) -> None:
    flow, there = room_flow(CAMERA, POSES[source], POSES[target])
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    column, row = np.rint(u + flow[..., 0]).astype(int), np.rint(v + flow[..., 1]).astype(int)
    inside = (column >= 1) & (column < CAMERA.width - 1) & (row >= 1) & (row < CAMERA.height - 1)
    seen = room_depth(CAMERA, POSES[target])[row.clip(0, CAMERA.height - 1), column.clip(0, CAMERA.width - 1)]
    hidden = inside & (there > 1.1 * seen)
    found = rendered[1].occluded(STAMPS[source], STAMPS[target])
    assert hidden.sum() > 100
    # They differ along outlines, by less than a pixel's width.
    assert (found & hidden).sum() > 0.75 * hidden.sum()
    assert (found & ~hidden).sum() < 0.25 * hidden.sum()
    outside = (column < -1) | (column > CAMERA.width) | (row < -1) | (row > CAMERA.height)
    assert outside.any()
    assert not found[outside].any()


def test_the_folder_stands_alone(rendered: tuple[RoomSummary, GroundTruthFolder]) -> None:
    """Camera and poses are in it: the recording need not be there."""
    truth = rendered[1]
    assert truth.camera.distortion_model == "radtan"
    assert truth.camera.distortion_coeffs == CAMERA.distortion_coeffs
    np.testing.assert_allclose(truth.camera_pose(STAMPS[3]), POSES[3], atol=1e-9)
    record = json.loads((truth.folder / "ground_truth.json").read_text())
    assert record["recording"] == "V9"
    assert record["made_from"]["cloud"]["file"] == "data.ply"
    assert len(record["made_from"]["cloud"]["sha256"]) == 64


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_second_run_makes_what_is_missing_and_the_same_bytes(recording: Path) -> None:
    """It lies in mav0 by default, where what reads ground truth beside a recording finds it."""
    render_room(recording)
    truth = GroundTruthFolder.find(recording)
    assert truth is not None
    first = contents(truth.folder)
    (truth.folder / "depth" / f"{STAMPS[0]}.png").unlink()
    (truth.folder / "static_flow" / f"{STAMPS[0]}.png").write_bytes(b"half")
    calls: list[tuple[int, int]] = []
    summary = render_room(recording, on_progress=lambda done, total: calls.append((done, total)))
    assert (summary.rendered, summary.kept) == (1, 1)
    assert contents(truth.folder) == first
    assert calls == [(1, 2), (2, 2)]
    assert render_room(recording).known_share is None


def test_other_files_need_overwrite(recording: Path) -> None:
    render_room(recording)
    write_ply(recording / "mav0/pointcloud0/data.ply", sample_room(60, seed=1))
    before = contents(recording / "mav0/groundtruth0")
    with pytest.raises(DatasetError, match="--overwrite") as raised:
        render_room(recording)
    assert raised.value.code == "ground_truth_differs"
    assert contents(recording / "mav0/groundtruth0") == before
    assert render_room(recording, overwrite=True).rendered == 2
    assert contents(recording / "mav0/groundtruth0") != before


def test_other_states_need_overwrite(recording: Path) -> None:
    """Pictures of the old poses beside a table of the new ones would be told by nothing."""
    render_room(recording)
    write_states(recording / "mav0", [POSES[1], POSES[0]], STAMPS[:2])
    before = contents(recording / "mav0/groundtruth0")
    with pytest.raises(DatasetError, match="poses") as raised:
        render_room(recording)
    assert raised.value.code == "ground_truth_differs"
    assert contents(recording / "mav0/groundtruth0") == before
    render_room(recording, overwrite=True)
    np.testing.assert_allclose(GroundTruthFolder(recording).camera_pose(STAMPS[0]), POSES[1], atol=1e-9)


def test_another_camera_needs_overwrite(recording: Path) -> None:
    shutil.copytree(recording / "mav0/cam0", recording / "mav0/cam1")
    render_room(recording)
    with pytest.raises(DatasetError) as raised:
        render_room(recording, camera="cam1")
    assert raised.value.code == "ground_truth_differs"
    render_room(recording, camera="cam1", overwrite=True)
    assert GroundTruthFolder(recording).camera_name == "cam1"
    with pytest.raises(DatasetError) as raised:
        RecordingTruth(recording)
    assert raised.value.code == "ground_truth_camera_differs"


def test_flow_that_is_not_there_is_made_not_counted(recording: Path) -> None:
    folder = render_room(recording).folder
    (folder / "static_flow" / f"{STAMPS[0]}.png").unlink()
    again = render_room(recording)
    assert (again.rendered, again.kept, again.with_flow) == (1, 1, 1)
    assert (folder / "static_flow" / f"{STAMPS[0]}.png").is_file()


def test_a_pose_more_than_before_needs_overwrite(recording: Path) -> None:
    """The frame before it would stay without flow."""
    write_states(recording / "mav0", POSES[:1], STAMPS[:1])
    assert render_room(recording).with_flow == 0
    write_states(recording / "mav0", POSES, STAMPS)
    with pytest.raises(DatasetError) as raised:
        render_room(recording)
    assert raised.value.code == "ground_truth_differs"
    assert render_room(recording, overwrite=True).with_flow == 1


def test_states_are_of_the_imus_clock(recording: Path) -> None:
    sensor = recording / "mav0/cam0/sensor.yaml"
    shift_ns = 2_000_000
    sensor.write_text(sensor.read_text() + "timeshift_cam_imu: 0.002\n")
    write_states(recording / "mav0", POSES, [stamp + shift_ns for stamp in STAMPS])
    assert render_room(recording).rendered == 2
    np.testing.assert_allclose(GroundTruthFolder(recording).camera_pose(STAMPS[1]), POSES[1], atol=1e-9)


@pytest.mark.parametrize("overwrite", [False, True])
def test_ground_truth_of_other_origin_is_never_written_over(recording: Path, *, overwrite: bool) -> None:
    foreign = recording / "mav0/groundtruth0/depth/1.png"
    foreign.parent.mkdir(parents=True)
    foreign.write_bytes(b"exact")
    with pytest.raises(DatasetError, match="--out") as raised:
        render_room(recording, overwrite=overwrite)
    assert raised.value.code == "ground_truth_foreign"
    assert foreign.read_bytes() == b"exact"


def test_frames_without_a_pose_are_left_out(recording: Path) -> None:
    write_states(recording / "mav0", POSES[:1], STAMPS[:1])
    summary = render_room(recording)
    assert (summary.rendered, summary.without_pose, summary.with_flow) == (1, 1, 0)
    assert not list((summary.folder / "static_flow").iterdir())


def test_poses_from_a_file(recording: Path, tmp_path: Path) -> None:
    states = recording / "mav0/state_groundtruth_estimate0/data.csv"
    states.rename(tmp_path / "poses.csv")
    with pytest.raises(DatasetError, match="--trajectory") as raised:
        render_room(recording)
    assert raised.value.code == "trajectory_missing"
    assert render_room(recording, trajectory=tmp_path / "poses.csv").rendered == 2


def test_poses_of_another_time_are_refused(recording: Path) -> None:
    write_states(recording / "mav0", POSES, [stamp + 10**12 for stamp in STAMPS])
    with pytest.raises(DatasetError, match="within 1 ms") as raised:
        render_room(recording)
    assert raised.value.code == "trajectory_not_covering"


def test_without_calibration_there_is_no_truth(recording: Path) -> None:
    (recording / "mav0/cam0/sensor.yaml").unlink()
    with pytest.raises(DatasetError, match="calibrated camera") as raised:
        render_room(recording)
    assert raised.value.code == "camera_missing"


@pytest.mark.parametrize("key", ["T_WS", "T_BS"])
def test_a_cloud_elsewhere_with_a_pose_of_its_own(recording: Path, tmp_path: Path, key: str) -> None:
    T_world_cloud = camera_pose((1.0, -2.0, 0.5), 0.7)
    points = (sample_room(300) - T_world_cloud[:3, 3]) @ T_world_cloud[:3, :3]
    write_ply(tmp_path / "scan" / "room.ply", points.astype(np.float32))
    data = T_world_cloud.reshape(-1).tolist()
    (tmp_path / "scan" / "sensor.yaml").write_text(f"{key}:\n  cols: 4\n  rows: 4\n  data: {data}\n")
    render_room(recording, cloud=tmp_path / "scan" / "room.ply")
    depth = GroundTruthFolder(recording).depth(STAMPS[0])
    assert np.median(np.abs(depth - room_depth(CAMERA, POSES[0]))) < 0.01


def test_a_missing_cloud_is_named(recording: Path) -> None:
    (recording / "mav0/pointcloud0/data.ply").unlink()
    with pytest.raises(DatasetError, match=r"pointcloud0.data\.ply") as raised:
        render_room(recording)
    assert raised.value.code == "point_cloud_missing"
