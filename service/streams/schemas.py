"""The wire shapes of ``POST /streams/{id}/frames``."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, WithJsonSchema

from viflow_anomaly_service.schemas import (
    CAMERA_SCHEMA,
    ImagePart,
    ImuPart,
    OptionsPart,
    TimestampNs,
    Vector,
    WireModel,
)


class StreamSetup(WireModel):
    """What holds for all of a stream: said in the call that begins it, and left out or repeated in later ones."""

    camera: Annotated[dict[str, Any], WithJsonSchema(CAMERA_SCHEMA)] | None = None
    options: OptionsPart | None = None


class StreamSamples(WireModel):
    """IMU samples since the last call, in time order; may be none."""

    timestamps_ns: list[TimestampNs] = Field(default_factory=list)
    gyro_rad_s: list[Vector] = Field(default_factory=list)
    accel_m_s2: list[Vector] | None = None

    def samples(self) -> ImuPart | None:
        """None where there are none."""
        if not (self.timestamps_ns or self.gyro_rad_s or self.accel_m_s2):
            return None
        return ImuPart(timestamps_ns=self.timestamps_ns, gyro_rad_s=self.gyro_rad_s, accel_m_s2=self.accel_m_s2)


class StampedStreamSamples(StreamSamples):
    """The ``imu`` part of a multipart call, which also carries the frame's stamp."""

    frame_timestamp_ns: TimestampNs | None = Field(default=None, description="with a part `frame`, and only then")


class StreamRequest(StreamSetup):
    """A whole call in JSON: a frame, IMU samples, or both."""

    frame: ImagePart | None = None
    imu: StreamSamples | None = None
