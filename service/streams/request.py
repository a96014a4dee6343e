"""Body bytes of one call -> a frame, IMU samples or both. Runs in a worker's thread."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from viflow_anomaly.errors import InvalidInputError, ViflowError
from viflow_anomaly.images import decode_image
from viflow_anomaly.sensor_data import Frame, ImuSamples
from viflow_anomaly_service.detection_request import from_base64, imu_samples, validated, validated_around_camera
from viflow_anomaly_service.form_body import parse_form
from viflow_anomaly_service.json_body import parse_json
from viflow_anomaly_service.problems import Problem, problem_of_error
from viflow_anomaly_service.schemas import ImuPart
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.streams.schemas import StampedStreamSamples, StreamRequest, StreamSetup

FORM_PARTS: Final = ("frame", "imu", "request")
MAX_TIMESTAMP_NS: Final = 2**62
"""About 146 years from zero: sums of stamps and windows stay in 64 bits."""

# The library's field names (left) as the two kinds of call call them.
_FORM_NAMES: Final = {
    "image": "frame",
    "timestamp_ns": "imu.frame_timestamp_ns",
    "camera": "request.camera",
    "options": "request.options",
}
JSON_NAMES: Final = {"image": "frame.image_base64", "timestamp_ns": "frame.timestamp_ns"}


@dataclass(frozen=True)
class StreamInput:
    """What one call brings.

    Attributes:
        frame, imu: at least one of them.
        setup: as it was said; all None where nothing was.
        field_names: the library's field names as this kind of call calls them.
    """

    frame: Frame | None
    imu: ImuSamples | None
    setup: StreamSetup
    field_names: Mapping[str, str]


def read_input(body: bytes, content_type: str, settings: ServiceSettings) -> StreamInput:
    """All that one call says.

    Raises:
        Problem: whatever is wrong with it, with its code and field.
    """
    is_form = content_type.lower().startswith("multipart/")
    image, stamp_ns, imu, setup = _from_form(body, content_type, settings) if is_form else _from_json(body, settings)
    return stream_input(image, stamp_ns, imu, setup, settings=settings, names=_FORM_NAMES if is_form else JSON_NAMES)


def stream_input(
    image: bytes | None,
    stamp_ns: int,
    imu: ImuPart | None,
    setup: StreamSetup,
    *,
    settings: ServiceSettings,
    names: Mapping[str, str],
) -> StreamInput:
    """The parts of one call as the library's values.

    Args:
        image: a PNG or JPEG file, None: no frame.
        stamp_ns: of the frame, where there is one.
        imu, setup: as they were said.
        names: the library's field names as this kind of call calls them.

    Raises:
        Problem: 413, 415 or 422.
    """
    if image is None and imu is None:
        raise Problem(422, code="field_missing", detail="expected a frame, IMU samples, or both", field="frame")
    try:
        samples = None if imu is None else imu_samples(imu, settings.max_imu_samples)
        frame = None if image is None else _frame(image, stamp_ns, settings, names)
    except ViflowError as err:
        raise problem_of_error(err, names) from err
    if samples is not None:
        for stamp in (int(samples.timestamps_ns[0]), int(samples.timestamps_ns[-1])):
            _require_in_range(stamp, "imu.timestamps_ns")
    return StreamInput(frame, samples, setup, names)


_Parts = tuple[bytes | None, int, ImuPart | None, StreamSetup]


def _from_json(body: bytes, settings: ServiceSettings) -> _Parts:
    request = validated(StreamRequest, parse_json(body, max_values=settings.max_json_values))
    setup = StreamSetup(camera=request.camera, options=request.options)
    imu = None if request.imu is None else request.imu.samples()
    if request.frame is None:
        return None, 0, imu, setup
    image = from_base64(request.frame.image_base64, "frame.image_base64")
    return image, request.frame.timestamp_ns, imu, setup


def _from_form(body: bytes, content_type: str, settings: ServiceSettings) -> _Parts:
    parts = parse_form(body, content_type=content_type)
    for name in parts:
        if name not in FORM_PARTS:
            detail = f"expected the parts {', '.join(FORM_PARTS)}, found {name!r:.80}"
            raise Problem(422, code="field_unknown", detail=detail, field=name[:80])

    def json_part(name: str) -> Any:
        return parse_json(parts.get(name, b"{}"), max_values=settings.max_json_values, part=name)

    imu = validated(StampedStreamSamples, json_part("imu"), "imu")
    setup = validated_around_camera(StreamSetup, json_part("request"), "request")
    image = parts.get("frame")
    if (image is None) != (imu.frame_timestamp_ns is None):
        missing = "frame" if image is None else "imu.frame_timestamp_ns"
        detail = f"expected a part frame and its imu.frame_timestamp_ns together, found no {missing}"
        raise Problem(422, code="field_missing", detail=detail, field=missing)
    return image, imu.frame_timestamp_ns or 0, imu.samples(), setup


def _frame(image: bytes, stamp_ns: int, settings: ServiceSettings, names: Mapping[str, str]) -> Frame:
    _require_in_range(stamp_ns, names["timestamp_ns"])
    try:
        return Frame(stamp_ns, decode_image(image, limits=settings.image_limits, field=names["image"]))
    except InvalidInputError as err:
        raise type(err)(f"frame: {err.message}", code=err.code, field=err.field) from err


def _require_in_range(stamp_ns: int, field: str) -> None:
    if abs(stamp_ns) > MAX_TIMESTAMP_NS:
        detail = f"{field}: expected at most {MAX_TIMESTAMP_NS} ns from zero, found {stamp_ns}"
        raise Problem(422, code="timestamp_out_of_range", detail=detail, field=field)
