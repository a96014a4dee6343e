"""The camera object of the JSON contract -> PinholeCamera. Shared by the plain layout and the service."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.sensor_data import DISTORTION_COEFF_COUNTS, Float64Array, PinholeCamera

REQUIRED_FIELDS = ("fx", "fy", "cx", "cy", "width", "height")
OPTIONAL_FIELDS = ("distortion_model", "distortion_coeffs", "T_cam_imu", "time_offset_s")


def camera_from_mapping(mapping: object, *, field: str = "camera") -> PinholeCamera:
    """Build a camera from parsed JSON; unknown fields and wrong types are refused, nothing is converted.

    Args:
        mapping: ``fx fy cx cy width height`` and optionally ``distortion_model``, ``distortion_coeffs``,
            ``T_cam_imu`` (4x4 nested lists or null), ``time_offset_s``.
        field: the prefix of the fields named in errors.

    Raises:
        InvalidInputError: ``camera_invalid`` with the field at fault.
    """
    if not isinstance(mapping, Mapping):
        raise _invalid(field, f"expected an object, found {type(mapping).__name__}")
    for name in mapping:
        if name not in REQUIRED_FIELDS + OPTIONAL_FIELDS:
            known = ", ".join(REQUIRED_FIELDS + OPTIONAL_FIELDS)
            raise _invalid(f"{field}.{name}", f"unknown field; known are {known}")
    values: dict[str, Any] = {name: _number(mapping, name, field) for name in REQUIRED_FIELDS}
    for name in ("width", "height"):
        if not float(values[name]).is_integer():
            raise _invalid(f"{field}.{name}", f"expected a whole number of pixels, found {values[name]}")
        values[name] = int(values[name])
    if "time_offset_s" in mapping:
        values["time_offset_s"] = _number(mapping, "time_offset_s", field)
    values |= _distortion(mapping, field)
    if mapping.get("T_cam_imu") is not None:
        values["T_cam_imu"] = _matrix(mapping["T_cam_imu"], f"{field}.T_cam_imu")
    try:
        return PinholeCamera(**values)
    except InvalidInputError as err:
        place = (err.field or "camera").replace("camera", field, 1)
        raise InvalidInputError(f"{field}: {err.message}", code=err.code, field=place) from err


def camera_to_mapping(camera: PinholeCamera) -> dict[str, object]:
    """The JSON object that ``camera_from_mapping`` reads back to an equal camera."""
    mapping: dict[str, object] = {name: getattr(camera, name) for name in REQUIRED_FIELDS}
    mapping["distortion_model"] = camera.distortion_model
    mapping["distortion_coeffs"] = list(camera.distortion_coeffs)
    if camera.T_cam_imu is not None:
        mapping["T_cam_imu"] = camera.T_cam_imu.tolist()
    mapping["time_offset_s"] = camera.time_offset_s
    return mapping


def _invalid(place: str, problem: str) -> InvalidInputError:
    return InvalidInputError(f"{place}: {problem}", code="camera_invalid", field=place)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= 1e300


def _number(mapping: Mapping[str, Any], name: str, field: str) -> float:
    if name not in mapping:
        raise _invalid(f"{field}.{name}", "expected a number, found nothing")
    value = mapping[name]
    if not _is_number(value):
        raise _invalid(f"{field}.{name}", f"expected a finite number, found {value!r:.80}")
    return float(value)


def _distortion(mapping: Mapping[str, Any], field: str) -> dict[str, Any]:
    values: dict[str, Any] = {}
    if "distortion_model" in mapping:
        model = mapping["distortion_model"]
        if not isinstance(model, str) or model not in DISTORTION_COEFF_COUNTS:
            known = ", ".join(DISTORTION_COEFF_COUNTS)
            raise _invalid(f"{field}.distortion_model", f"expected one of {known}, found {model!r:.80}")
        values["distortion_model"] = model
    if "distortion_coeffs" in mapping:
        coefficients = mapping["distortion_coeffs"]
        listed = isinstance(coefficients, Sequence) and not isinstance(coefficients, str)
        if not listed or not all(_is_number(value) for value in coefficients):
            raise _invalid(f"{field}.distortion_coeffs", f"expected a list of numbers, found {coefficients!r:.80}")
        values["distortion_coeffs"] = tuple(float(value) for value in coefficients)
    return values


def _matrix(value: object, place: str) -> Float64Array:
    rows = value if isinstance(value, Sequence) and not isinstance(value, str) else ()
    good = len(rows) == 4 and all(
        isinstance(row, Sequence) and not isinstance(row, str) and len(row) == 4 and all(_is_number(x) for x in row)
        for row in rows
    )
    if not good:
        raise _invalid(place, f"expected 4 rows of 4 numbers, found {value!r:.80}")
    return np.array(value, dtype=np.float64)
