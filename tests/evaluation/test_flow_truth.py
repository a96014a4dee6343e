"""Ground truth that does not belong to a recording, or that lacks what is asked of it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulated_truth import add_ground_truth, add_movers
from worlds import World, make_world, write_euroc

from viflow_anomaly.datasets.camera_json import camera_to_mapping
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.evaluation.flow_truth import RecordingTruth

WORLD = make_world(frames=3)


def record(folder: Path, **changes: Any) -> None:
    """Makes the ground truth of a world one that was rendered for its recording."""
    camera = open_recording(folder).camera
    assert camera is not None
    content: dict[str, Any] = {"camera": camera_to_mapping(camera), "camera_name": "cam0"}
    text = json.dumps(content | changes)
    (folder / "mav0" / "groundtruth0" / "ground_truth.json").write_text(text)


def other(world: World, **changes: Any) -> dict[str, object]:
    return camera_to_mapping(replace(world.camera, **changes))


def refusal(folder: Path, *, movers: bool = True) -> DatasetError:
    with pytest.raises(DatasetError) as raised:
        RecordingTruth(folder, movers=movers)
    return raised.value


def test_rendered_truth_of_the_same_camera(tmp_path: Path) -> None:
    folder = add_ground_truth(tmp_path / "V1", WORLD)
    record(folder)
    assert len(RecordingTruth(folder)) == 2
    camera = open_recording(folder).camera
    assert camera is not None
    assert camera.T_cam_imu is not None
    nudged = camera_to_mapping(replace(camera, T_cam_imu=camera.T_cam_imu + np.eye(4, k=3) * 1e-15))
    record(folder, camera=nudged, camera_name=None)
    assert len(RecordingTruth(folder)) == 2


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"fx": 81.0}, "fx"),
        ({"cy": 30.0}, "cy"),
        ({"width": 90}, "width"),
        ({"distortion_model": "radtan", "distortion_coeffs": (0.1, 0.0, 0.0, 0.0)}, "distortion_model"),
        ({"T_cam_imu": np.eye(4)}, "T_cam_imu"),
        ({"time_offset_s": 0.01}, "time_offset_s"),
    ],
)
def test_rendered_truth_of_another_camera_is_refused(changes: dict[str, Any], key: str, tmp_path: Path) -> None:
    folder = add_ground_truth(tmp_path / "V1", WORLD)
    record(folder, camera=other(WORLD, **changes))
    error = refusal(folder)
    assert (error.code, error.field) == ("ground_truth_camera_differs", "ground_truth")
    assert f"whose {key} is" in error.message


def test_a_second_camera_that_is_like_the_first_is_told_by_its_name(tmp_path: Path) -> None:
    folder = add_ground_truth(tmp_path / "V1", WORLD)
    record(folder, camera_name="cam1")
    error = refusal(folder)
    assert error.code == "ground_truth_camera_differs"
    assert "whose name is 'cam0'" in error.message
    assert "whose name is 'cam1'" in error.message


def test_a_recording_without_calibration_has_only_its_cameras_name(tmp_path: Path) -> None:
    folder = add_ground_truth(tmp_path / "V1", WORLD)
    record(folder)
    (folder / "mav0" / "cam0" / "sensor.yaml").unlink()
    assert len(RecordingTruth(folder)) == 2


def test_what_cannot_move_cannot_be_left_out(tmp_path: Path) -> None:
    folder = add_ground_truth(tmp_path / "drone_1", WORLD)
    error = refusal(folder, movers=False)
    assert (error.code, error.field) == ("ground_truth_no_movers", "movers")
    assert "instances/" in error.message
    assert len(RecordingTruth(add_movers(folder), movers=False)) == 2


def test_without_any_ground_truth(tmp_path: Path) -> None:
    assert refusal(write_euroc(tmp_path / "V1", WORLD)).code == "ground_truth_missing"
