"""Messages of a WebSocket -> what a call brings. Runs in a worker's thread, but for the short first one.

A text message is JSON. A binary one is four bytes (big endian) that say how long the JSON behind them is, that JSON,
and then the image file, which needs no base64.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, NamedTuple

from pydantic import Field

from viflow_anomaly_service.detection_request import from_base64, validated, validated_around_camera
from viflow_anomaly_service.json_body import parse_json
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.schemas import ImagePart, TimestampNs, WireModel
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.streams.request import JSON_NAMES, StreamInput, stream_input
from viflow_anomaly_service.streams.schemas import StreamSamples, StreamSetup

MAX_OPENING_BYTES: Final = 64 * 1024
LENGTH_BYTES: Final = 4
_BINARY_NAMES: Final = {**JSON_NAMES, "image": "frame"}

MessageId = TimestampNs | Annotated[str, Field(max_length=128)]


class SocketOpening(StreamSetup):
    """The first message: what holds for the stream, and the key where none was shown before."""

    key: str | None = None


class SocketCall(WireModel):
    """A text message: a frame, IMU samples, or both; ``id`` comes back with the answer."""

    id: MessageId | None = None
    frame: ImagePart | None = None
    imu: StreamSamples | None = None


class FrameStamp(WireModel):
    timestamp_ns: TimestampNs


class BinaryHead(WireModel):
    """The JSON at the head of a binary message; with ``frame`` the rest is its image."""

    id: MessageId | None = None
    frame: FrameStamp | None = None
    imu: StreamSamples | None = None


class _Split(NamedTuple):
    head: bytes
    image: bytes


def read_opening(message: str | bytes, settings: ServiceSettings) -> SocketOpening:
    """The first message.

    Raises:
        Problem: 400, 413, 422.
    """
    if isinstance(message, bytes):
        detail = "expected a text message that opens the stream first, found a binary one"
        raise Problem(422, code="opening_missing", detail=detail)
    data = message.encode()
    if len(data) > MAX_OPENING_BYTES:
        detail = f"expected an opening message of at most {MAX_OPENING_BYTES} bytes, found {len(data)}"
        raise Problem(413, code="body_too_large", detail=detail)
    return validated_around_camera(SocketOpening, parse_json(data, max_values=settings.max_json_values))


class MessageReading:
    """Reads one message.

    Attributes:
        id: as the message says it, as soon as that is known.
    """

    def __init__(self, message: str | bytes, setup: StreamSetup, settings: ServiceSettings) -> None:
        self._message = message
        self._setup = setup
        self._settings = settings
        self.id: int | str | None = None

    def __call__(self) -> StreamInput:
        """What the call brings.

        Raises:
            Problem: whatever is wrong with it.
        """
        message = self._message
        if isinstance(message, str):
            call = validated(SocketCall, self._json(message.encode()))
            image = None if call.frame is None else from_base64(call.frame.image_base64, "frame.image_base64")
            return self._input(call, image, JSON_NAMES)
        parts = _split(message)
        head = validated(BinaryHead, self._json(parts.head))
        if (head.frame is None) != (not parts.image):
            found = "an image without" if head.frame is None else "no image behind"
            detail = f"frame: expected an image and its frame.timestamp_ns together, found {found} one"
            raise Problem(422, code="field_missing", detail=detail, field="frame")
        return self._input(head, parts.image or None, _BINARY_NAMES)

    def identify(self) -> None:
        """Find the id of a message that is refused before it is read, if it has one."""
        message = self._message
        try:
            self._json(message.encode() if isinstance(message, str) else _split(message).head)
        except Problem:
            return

    def _json(self, data: bytes) -> Any:
        value = parse_json(data, max_values=self._settings.max_json_values)
        found = value.get("id") if isinstance(value, dict) else None
        if isinstance(found, str | int) and not isinstance(found, bool):
            self.id = found[:128] if isinstance(found, str) else found
        return value

    def _input(self, call: SocketCall | BinaryHead, image: bytes | None, names: dict[str, str]) -> StreamInput:
        imu = None if call.imu is None else call.imu.samples()
        stamp_ns = 0 if call.frame is None else call.frame.timestamp_ns
        return stream_input(image, stamp_ns, imu, self._setup, settings=self._settings, names=names)


def _split(message: bytes) -> _Split:
    end = LENGTH_BYTES + int.from_bytes(message[:LENGTH_BYTES], "big")
    if len(message) < LENGTH_BYTES or end > len(message):
        detail = (
            f"expected {LENGTH_BYTES} bytes of length, then as much JSON, then an image, found {len(message)} bytes"
        )
        raise Problem(400, code="message_invalid", detail=detail)
    return _Split(message[LENGTH_BYTES:end], message[end:])
