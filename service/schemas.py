"""The wire shapes of ``POST /detect``: strict types, unknown fields refused. What the values mean is checked below.

Numbers are not asked to be finite here: the library's values refuse NaN themselves, with a code of their own.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, WithJsonSchema
from pydantic_core import PydanticCustomError

from viflow_anomaly.config import DetectorConfig, RegionConfig
from viflow_anomaly.sensor_data import DISTORTION_COEFF_COUNTS

INT64_MAX = int(np.iinfo(np.int64).max)

_NUMBER = {"type": "number"}
CAMERA_SCHEMA = {
    "type": "object",
    "description": "Calibration of the images as they are sent. T_cam_imu maps IMU to camera coordinates (Kalibr), "
    "t_imu = t_cam + time_offset_s.",
    "properties": {
        **dict.fromkeys(("fx", "fy", "cx", "cy"), _NUMBER),
        **{name: {"type": "integer", "minimum": 1} for name in ("width", "height")},
        "distortion_model": {"type": "string", "enum": list(DISTORTION_COEFF_COUNTS)},
        "distortion_coeffs": {"type": "array", "items": _NUMBER},
        "T_cam_imu": {
            "description": "null, as when it is absent: unknown",
            "type": ["array", "null"],
            "items": {"type": "array", "items": _NUMBER, "minItems": 4, "maxItems": 4},
            "minItems": 4,
            "maxItems": 4,
        },
        "time_offset_s": _NUMBER,
    },
    "required": ["fx", "fy", "cx", "cy", "width", "height"],
    "additionalProperties": False,
}


def _in_int64(value: int) -> int:
    if not -INT64_MAX - 1 <= value <= INT64_MAX:
        raise PydanticCustomError("timestamp_out_of_range", "Input should be 64-bit signed nanoseconds")
    return value


def _three(row: list[float]) -> list[float]:
    if len(row) != 3:
        raise PydanticCustomError("imu_wrong_shape", "Input should be 3 numbers, found {count}", {"count": len(row)})
    return row


TimestampNs = Annotated[int, AfterValidator(_in_int64)]
Vector = Annotated[
    list[float],
    AfterValidator(_three),
    WithJsonSchema({"type": "array", "items": _NUMBER, "minItems": 3, "maxItems": 3}),
]


class WireModel(BaseModel):
    """Base of all request shapes."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class ImagePart(WireModel):
    """One image inside a JSON request."""

    timestamp_ns: TimestampNs
    image_base64: str = Field(description="PNG or JPEG file in standard base64 (RFC 4648, section 4)")


class ImuPart(WireModel):
    """IMU samples around the two frames, in time order."""

    timestamps_ns: list[TimestampNs]
    gyro_rad_s: list[Vector]
    accel_m_s2: list[Vector] | None = None


class StampedImuPart(ImuPart):
    """The ``imu`` part of a multipart request, which also carries the stamps of the two images."""

    source_timestamp_ns: TimestampNs
    target_timestamp_ns: TimestampNs


class OptionsPart(WireModel):
    """What this request wants different from the service's configuration."""

    model: str | None = Field(
        default=None, description="one of GET /models, as `name` or `name@version`; the default model when not given"
    )
    include_masks: bool | None = None
    regions: Annotated[dict[str, Any], WithJsonSchema(RegionConfig.model_json_schema())] | None = None

    def applied_to(self, config: DetectorConfig) -> DetectorConfig:
        """The configuration with this request's overrides merged over it.

        Raises:
            pydantic.ValidationError: a region setting that does not exist or is out of range.
        """
        regions = RegionConfig.model_validate({**config.regions.model_dump(), **(self.regions or {})}, strict=True)
        masks = config.include_masks if self.include_masks is None else self.include_masks
        return config.model_copy(update={"regions": regions, "include_masks": masks})


class RequestRest(WireModel):
    """The optional ``request`` part of a multipart request."""

    camera: Annotated[dict[str, Any], WithJsonSchema(CAMERA_SCHEMA)] | None = None
    motor_command: list[float] | None = None
    options: OptionsPart | None = None


class DetectRequest(RequestRest):
    """A whole request in JSON."""

    source: ImagePart
    target: ImagePart
    imu: ImuPart
