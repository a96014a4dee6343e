"""EuRoC's own: sensor.yaml, the direction of T_BS, several cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worlds import make_world, write_euroc, write_euroc_sensor, write_lines

from viflow_anomaly.datasets.euroc import read_camera
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.errors import DatasetError

# cam0/sensor.yaml of EuRoC, and Kalibr's T_cam_imu of the same rig as published with it (camchain, VINS-Mono).
EUROC_T_BS = """
  [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
   0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,
   -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949, 0.0, 0.0, 0.0, 1.0]"""
KALIBR_T_CAM_IMU = np.array(
    [
        [0.01486554298179427, 0.9995572490084118, -0.025774436697440333, 0.06522290953553828],
        [-0.9998809296980949, 0.014967213324719007, 0.00375618835797208, -0.0207063854927833],
        [0.004140296794224258, 0.02571552994799735, 0.9996607271779038, -0.008054602460029998],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


def edited(tmp_path: Path, file: str, old: str, new: str) -> Path:
    folder = write_euroc(tmp_path)
    path = folder / "mav0" / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    return folder


def expect(folder: Path, code: str, file: str = "cam0/sensor.yaml") -> str:
    with pytest.raises(DatasetError) as caught:
        open_recording(folder)
    assert caught.value.code == code
    assert str(folder / "mav0" / file) in caught.value.message
    return caught.value.message


def test_mav0_or_its_parent(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path / "V1_99_test")
    for path in (folder, folder / "mav0"):
        recording = open_recording(path)
        assert recording.name == "V1_99_test"
        assert recording.root == folder / "mav0"


def test_several_cameras(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path, cameras=("cam0", "cam1"))
    (folder / "mav0" / "cam1" / "data.csv").write_text("#\n1403715285312142976,1403715285312142976.png\n")
    assert len(open_recording(folder)) == 6
    assert len(open_recording(folder, camera="cam1")) == 1


def test_the_only_camera_may_be_cam1(tmp_path: Path) -> None:
    assert "cam1" in str(open_recording(write_euroc(tmp_path, cameras=("cam1",))).frame_path(0))


def test_T_cam_imu_is_kalibrs(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path)
    path = folder / "mav0" / "cam0" / "sensor.yaml"
    lines = path.read_text().splitlines()
    lines = [f"  data: {EUROC_T_BS.strip()}" if "data:" in text else text for text in lines]
    path.write_text("\n".join(lines))
    identity = "T_BS: {rows: 4, cols: 4, data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}"
    write_lines(folder / "mav0" / "imu0" / "sensor.yaml", ["%YAML:1.0", identity])
    camera = open_recording(folder).camera
    assert camera is not None
    np.testing.assert_allclose(camera.T_cam_imu, KALIBR_T_CAM_IMU, atol=1e-7)


def test_T_cam_imu_maps_a_point_from_imu_to_camera(tmp_path: Path) -> None:
    # The IMU 0.3 m to the right of the camera and looking alike; body = camera. A point at the IMU's origin lies
    # at x = +0.3 in the camera.
    folder = write_euroc(tmp_path)
    for file, x in (("cam0", 0.0), ("imu0", 0.3)):
        path = folder / "mav0" / file / "sensor.yaml"
        matrix = f"  data: [1, 0, 0, {x}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]"
        write_lines(path, [matrix if "data:" in text else text for text in path.read_text().splitlines()])
    camera = open_recording(folder).camera
    assert camera is not None
    assert camera.T_cam_imu is not None
    np.testing.assert_allclose(camera.T_cam_imu @ (0, 0, 0, 1), (0.3, 0, 0, 1))


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [("none", ()), ("radtan", (-0.28, 0.07, 2e-4, 1.8e-5)), ("equidistant", (0.1, 0.2, 0.3, 0.4))],
)
def test_distortion_and_time_offset_survive(model: str, coefficients: tuple[float, ...], tmp_path: Path) -> None:
    world = make_world(time_offset_s=0.0125)
    camera = replace(world.camera, distortion_model=model, distortion_coeffs=coefficients)  # type: ignore[arg-type]
    found = open_recording(write_euroc(tmp_path, replace(world, camera=camera))).camera
    assert found is not None
    assert (found.distortion_model, found.distortion_coeffs) == (model, coefficients)
    assert found.time_offset_s == 0.0125


def test_kalibrs_names_of_the_models(tmp_path: Path) -> None:
    world = make_world()
    camera = replace(world.camera, distortion_model="radtan", distortion_coeffs=(0.1, 0.0, 0.0, 0.0))
    path = tmp_path / "sensor.yaml"
    write_euroc_sensor(path, camera, np.eye(4))
    path.write_text(path.read_text().replace("radial-tangential", "radtan"))
    found = read_camera(path, tmp_path / "none.yaml")
    assert found is not None
    assert found.distortion_model == "radtan"
    assert found.T_cam_imu is None


def test_numbers_that_yaml_takes_for_text(tmp_path: Path) -> None:
    folder = edited(tmp_path, "cam0/sensor.yaml", "80.0, 80.0", "8e1, 80.0")
    camera = open_recording(folder).camera
    assert camera is not None
    assert camera.fx == 80.0


@pytest.mark.parametrize("file", ["cam0", "imu0"])
def test_mounting_is_unknown_without_the_other_half(file: str, tmp_path: Path) -> None:
    folder = write_euroc(tmp_path)
    path = folder / "mav0" / file / "sensor.yaml"
    if file == "imu0":
        path.unlink()
    else:
        lines = path.read_text().splitlines()
        write_lines(path, [lines[0], *lines[5:]])
    camera = open_recording(folder).camera
    assert camera is not None
    assert camera.T_cam_imu is None


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("camera_model: pinhole", "camera_model: omni"),
        ("distortion_model: none", "distortion_model: fov"),
        ("distortion_model: none", "distortion_model: [radtan]"),
        ("distortion_model: none", "distortion_model: radtan"),
        ("intrinsics: [80.0, 80.0,", "intrinsics: [80.0,"),
        ("intrinsics: [80.0,", "intrinsics: [x,"),
        ("intrinsics: [80.0,", "intrinsics: [.nan,"),
        ("intrinsics: [80.0,", "intrinsics: [null,"),
        ("intrinsics: [80.0,", "intrinsics: [-80.0,"),
        ("intrinsics: [80.0,", "other: [80.0,"),
        ("resolution: [96,", "resolution: [96.5,"),
        ("64]", "64.5]"),
        ("rate_hz: 20", "timeshift_cam_imu: soon"),
        ("T_BS:", "T_BS: 3\nmatrix:"),
        ("  data: [", "  data: [0.0, "),
        (
            "  data: [",
            "  data: [1.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]\n  old: [",
        ),
    ],
)
def test_calibration_malformed(old: str, new: str, tmp_path: Path) -> None:
    expect(edited(tmp_path, "cam0/sensor.yaml", old, new), "calibration_malformed")


def test_imu_without_T_BS(tmp_path: Path) -> None:
    folder = edited(tmp_path, "imu0/sensor.yaml", "T_BS:", "T_SB:")
    expect(folder, "calibration_malformed", "imu0/sensor.yaml")


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        ("-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1", "no rotation"),
        ("1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0.1, 1", "last row 0 0 0 1, found [0.0, 0.0, 0.1, 1.0]"),
        ("1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 2", "last row 0 0 0 1"),
    ],
)
def test_a_T_BS_that_is_not_rigid_is_refused(data: str, problem: str, tmp_path: Path) -> None:
    folder = write_euroc(tmp_path)
    write_lines(folder / "mav0" / "imu0" / "sensor.yaml", [f"T_BS: {{data: [{data}]}}"])
    assert problem in expect(folder, "calibration_malformed", "imu0/sensor.yaml")


@pytest.mark.parametrize("text", ["a: [1, 2", "a: b: c", "\tx", "d: 2001-99-99", "- 1", "", "[" * 5000])
def test_yaml_malformed(text: str, tmp_path: Path) -> None:
    folder = write_euroc(tmp_path)
    (folder / "mav0" / "cam0" / "sensor.yaml").write_text(text)
    expect(folder, "yaml_malformed")


def test_yaml_malformed_names_the_line(tmp_path: Path) -> None:
    folder = edited(tmp_path, "cam0/sensor.yaml", "camera_model: pinhole", "camera_model: pin: hole")
    assert "sensor.yaml, line 8: " in expect(folder, "yaml_malformed")
