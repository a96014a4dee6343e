"""Poses by time: interpolation in closed form, gaps and ends, and EuRoC's states, sound and broken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds import make_world, write_euroc, write_euroc_sensor, write_lines

from viflow_anomaly.datasets.euroc import read_trajectory
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.datasets.trajectory import MAX_POSE_GAP_NS, Trajectory, rigid, rotations_of
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.geometry import so3_exp, so3_log

START_NS = 1_403_715_285_000_000_000
STEP_NS = 100_000_000
RATE_RAD_S = np.array([0.3, -0.8, 0.5])
VELOCITY_M_S = np.array([1.5, -0.25, 0.5])


def spiral(count: int = 5) -> Trajectory:
    """Constant rate about one axis, constant velocity in the world."""
    seconds = np.arange(count) * STEP_NS * 1e-9
    rotations = np.stack([so3_exp(RATE_RAD_S * t) for t in seconds])
    stamps = START_NS + np.arange(count, dtype=np.int64) * STEP_NS
    return Trajectory(stamps, rigid(rotations, VELOCITY_M_S * seconds[:, None] + (7.0, 8.0, 9.0)), "poses.csv")


@given(st.integers(0, 4 * STEP_NS))
def test_constant_rate_and_straight_line_are_exact_at_any_stamp(elapsed_ns: int) -> None:
    pose = spiral().pose(START_NS + elapsed_ns)
    seconds = elapsed_ns * 1e-9
    np.testing.assert_allclose(pose[:3, :3], so3_exp(RATE_RAD_S * seconds), atol=1e-12)
    np.testing.assert_allclose(pose[:3, 3], VELOCITY_M_S * seconds + (7.0, 8.0, 9.0), atol=1e-12)
    assert pose[3].tolist() == [0, 0, 0, 1]


def test_motion_maps_source_to_target_coordinates() -> None:
    trajectory = spiral()
    source_ns, target_ns = START_NS + 30_000_000, START_NS + 270_000_000
    point_in_source = np.array([0.4, -0.2, 3.0, 1.0])
    in_world = trajectory.pose(source_ns) @ point_in_source
    in_target = trajectory.motion(source_ns, target_ns) @ point_in_source
    np.testing.assert_allclose(trajectory.pose(target_ns) @ in_target, in_world, atol=1e-12)
    turn = so3_log(trajectory.motion(source_ns, target_ns)[:3, :3])
    np.testing.assert_allclose(turn, -RATE_RAD_S * 0.24, atol=1e-12)


def test_displacement_is_along_the_source_cameras_axes() -> None:
    # A camera that looks along the world's x (its z axis is the world's x) and drives that way.
    R_world_cam = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    positions = np.array([[0.0, 0, 0], [2.0, 0, 0]])
    stamps = np.array([0, STEP_NS], dtype=np.int64)
    trajectory = Trajectory(stamps, rigid(np.stack([R_world_cam] * 2), positions), "x")
    np.testing.assert_allclose(trajectory.displacement_m(0, STEP_NS), (0, 0, 2), atol=1e-12)
    np.testing.assert_allclose(trajectory.displacement_m(STEP_NS // 2, STEP_NS), (0, 0, 1), atol=1e-12)


def test_a_returned_pose_is_the_callers() -> None:
    trajectory = spiral()
    trajectory.pose(START_NS)[:] = 0
    assert trajectory.pose(START_NS)[3, 3] == 1


@pytest.mark.parametrize("elapsed_ns", [-1, 4 * STEP_NS + 1])
def test_outside_is_refused(elapsed_ns: int) -> None:
    with pytest.raises(DatasetError, match=rf"poses.csv: expected poses around {START_NS + elapsed_ns}") as caught:
        spiral().pose(START_NS + elapsed_ns)
    assert caught.value.code == "trajectory_not_covering"


@pytest.mark.parametrize(("gap_ns", "covered"), [(MAX_POSE_GAP_NS, True), (MAX_POSE_GAP_NS + 1, False)])
def test_a_gap_is_bridged_up_to_its_limit(gap_ns: int, covered: bool) -> None:
    stamps = np.array([0, gap_ns], dtype=np.int64)
    positions = np.array([[0.0, 0, 0], [gap_ns * 1e-9, 0, 0]])
    trajectory = Trajectory(stamps, rigid(np.stack([np.eye(3)] * 2), positions), "x")
    assert trajectory.pose(gap_ns)[0, 3] == gap_ns * 1e-9  # a pose itself is never in a gap
    if covered:
        assert trajectory.pose(100_000_000)[0, 3] == pytest.approx(0.1)
        return
    with pytest.raises(DatasetError, match=f"found a gap from 0 to {gap_ns}") as caught:
        trajectory.pose(100_000_000)
    assert caught.value.code == "trajectory_not_covering"


@given(st.lists(st.floats(-2, 2), min_size=3, max_size=3), st.floats(0.1, 10))
def test_quaternions_of_any_length_are_rotations(vector: list[float], length: float) -> None:
    angle = float(np.linalg.norm(vector))
    axis = np.array(vector) / angle if angle else np.zeros(3)
    quaternion = length * np.array([np.cos(angle / 2), *(np.sin(angle / 2) * axis)])
    np.testing.assert_allclose(rotations_of(quaternion[None])[0], so3_exp(np.array(vector)), atol=1e-9)


# -- EuRoC's states

POSE_ROWS = ["0,1,2,3,1,0,0,0", "50000000,2,2,3,1,0,0,0"]


def written(folder: Path, rows: list[str]) -> tuple[Path, Path]:
    """The states and the camera's sensor.yaml; the body's axes are the camera's, 0.2 m apart along x."""
    states, sensor = folder / "states.csv", folder / "sensor.yaml"
    write_lines(states, ["#timestamp, p_RS_R_x [m], ...", *rows])
    T_BS_imu = np.eye(4)
    T_BS_imu[0, 3] = 0.2
    camera = make_world(T_cam_imu=np.eye(4)).camera
    write_euroc_sensor(sensor, camera, T_BS_imu)
    return states, sensor


