"""Body bytes -> what the library asks for. Runs in a worker thread, never on the event loop."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import numpy as np
from pydantic import ValidationError

from viflow_anomaly.config import DetectorConfig
from viflow_anomaly.datasets.camera_json import camera_from_mapping
from viflow_anomaly.errors import InvalidInputError, TooLargeError, ViflowError
from viflow_anomaly.images import decode_image
from viflow_anomaly.motor_input import require_supported
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples
from viflow_anomaly_service.form_body import parse_form
from viflow_anomaly_service.json_body import parse_json
from viflow_anomaly_service.models.table import LoadedModel, ModelSet
from viflow_anomaly_service.problems import Problem, problem_of_error, problem_of_validation
from viflow_anomaly_service.schemas import DetectRequest, ImuPart, RequestRest, StampedImuPart, WireModel
from viflow_anomaly_service.settings import ServiceSettings

FORM_PARTS: Final = {"source": True, "target": True, "imu": True, "request": False}  # name -> must be there

BASE64_SLICE: Final = 2**18
"""Characters decoded at once, a multiple of 4: a call holds up all threads, the event loop's, too, until it returns."""

# The library's field names (left) as the two kinds of request call them.
_FORM_NAMES: Final = {
    "source.image": "source",
    "target.image": "target",
    "source.timestamp_ns": "imu.source_timestamp_ns",
    "target.timestamp_ns": "imu.target_timestamp_ns",
    "camera": "request.camera",
    "motor_command": "request.motor_command",
}
_JSON_NAMES: Final = {"source.image": "source.image_base64", "target.image": "target.image_base64"}

_LENS: Final = ("fx", "fy", "cx", "cy")

Wire = TypeVar("Wire", bound=WireModel)


@dataclass(frozen=True)
class ReceivedPair:
    """One request after its syntax was read: images still encoded, stamps beside them.

    Args:
        images, timestamps_ns: of source and target, by these names.
        imu: wire shape of the samples.
        rest: camera, motor command and options.
        field_names: the library's field names as this kind of request calls them.
        options_place: where the options stand in the request, in dotted form.
    """

    images: Mapping[str, bytes]
    timestamps_ns: Mapping[str, int]
    imu: ImuPart
    rest: RequestRest
    field_names: Mapping[str, str]
    options_place: str


def read_pair(
    models: ModelSet, body: bytes, content_type: str, settings: ServiceSettings
) -> tuple[FramePair, LoadedModel, DetectorConfig, Mapping[str, str]]:
    """All that one request says.

    Args:
        models: of which the request chooses one, whose configuration its options change and whose inputs it must have.
        body: the whole body.
        content_type: ``multipart/form-data; boundary=...``, or anything else for JSON.
        settings: limits.

    Returns:
        The pair, the model, the configuration that it is to be judged under, and the library's field names as this
        kind of request calls them.

    Raises:
        Problem: whatever is wrong with the request, with its code and field.
    """
    is_form = content_type.lower().startswith("multipart/")
    received = read_form(body, content_type, settings) if is_form else read_json(body, settings)
    try:
        options = received.rest.options
        model = models.chosen(None if options is None else options.model, f"{received.options_place}.model")
        config = requested_config(received, model.detector.config)
        pair = frame_pair(received, settings)
        require_supported(pair, model.detector.motor_source)
    except ViflowError as err:
        raise problem_of_error(err, received.field_names) from err
    return pair, model, config, received.field_names


def read_json(body: bytes, settings: ServiceSettings) -> ReceivedPair:
    """A whole request in JSON.

    Raises:
        Problem: 400, 413 or 422 as :func:`parse_json`; 422 for wrong fields and for ``image_base64_invalid``.
    """
    request = validated(DetectRequest, parse_json(body, max_values=settings.max_json_values))
    parts = {"source": request.source, "target": request.target}
    return ReceivedPair(
        images={name: from_base64(part.image_base64, f"{name}.image_base64") for name, part in parts.items()},
        timestamps_ns={name: part.timestamp_ns for name, part in parts.items()},
        imu=request.imu,
        rest=request,
        field_names=_JSON_NAMES,
        options_place="options",
    )


def read_form(body: bytes, content_type: str, settings: ServiceSettings) -> ReceivedPair:
    """A request in multipart/form-data.

    Raises:
        Problem: as :func:`parse_form` and :func:`parse_json`; 422 for missing or unknown parts and wrong fields.
    """
    parts = parse_form(body, content_type=content_type)
    for name in parts:
        if name not in FORM_PARTS:
            detail = f"expected the parts {', '.join(FORM_PARTS)}, found {name!r:.80}"
            raise Problem(422, code="field_unknown", detail=detail, field=name[:80])
    for name, required in FORM_PARTS.items():
        if required and name not in parts:
            detail = f"expected a part {name}, found {', '.join(sorted(parts)) or 'none'}"
            raise Problem(422, code="field_missing", detail=detail, field=name)

    def from_json(name: str) -> Any:
        return parse_json(parts.get(name, b"{}"), max_values=settings.max_json_values, part=name)

    imu = validated(StampedImuPart, from_json("imu"), "imu")
    return ReceivedPair(
        images={"source": parts["source"], "target": parts["target"]},
        timestamps_ns={"source": imu.source_timestamp_ns, "target": imu.target_timestamp_ns},
        imu=imu,
        rest=validated_around_camera(RequestRest, from_json("request"), "request"),
        field_names=_FORM_NAMES,
        options_place="request.options",
    )


