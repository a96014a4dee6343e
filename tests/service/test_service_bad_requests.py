"""Each bad input has its status, its code and its field, in both kinds of request; none is a 500."""

from __future__ import annotations

import copy
import json
import struct
import zlib
from typing import Any

import cv2
import numpy as np
import pytest
from service_world import (
    INTERVAL_NS,
    T0,
    LiveServer,
    assert_problem,
    base64_text,
    camera_part,
    form_request,
    gray_image,
    imu_part,
    jpeg,
    json_request,
    png,
    problem_of,
)

GOOD_PNG = png(gray_image())
GOOD_JPEG = jpeg(gray_image())


def gigapixel_png() -> bytes:
    """A well-formed PNG of a few hundred kilobytes at most that claims 50,000 x 50,000 pixels."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", 50_000, 50_000, 8, 0, 0, 0, 0)
    rows = zlib.compress(bytes(1_000_000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


BAD_IMAGES = [
    pytest.param(GOOD_PNG[: len(GOOD_PNG) // 2], 422, "image_truncated_or_corrupt", id="truncated PNG"),
    pytest.param(GOOD_JPEG[: len(GOOD_JPEG) // 2], 422, "image_truncated_or_corrupt", id="truncated JPEG"),
    pytest.param(b"hello, I am a text\n" * 9, 415, "image_unsupported_type", id="text"),
    pytest.param(b"GIF89a" + bytes(60), 415, "image_unsupported_type", id="another image type"),
    pytest.param(b"", 422, "image_empty", id="zero bytes"),
    pytest.param(png(np.zeros((1, 1), np.uint8)), 422, "image_too_small", id="1x1"),
    pytest.param(gigapixel_png(), 413, "image_too_many_pixels", id="gigapixels"),
]


@pytest.mark.parametrize("name", ["source", "target"])
@pytest.mark.parametrize(("data", "status", "code"), BAD_IMAGES)
def test_bad_image_in_form(server: LiveServer, name: str, data: bytes, status: int, code: str) -> None:
    response = server.post_form(form_request(**{name: (f"{name}.png", data, "image/png")}))
    assert_problem(response, status, code, name)


@pytest.mark.parametrize("name", ["source", "target"])
@pytest.mark.parametrize(("data", "status", "code"), BAD_IMAGES)
def test_bad_image_in_json(server: LiveServer, name: str, data: bytes, status: int, code: str) -> None:
    request = json_request()
    request[name]["image_base64"] = base64_text(data)
    assert_problem(server.post_json(request), status, code, f"{name}.image_base64")


def without(members: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in members.items() if name not in names}


def imu_with(**changes: Any) -> dict[str, Any]:
    return imu_part() | changes


STAMPS = imu_part()["timestamps_ns"]
GYRO = imu_part()["gyro_rad_s"]

BAD_IMU = [
    pytest.param(imu_with(timestamps_ns=STAMPS[::-1]), 422, "imu_unsorted", "imu.timestamps_ns", id="unsorted"),
    pytest.param(
        imu_with(timestamps_ns=[STAMPS[0], *STAMPS[:-1]]),
        422,
        "imu_duplicate_timestamps",
        "imu.timestamps_ns",
        id="twice the same stamp",
    ),
    pytest.param({"timestamps_ns": [], "gyro_rad_s": [], "accel_m_s2": []}, 422, "imu_empty", "imu", id="empty"),
    pytest.param(
        imu_with(gyro_rad_s=[[float("nan"), 0, 0], *GYRO[1:]]), 422, "imu_not_finite", "imu.gyro_rad_s", id="NaN"
    ),
    pytest.param(
        imu_with(accel_m_s2=[[0, 0, float("inf")], *GYRO[1:]]), 422, "imu_not_finite", "imu.accel_m_s2", id="infinity"
    ),
    pytest.param(imu_with(gyro_rad_s=GYRO[1:]), 422, "imu_wrong_shape", "imu.gyro_rad_s", id="gyro too short"),
    pytest.param(imu_with(accel_m_s2=[]), 422, "imu_wrong_shape", "imu.accel_m_s2", id="no accelerometer rows"),
    pytest.param(
        imu_with(gyro_rad_s=[*GYRO[:2], [1, 2], *GYRO[3:]]),
        422,
        "imu_wrong_shape",
        "imu.gyro_rad_s.2",
        id="row of two numbers",
    ),
    pytest.param(
        imu_with(gyro_rad_s=[[1, 2, 3, 4], *GYRO[1:]]), 422, "imu_wrong_shape", "imu.gyro_rad_s.0", id="row of four"
    ),
    pytest.param(
        imu_with(gyro_rad_s=[["1", 2, 3], *GYRO[1:]]), 422, "field_invalid", "imu.gyro_rad_s.0.0", id="text number"
    ),
    pytest.param(
        imu_with(gyro_rad_s=[[True, 2, 3], *GYRO[1:]]), 422, "field_invalid", "imu.gyro_rad_s.0.0", id="boolean"
    ),
    pytest.param(imu_with(timestamps_ns=[1.5]), 422, "field_invalid", "imu.timestamps_ns.0", id="fractional stamp"),
    pytest.param(
        imu_with(gyro_rad_s=[[0, 0, -1e300], *GYRO[1:]]), 422, "imu_out_of_range", "imu.gyro_rad_s", id="gyro of 1e300"
    ),
    pytest.param(
        imu_with(accel_m_s2=[[2e9, 0, 0], *GYRO[1:]]), 422, "imu_out_of_range", "imu.accel_m_s2", id="accel of 2e9"
    ),
    pytest.param(
        imu_with(timestamps_ns=[2**63]), 422, "timestamp_out_of_range", "imu.timestamps_ns.0", id="stamp of 64 bits"
    ),
    pytest.param(
        imu_with(timestamps_ns=[-(2**63) - 1]), 422, "timestamp_out_of_range", "imu.timestamps_ns.0", id="stamp below"
    ),
    pytest.param(
        imu_with(timestamps_ns=[-(2**63), *STAMPS[1:]]),
        422,
        "timestamp_out_of_range",
        "imu.timestamps_ns",
        id="stamp whose differences wrap",
    ),
    pytest.param(without(imu_part(), "gyro_rad_s"), 422, "field_missing", "imu.gyro_rad_s", id="no gyro"),
    pytest.param(imu_with(temperature=20), 422, "field_unknown", "imu.temperature", id="unknown field"),
]


@pytest.mark.parametrize(("imu", "status", "code", "place"), BAD_IMU)
def test_bad_imu(server: LiveServer, imu: dict[str, Any], status: int, code: str, place: str) -> None:
    assert_problem(server.post_json(json_request(imu=imu)), status, code, place)
    stamped = json.dumps({"source_timestamp_ns": T0, "target_timestamp_ns": T0 + INTERVAL_NS} | imu)
    assert_problem(server.post_form(form_request(imu=("imu.json", stamped, "application/json"))), status, code, place)


BAD_REST = [
    pytest.param({"camera": camera_part(width=97)}, "camera_size_mismatch", "camera", id="wrong camera size"),
    pytest.param({"camera": without(camera_part(), "fx")}, "camera_invalid", "camera.fx", id="no focal length"),
    pytest.param({"camera": camera_part() | {"fx": float("nan")}}, "camera_invalid", "camera.fx", id="NaN in camera"),
    pytest.param({"camera": camera_part() | {"fx": -1}}, "camera_invalid", "camera.fx", id="negative focal length"),
    pytest.param({"camera": camera_part() | {"zoom": 2}}, "camera_invalid", "camera.zoom", id="unknown camera field"),
    pytest.param(
        {"camera": camera_part() | {"T_cam_imu": [[1, 0, 0]]}}, "camera_invalid", "camera.T_cam_imu", id="not 4x4"
    ),
    pytest.param({"camera": "pinhole"}, "field_invalid", "camera", id="camera as text"),
    *(
        pytest.param(
            {"camera": camera_part() | {name: value}}, "camera_invalid", f"camera.{name}", id=f"{name} of {value}"
        )
        for name, value in [
            ("fx", 2e6),
            ("fx", 0.5),
            ("fy", 2e6),
            ("fy", 0.5),
            ("cx", -2e6),
            ("cy", 2e6),
            ("time_offset_s", -4000),
            ("time_offset_s", 1e300),
        ]
    ),
    pytest.param(
        {"camera": camera_part() | {"distortion_model": "radtan", "distortion_coeffs": [0, 0, 0, -1e7]}},
        "camera_invalid",
        "camera.distortion_coeffs",
        id="distortion beyond any lens",
    ),
    pytest.param({"motor_command": [0.5]}, "motor_command_unsupported", "motor_command", id="motor command"),
    pytest.param({"motor_command": []}, "motor_command_invalid", "motor_command", id="empty motor command"),
    pytest.param({"motor_command": [float("nan")]}, "motor_command_invalid", "motor_command", id="NaN motor command"),
    pytest.param({"motor_command": "full"}, "field_invalid", "motor_command", id="motor command as text"),
    pytest.param({"options": {"colour": 1}}, "field_unknown", "options.colour", id="unknown option"),
    pytest.param({"options": {"include_masks": 1}}, "field_invalid", "options.include_masks", id="mask flag as number"),
    pytest.param(
        {"options": {"regions": {"threshold": 1}}}, "field_unknown", "options.regions.threshold", id="unknown region"
    ),
    pytest.param(
        {"options": {"regions": {"threshold_mads": "7"}}},
        "field_invalid",
        "options.regions.threshold_mads",
        id="region setting as text",
    ),
    pytest.param(
        {"options": {"regions": {"min_area_fraction": 2}}},
        "field_invalid",
        "options.regions.min_area_fraction",
        id="region setting out of range",
    ),
    pytest.param(
        {"options": {"regions": {"threshold_mads": float("inf")}}},
        "field_invalid",
        "options.regions.threshold_mads",
        id="infinite region setting",
    ),
    pytest.param({"optoins": {}}, "field_unknown", "optoins", id="misspelt member"),
]


@pytest.mark.parametrize(("rest", "code", "place"), BAD_REST)
def test_bad_rest(server: LiveServer, rest: dict[str, Any], code: str, place: str) -> None:
    assert_problem(server.post_json(json_request(**rest)), 422, code, place)
    form = form_request(request=("request.json", json.dumps(rest), "application/json"))
    assert_problem(server.post_form(form), 422, code, f"request.{place}")


@pytest.mark.parametrize(
    ("path", "value", "code", "place"),
    [
        (("target", "timestamp_ns"), T0, "target_not_later", "target.timestamp_ns"),
        (("target", "timestamp_ns"), T0 - 1, "target_not_later", "target.timestamp_ns"),
        (("source", "timestamp_ns"), -1, "timestamp_out_of_range", "source.timestamp_ns"),
        (("source", "timestamp_ns"), 2**63, "timestamp_out_of_range", "source.timestamp_ns"),
        (("target", "timestamp_ns"), 2**62 + 1, "timestamp_out_of_range", "target.timestamp_ns"),
        (("source", "timestamp_ns"), 10**400, "field_invalid", "source.timestamp_ns"),
        (("source", "timestamp_ns"), "now", "field_invalid", "source.timestamp_ns"),
        (("source", "image_base64"), 5, "field_invalid", "source.image_base64"),
        (("source", "image_base64"), "!!!!", "image_base64_invalid", "source.image_base64"),
        (("source", "image_base64"), "iVBORw0K\n", "image_base64_invalid", "source.image_base64"),
        (("source", "image_base64"), "iVBOR", "image_base64_invalid", "source.image_base64"),
        (("source", "image_base64"), "iVBORw==iVBORw==", "image_base64_invalid", "source.image_base64"),
        (("source", "image_base64"), "A" * 2**18 + "AAA", "image_base64_invalid", "source.image_base64"),
        (("source", "image_base64"), "A" * 2**18 + "A?==", "image_base64_invalid", "source.image_base64"),
        (("source", "image_base64"), "é", "image_base64_invalid", "source.image_base64"),
        (("source", "image_base64"), "data:image/png;base64,iVBORw==", "image_base64_invalid", "source.image_base64"),
        (("source", "name"), "x", "field_unknown", "source.name"),
        (("source",), None, "field_invalid", "source"),
        (("source",), [], "field_invalid", "source"),
    ],
)
def test_bad_json_member(server: LiveServer, path: tuple[str, ...], value: Any, code: str, place: str) -> None:
    request = copy.deepcopy(json_request())
    parent = request if len(path) == 1 else request[path[0]]
    parent[path[-1]] = value
    assert_problem(server.post_json(request), 422, code, place)


@pytest.mark.parametrize("member", ["source", "target", "imu"])
def test_missing_member(server: LiveServer, member: str) -> None:
    assert_problem(server.post_json(without(json_request(), member)), 422, "field_missing", member)
    assert_problem(server.post_form(form_request(**{member: None})), 422, "field_missing", member)


def test_images_of_different_sizes(server: LiveServer) -> None:
    other = png(gray_image(width=98))
    request = json_request(target={"timestamp_ns": T0 + INTERVAL_NS, "image_base64": base64_text(other)})
    assert_problem(server.post_json(request), 422, "image_sizes_differ", "target")
    form = form_request(target=("t.png", other, "image/png"))
    assert_problem(server.post_form(form), 422, "image_sizes_differ", "target")


@pytest.mark.parametrize(
    ("source_ns", "target_ns", "code", "place"),
    [
        (T0, T0, "target_not_later", "imu.target_timestamp_ns"),
        (-1, T0, "timestamp_out_of_range", "imu.source_timestamp_ns"),
    ],
)
def test_stamps_in_form(server: LiveServer, source_ns: int, target_ns: int, code: str, place: str) -> None:
    imu = imu_part() | {"source_timestamp_ns": source_ns, "target_timestamp_ns": target_ns}
    assert_problem(server.post_form(form_request(imu=("", json.dumps(imu)))), 422, code, place)


def test_form_without_stamps(server: LiveServer) -> None:
    response = server.post_form(form_request(imu=(None, json.dumps(imu_part()))))
    assert_problem(response, 422, "field_missing", "imu.source_timestamp_ns")
    assert problem_of(response)["errors"] == [
        {"code": "field_missing", "field": "imu.target_timestamp_ns", "detail": "Field required"}
    ]


def test_a_camera_without_its_envelope_is_told_in_one_sentence(server: LiveServer) -> None:
    form = form_request(request=("camera.json", json.dumps(camera_part() | {"T_cam_imu": None}), "application/json"))
    response = server.post_form(form)
    assert_problem(response, 422, "field_unknown", "request")
    told = response.json()
    assert "errors" not in told
    assert told["detail"] == (
        'request: expected an object around the camera, {"camera": {"fx": ..., "fy": ..., "cx": ..., "cy": ..., '
        '"width": ..., "height": ...}}, found the camera itself (fx, fy, cx, cy)'
    )
    both = form_request(request=(None, json.dumps({"camera": camera_part(), "fx": 70.0})))
    assert_problem(server.post_form(both), 422, "field_unknown", "request.fx")


def test_unknown_part(server: LiveServer) -> None:
    form = form_request(sauce=("s.png", GOOD_PNG, "image/png"))
    assert_problem(server.post_form(form), 422, "field_unknown", "sauce")


@pytest.mark.parametrize(
    ("body", "status", "code", "place"),
    [
        (b"", 400, "json_invalid", None),
        (b"{", 400, "json_invalid", None),
        (b"\xff\xfe", 400, "json_invalid", None),
        ('﻿{"a": 1}'.encode(), 400, "json_invalid", None),
        (b"[" * 17 + b"]" * 17, 400, "json_too_deep", None),
        (b"[" * 3000 + b"]" * 3000, 400, "json_too_deep", None),
        (b"[" * 100_000, 400, "json_too_deep", None),
        (b'{"a":' * 60 + b"1" + b"}" * 60, 400, "json_too_deep", None),
        (b"[" + b"1," * 210_000 + b"1]", 413, "json_too_many_values", None),
        (b"null", 422, "field_invalid", None),
        (b"[]", 422, "field_invalid", None),
        (b'"text"', 422, "field_invalid", None),
        (b"1" * 10_000, 422, "field_invalid", None),
        (b'{"imu": 1, "imu": 2}', 422, "json_duplicate_key", "imu"),
        (b'{"\\ud800": 1}', 422, "field_invalid", None),
    ],
)
def test_bad_json_text(server: LiveServer, body: bytes, status: int, code: str, place: str | None) -> None:
    assert_problem(server.post_bytes(body), status, code, place)


def test_bad_json_text_in_a_part(server: LiveServer) -> None:
    assert_problem(server.post_form(form_request(imu=(None, "{"))), 400, "json_invalid", "imu")
    assert_problem(server.post_form(form_request(request=(None, ""))), 400, "json_invalid", "request")
    assert_problem(
        server.post_form(form_request(request=(None, '{"a":1,"a":2}'))), 422, "json_duplicate_key", "request"
    )


@pytest.mark.parametrize(
    ("headers", "code", "place"),
    [
        ({"Content-Type": "text/plain"}, "media_type_unsupported", "Content-Type"),
        ({"Content-Type": "application/x-www-form-urlencoded"}, "media_type_unsupported", "Content-Type"),
        ({"Content-Type": "multipart/mixed; boundary=x"}, "media_type_unsupported", "Content-Type"),
        ({"Content-Type": ""}, "media_type_unsupported", "Content-Type"),
        ({}, "media_type_unsupported", "Content-Type"),
        (
            {"Content-Type": "application/json", "Content-Encoding": "gzip"},
            "content_encoding_unsupported",
            "Content-Encoding",
        ),
    ],
)
def test_unsupported_types(server: LiveServer, headers: dict[str, str], code: str, place: str) -> None:
    response = server.client.post("/detect", content=b"{}", headers=headers)
    assert_problem(response, 415, code, place)


def test_json_type_may_carry_a_charset(server: LiveServer) -> None:
    response = server.post_json(json_request(), headers={"Content-Type": "Application/JSON; charset=utf-8"})
    assert response.status_code == 200


@pytest.mark.parametrize(
    ("method", "path", "status", "code"),
    [
        ("GET", "/nowhere", 404, "not_found"),
        ("GET", "/healthz/", 404, "not_found"),
        ("GET", "/detect", 405, "method_not_allowed"),
        ("POST", "/healthz", 405, "method_not_allowed"),
        ("DELETE", "/version", 405, "method_not_allowed"),
    ],
)
def test_router_errors_are_problems(server: LiveServer, method: str, path: str, status: int, code: str) -> None:
    response = server.client.request(method, path)
    assert_problem(response, status, code, None)
    if status == 405:
        assert response.headers["allow"]


def test_color_image_of_16_bits_and_jpeg_are_not_errors(server: LiveServer) -> None:
    deep = png(gray_image().astype(np.uint16) * 257)
    color = bytes(cv2.imencode(".png", cv2.merge([gray_image()] * 3))[1])
    form = form_request(source=("s", deep, "image/png"), target=("t", color, "application/octet-stream"))
    assert server.post_form(form).status_code == 200
    form = form_request(source=("s", GOOD_JPEG, "image/jpeg"))
    assert server.post_form(form).status_code == 200
