"""The contract's camera object: strict, and a round trip."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from viflow_anomaly.datasets.camera_json import camera_from_mapping, camera_to_mapping
from viflow_anomaly.errors import InvalidInputError

FULL: dict[str, Any] = {
    "fx": 458.654,
    "fy": 457.296,
    "cx": 367.215,
    "cy": 248.375,
    "width": 752,
    "height": 480,
    "distortion_model": "radtan",
    "distortion_coeffs": [-0.28, 0.07, 0.0002, 1.8e-05],
    "T_cam_imu": [[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]],
    "time_offset_s": -0.005,
}
MINIMAL = {name: FULL[name] for name in ("fx", "fy", "cx", "cy", "width", "height")}


def expect(mapping: object, place: str, field: str = "camera") -> str:
    with pytest.raises(InvalidInputError) as caught:
        camera_from_mapping(mapping, field=field)
    assert (caught.value.code, caught.value.field) == ("camera_invalid", place)
    return caught.value.message


def test_round_trip_through_json() -> None:
    camera = camera_from_mapping(json.loads(json.dumps(FULL)))
    assert camera.T_cam_imu is not None
    assert camera_to_mapping(camera) == FULL
    again = camera_from_mapping(json.loads(json.dumps(camera_to_mapping(camera))))
    assert camera_to_mapping(again) == FULL


def test_minimal() -> None:
    camera = camera_from_mapping(MINIMAL)
    assert (camera.distortion_model, camera.distortion_coeffs, camera.T_cam_imu) == ("none", (), None)
    assert camera.time_offset_s == 0.0
    assert "T_cam_imu" not in camera_to_mapping(camera)


def test_null_mounting_is_an_unknown_mounting() -> None:
    assert camera_from_mapping(FULL | {"T_cam_imu": None}).T_cam_imu is None


def test_whole_floats_are_pixels() -> None:
    camera = camera_from_mapping(MINIMAL | {"width": 752.0})
    assert camera.width == 752
    assert isinstance(camera.width, int)


@pytest.mark.parametrize("value", [None, [], "camera", 3])
def test_not_an_object(value: object) -> None:
    expect(value, "camera")


def test_unknown_field() -> None:
    assert "known are fx" in expect(FULL | {"k1": 0.1}, "camera.k1")


@pytest.mark.parametrize("name", MINIMAL)
def test_required_field_missing(name: str) -> None:
    expect({key: value for key, value in FULL.items() if key != name}, f"camera.{name}")


@pytest.mark.parametrize("name", [*MINIMAL, "time_offset_s"])
@pytest.mark.parametrize("value", ["1", None, True, float("nan"), float("inf"), [1.0], 10**400])
def test_not_a_number(name: str, value: object) -> None:
    expect(FULL | {name: value}, f"camera.{name}")


@pytest.mark.parametrize("name", ["width", "height"])
@pytest.mark.parametrize("value", [10.5, 0, -3])
def test_not_a_size(name: str, value: float) -> None:
    expect(FULL | {name: value}, f"camera.{name}")


@pytest.mark.parametrize("value", ["fov", None, 3, ["radtan"]])
def test_unknown_distortion(value: object) -> None:
    expect(FULL | {"distortion_model": value}, "camera.distortion_model")


@pytest.mark.parametrize("value", [None, "0000", 0.1, [0.1, 0.2, "x", 0.0], [0.1], [float("nan")] * 4])
def test_wrong_coefficients(value: object) -> None:
    expect(FULL | {"distortion_coeffs": value}, "camera.distortion_coeffs")


@pytest.mark.parametrize(
    "value",
    [
        "eye",
        7,
        [],
        FULL["T_cam_imu"][:3],
        [*FULL["T_cam_imu"][:3], 1],
        [*FULL["T_cam_imu"][:3], "0001"],
        [*FULL["T_cam_imu"][:3], [0, 0, 1]],
        [*FULL["T_cam_imu"][:3], [0, 0, 0, "1"]],
        (2 * np.eye(4)).tolist(),
    ],
    ids=str,
)
def test_wrong_mounting(value: object) -> None:
    expect(FULL | {"T_cam_imu": value}, "camera.T_cam_imu")


def test_field_names_the_place_in_a_request() -> None:
    expect(FULL | {"fx": "x"}, "body.camera.fx", field="body.camera")
    expect(FULL | {"fx": 0}, "body.camera.fx", field="body.camera")