def requested_config(received: ReceivedPair, config: DetectorConfig) -> DetectorConfig:
    """The detector's configuration with the request's options merged over it.

    Raises:
        Problem: 422 naming the region setting that does not exist or is out of range.
    """
    if received.rest.options is None:
        return config
    try:
        return received.rest.options.applied_to(config)
    except ValidationError as err:
        raise problem_of_validation(err, f"{received.options_place}.regions") from err


def frame_pair(received: ReceivedPair, settings: ServiceSettings) -> FramePair:
    """The library's value; cheap contradictions are found before the images are decoded.

    Raises:
        InvalidInputError: with the library's field names.
    """
    rest = received.rest
    imu = imu_samples(received.imu, settings.max_imu_samples)
    camera = None if rest.camera is None else camera_from_mapping(rest.camera, field="camera")
    return FramePair(
        source=_frame("source", received, settings),
        target=_frame("target", received, settings),
        imu=imu,
        camera=camera,
        motor_command=None if rest.motor_command is None else np.asarray(rest.motor_command, dtype=np.float64),
    )


def _frame(name: str, received: ReceivedPair, settings: ServiceSettings) -> Frame:
    shown_name = received.field_names[f"{name}.image"]
    image = decode_image(received.images[name], limits=settings.image_limits, field=shown_name)
    try:
        return Frame(timestamp_ns=received.timestamps_ns[name], image=image)
    except InvalidInputError as err:
        raise type(err)(f"{name}: {err.message}", code=err.code, field=f"{name}.{err.field}") from err


def imu_samples(imu: ImuPart, max_samples: int) -> ImuSamples:
    """The library's value.

    Raises:
        InvalidInputError: with the library's field names; ``TooLargeError`` for too many.
    """
    if len(imu.timestamps_ns) > max_samples:
        raise TooLargeError(
            f"imu: expected at most {max_samples} samples, found {len(imu.timestamps_ns)}",
            code="imu_too_many_samples",
            field="imu.timestamps_ns",
        )
    return ImuSamples(
        timestamps_ns=np.asarray(imu.timestamps_ns, dtype=np.int64),
        gyro_rad_s=np.asarray(imu.gyro_rad_s, dtype=np.float64),
        accel_m_s2=None if imu.accel_m_s2 is None else np.asarray(imu.accel_m_s2, dtype=np.float64),
    )


def validated(shape: type[Wire], value: Any, prefix: str | None = None) -> Wire:
    """What JSON says, in a wire shape.

    Raises:
        Problem: 422 with the fields at fault, below ``prefix``.
    """
    try:
        return shape.model_validate(value)
    except ValidationError as err:
        raise problem_of_validation(err, prefix) from err


def validated_around_camera(shape: type[Wire], value: Any, prefix: str | None = None) -> Wire:
    """``validated`` for a shape with a member ``camera``; a camera in its place, which is a file that people have, is
    told in one sentence.

    Raises:
        Problem: 422 with the fields at fault, below ``prefix``.
    """
    if isinstance(value, dict) and "camera" not in value and (bare := [name for name in _LENS if name in value]):
        place = f"{prefix}: " if prefix else ""
        detail = f'{place}expected an object around the camera, {{"camera": {{"fx": ..., "fy": ..., "cx": ..., "cy": '
        detail += f'..., "width": ..., "height": ...}}}}, found the camera itself ({", ".join(bare)})'
        raise Problem(422, code="field_unknown", detail=detail, field=prefix)
    return validated(shape, value, prefix)


def from_base64(text: str, field: str) -> bytes:
    """The bytes of an image.

    Raises:
        Problem: 422 ``image_base64_invalid``.
    """
    slices = (text[start : start + BASE64_SLICE] for start in range(0, len(text), BASE64_SLICE))
    try:
        if "=" in text[:-2]:  # padding within: the whole says best what is wrong with it
            return base64.b64decode(text, validate=True)
        return b"".join(base64.b64decode(part, validate=True) for part in slices)
    except (binascii.Error, ValueError) as err:
        hint = "a data: URL" if text.startswith("data:") else str(err)
        raise Problem(
            422,
            code="image_base64_invalid",
            detail=f"{field}: expected standard base64 without line breaks or prefix, found: {hint}",
            field=field,
        ) from err
