"""One image pair as it travels: files and JSON texts, the parts of a multipart ``POST /detect``."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2

from viflow_anomaly.datasets.camera_json import camera_to_mapping
from viflow_anomaly.sensor_data import FramePair, ImuSamples, PinholeCamera, Uint8Array

Part = tuple[str, bytes, str]


@dataclass(frozen=True)
class EncodedPair:
    """A pair whose images are still files.

    Args:
        source, target: whole PNG or JPEG files.
        source_timestamp_ns, target_timestamp_ns: their stamps.
        imu: samples around them.
        camera, motor_command: as in ``FramePair``.
    """

    source: bytes
    target: bytes
    source_timestamp_ns: int
    target_timestamp_ns: int
    imu: ImuSamples
    camera: PinholeCamera | None = None
    motor_command: Sequence[float] | None = None

    @classmethod
    def of(cls, pair: FramePair, *, files: tuple[bytes, bytes] | None = None) -> EncodedPair:
        """A pair of arrays, its images written as PNG, or taken from the ``files`` that they were read from."""
        source, target = files or (png_file(pair.source.image), png_file(pair.target.image))
        return cls(
            source=source,
            target=target,
            source_timestamp_ns=pair.source.timestamp_ns,
            target_timestamp_ns=pair.target.timestamp_ns,
            imu=pair.imu,
            camera=pair.camera,
            motor_command=None if pair.motor_command is None else pair.motor_command.tolist(),
        )

    def parts(self, *, include_masks: bool, regions: Mapping[str, Any] | None) -> dict[str, Part]:
        """Name -> (file name, bytes, media type)."""
        imu: dict[str, Any] = {
            "timestamps_ns": self.imu.timestamps_ns.tolist(),
            "gyro_rad_s": self.imu.gyro_rad_s.tolist(),
            "source_timestamp_ns": self.source_timestamp_ns,
            "target_timestamp_ns": self.target_timestamp_ns,
        }
        if self.imu.accel_m_s2 is not None:
            imu["accel_m_s2"] = self.imu.accel_m_s2.tolist()
        rest: dict[str, Any] = {"options": {"include_masks": include_masks}}
        if regions:
            rest["options"]["regions"] = dict(regions)
        if self.camera is not None:
            rest["camera"] = camera_to_mapping(self.camera)
        if self.motor_command is not None:
            rest["motor_command"] = list(self.motor_command)
        return {
            "source": ("source", self.source, "application/octet-stream"),
            "target": ("target", self.target, "application/octet-stream"),
            "imu": ("imu.json", json.dumps(imu).encode(), "application/json"),
            "request": ("request.json", json.dumps(rest).encode(), "application/json"),
        }


def png_file(image: Uint8Array) -> bytes:
    """An image as it is sent."""
    return bytes(cv2.imencode(".png", image)[1])
