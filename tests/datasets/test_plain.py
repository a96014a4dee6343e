"""The plain layout's own: camera.json and gyro-only sensors."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worlds import make_world, write_plain

from viflow_anomaly.datasets.camera_json import camera_to_mapping
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.errors import DatasetError, InvalidInputError


def expect(folder: Path, code: str) -> DatasetError:
    with pytest.raises(DatasetError) as caught:
        open_recording(folder)
    assert caught.value.code == code
    assert str(folder / "camera.json") in caught.value.message
    return caught.value


def test_every_camera_field_survives(tmp_path: Path) -> None:
    world = make_world(time_offset_s=0.01)
    camera = replace(world.camera, distortion_model="equidistant", distortion_coeffs=(0.1, 0.2, 0.3, 0.4))
    recording = open_recording(write_plain(tmp_path, replace(world, camera=camera)))
    assert recording.camera is not None
    assert camera_to_mapping(recording.camera) == camera_to_mapping(camera)


def test_imu_survives_exactly(tmp_path: Path) -> None:
    world = make_world()
    imu = open_recording(write_plain(tmp_path, world)).imu
    np.testing.assert_array_equal(imu.timestamps_ns, world.imu.timestamps_ns)
    np.testing.assert_array_equal(imu.gyro_rad_s, world.imu.gyro_rad_s)
    np.testing.assert_array_equal(imu.accel_m_s2, world.imu.accel_m_s2)


def test_gyro_only(tmp_path: Path) -> None:
    recording = open_recording(write_plain(tmp_path, accel=False))
    assert recording.imu.accel_m_s2 is None
    assert recording.imu.gyro_rad_s.shape == (len(recording.imu), 3)


@pytest.mark.parametrize("text", ["{", "", "{'fx': 1}", "[" * 100_000])
def test_camera_that_is_no_json(text: str, tmp_path: Path) -> None:
    folder = write_plain(tmp_path)
    (folder / "camera.json").write_text(text)
    expect(folder, "json_malformed")


def test_camera_with_unknown_field(tmp_path: Path) -> None:
    folder = write_plain(tmp_path)
    mapping = json.loads((folder / "camera.json").read_text())
    (folder / "camera.json").write_text(json.dumps(mapping | {"model": "pinhole"}))
    assert expect(folder, "calibration_malformed").field == "camera.model"


def test_camera_of_another_size_is_refused_with_the_pair(tmp_path: Path) -> None:
    folder = write_plain(tmp_path)
    mapping = json.loads((folder / "camera.json").read_text())
    (folder / "camera.json").write_text(json.dumps(mapping | {"width": 100}))
    with pytest.raises(InvalidInputError) as caught:
        RecordingPairs(open_recording(folder))[0]
    assert caught.value.code == "camera_size_mismatch"