@pytest.mark.parametrize("rest", ["", ",0,0,0,0,0,0,0,0,0"])
def test_states_with_and_without_velocity_and_biases(rest: str, tmp_path: Path) -> None:
    trajectory = read_trajectory(*written(tmp_path, [row + rest for row in POSE_ROWS]))
    assert trajectory is not None
    np.testing.assert_allclose(trajectory.pose(25_000_000)[:3, 3], (1.7, 2, 3))  # 0.2 m from the body's 1.5


def test_the_cameras_place_turns_with_the_body(tmp_path: Path) -> None:
    # The body turned by 90 degrees about z: the camera's 0.2 m along body x lie along world y.
    half = np.sqrt(0.5)
    trajectory = read_trajectory(*written(tmp_path, [f"0,0,0,0,{half},0,0,{half}"]))
    assert trajectory is not None
    np.testing.assert_allclose(trajectory.pose(0)[:3, 3], (0, 0.2, 0), atol=1e-12)


@pytest.mark.parametrize("offset_s", [0.0125, -0.03])
def test_states_of_an_accelerating_body_are_in_the_cameras_clock(offset_s: float, tmp_path: Path) -> None:
    """The states carry the IMU's stamps: t_imu = t_cam + offset."""
    world = make_world(time_offset_s=offset_s, T_cam_imu=np.eye(4))
    folder = write_euroc(tmp_path, world)
    start = int(world.imu.timestamps_ns[0])

    def where(imu_ns: int) -> float:
        return 0.5 * 4.0 * ((imu_ns - start) * 1e-9) ** 2

    rows = [f"{stamp},{where(stamp)!r},0,0,1,0,0,0" for stamp in world.imu.timestamps_ns.tolist()]
    write_lines(folder / "mav0" / "state_groundtruth_estimate0" / "data.csv", rows)
    trajectory = open_recording(folder).trajectory
    assert trajectory is not None
    first, last = world.frame_timestamps_ns[[0, -1]].tolist()
    expected = [where(stamp + round(offset_s * 1e9)) for stamp in (first, last)]
    # The body does not turn, so that the camera moves as it does.
    moved = trajectory.pose(last)[:3, 3] - trajectory.pose(first)[:3, 3]
    np.testing.assert_allclose(moved, (expected[1] - expected[0], 0, 0), atol=1e-4)


@pytest.mark.parametrize("missing", ["states.csv", "sensor.yaml"])
def test_no_trajectory_without_states_or_mounting(missing: str, tmp_path: Path) -> None:
    states, sensor = written(tmp_path, POSE_ROWS)
    (tmp_path / missing).unlink()
    assert read_trajectory(states, sensor) is None


@pytest.mark.parametrize(
    ("rows", "problem"),
    [
        (["0,0,0,0,0,0,0,0"], "line 2: .* a quaternion longer than 0.001, found '0,0,0,0,0,0,0,0'"),
        ([POSE_ROWS[0], "# later", "", "9,0,0,0,0,1e-4,0,0"], "line 5: .* longer than 0.001, found '9,0"),
        ([POSE_ROWS[0], POSE_ROWS[0]], "line 3: expected a later stamp"),
        ([POSE_ROWS[1], "", POSE_ROWS[0]], "line 4: expected a later stamp"),
        (["0,1,2,3,1,0,0"], "expected 17 cells"),
        (["0,1,2,3,1,0,0,nan"], "expected a finite number"),
        ([], "expected rows of"),
    ],
)
def test_malformed_states(rows: list[str], problem: str, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=problem) as caught:
        read_trajectory(*written(tmp_path, rows))
    assert caught.value.code == "csv_malformed"
    assert str(tmp_path / "states.csv") in caught.value.message


def test_states_are_read_when_they_are_asked_for(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path)
    assert open_recording(folder).trajectory is None
    write_lines(folder / "mav0" / "state_groundtruth_estimate0" / "data.csv", ["#", "broken"])
    recording = open_recording(folder)
    with pytest.raises(DatasetError):
        _ = recording.trajectory
