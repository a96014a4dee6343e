"""A stream of frames and IMU samples to a service: what each call sends, and what it comes to."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, Self
from urllib.parse import quote

from viflow_anomaly.client.encoded_pair import Part, png_file
from viflow_anomaly.client.retry_policy import Attempts, RetryPolicy
from viflow_anomaly.client.service_call import ServiceCall
from viflow_anomaly.client.service_errors import ServiceError, ServiceFaultError
from viflow_anomaly.datasets.camera_json import camera_to_mapping
from viflow_anomaly.detection import Detection, Reason
from viflow_anomaly.detection_reading import detection_from_json
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.sensor_data import Frame, ImuSamples, PinholeCamera

FORGET_TIMEOUT_S: Final = 5.0
"""Whoever has finished, or pressed Ctrl-C, does not wait for a service that hangs."""
_REPEATED: Final = frozenset({"frame_duplicate", "imu_duplicate"})

Ask = Callable[[ServiceCall, Attempts], bytes]
AskAsync = Callable[[ServiceCall, Attempts], Awaitable[bytes]]


@dataclass(frozen=True)
class EncodedFrame:
    """A frame whose image is still a PNG or JPEG file."""

    timestamp_ns: int
    image: bytes


@dataclass(frozen=True)
class StreamAnswer:
    """What one call came to; iterating gives its detections.

    Attributes:
        detections: of the pairs that could be judged now, in time order; none or several.
        faults: what was left out, and why.
        session_id: new whenever the service begins the stream; track ids of one session name the same things.
        begun: this call began it.
        waiting_frames: frames whose pair waits for IMU samples.
        detection_ids: under which the detections are stored; None without a store.
        answer_lost: an earlier attempt at this call had been taken, but its answer did not arrive. Its detections are
            not among these; the service's store has them, if there is one.
    """

    detections: tuple[Detection, ...]
    faults: tuple[Reason, ...]
    session_id: str
    begun: bool
    waiting_frames: int
    detection_ids: tuple[str, ...] | None
    answer_lost: bool = False

    def __iter__(self) -> Iterator[Detection]:
        return iter(self.detections)

    def __len__(self) -> int:
        return len(self.detections)


class _Streaming:
    """What both kinds of stream share: the calls and their answers."""

    def __init__(
        self, url: str, stream_id: str, policy: RetryPolicy, *, camera: PinholeCamera | None, options: Mapping[str, Any]
    ) -> None:
        self._url = url
        self._path = f"/streams/{quote(stream_id, safe='')}"
        self._policy = policy
        self._begun = False
        # Said with every call: a stream that was forgotten meanwhile begins again with the same.
        self._setup: dict[str, Any] = {"options": dict(options)} if options else {}
        if camera is not None:
            self._setup["camera"] = camera_to_mapping(camera)

    def _call(self, frame: Frame | EncodedFrame | None, imu: ImuSamples | None) -> ServiceCall:
        said: dict[str, Any] = {}
        parts: dict[str, Part] = {}
        if imu is not None:
            said = {"timestamps_ns": imu.timestamps_ns.tolist(), "gyro_rad_s": imu.gyro_rad_s.tolist()}
            if imu.accel_m_s2 is not None:
                said["accel_m_s2"] = imu.accel_m_s2.tolist()
        if frame is not None:
            said["frame_timestamp_ns"] = frame.timestamp_ns
            image = png_file(frame.image) if isinstance(frame, Frame) else frame.image
            parts["frame"] = ("frame", image, "application/octet-stream")
        parts["imu"] = ("imu.json", json.dumps(said).encode(), "application/json")
        parts["request"] = ("request.json", json.dumps(self._setup).encode(), "application/json")
        return ServiceCall("POST", f"{self._path}/frames", parts)

    def _answer(self, body: bytes, attempts: Attempts) -> StreamAnswer:
        try:
            said = json.loads(body)
            ids = said["detection_ids"]
            self._begun |= bool(said["begun"])
            faults = tuple(Reason(**fault) for fault in said["faults"])
            return StreamAnswer(
                detections=tuple(detection_from_json(json.dumps(one)) for one in said["detections"]),
                faults=faults,
                session_id=str(said["session_id"]),
                begun=bool(said["begun"]),
                waiting_frames=int(said["waiting_frames"]),
                detection_ids=None if ids is None else tuple(ids),
                answer_lost=attempts.answer_uncertain and any(fault.code in _REPEATED for fault in faults),
            )
        except (ValueError, KeyError, TypeError, RecursionError, InvalidInputError) as err:
            raise ServiceFaultError(
                f"{self._url}: expected the answer of a stream, found {len(body)} bytes that are none",
                code="service_answer_unreadable",
                status=200,
            ) from err

    def _end(self) -> ServiceCall:
        return ServiceCall("DELETE", self._path, timeout_s=FORGET_TIMEOUT_S)


class ClientStream(_Streaming):
    """Of ``Client.stream``. Its calls belong in one thread: the order of frames is their order."""

    def __init__(self, ask: Ask, url: str, stream_id: str, policy: RetryPolicy, *, keep: bool, **setup: Any) -> None:
        super().__init__(url, stream_id, policy, **setup)
        self._ask = ask
        self._keep = keep

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failure: object) -> None:
        if self._begun and not self._keep:
            self.forget()

    def send(self, *, frame: Frame | EncodedFrame | None = None, imu: ImuSamples | None = None) -> StreamAnswer:
        """A frame, IMU samples since the last call, or both; tried again as ``RetryPolicy`` says, which is safe.

        Raises:
            ServiceError: a child of it; the stream then stands where it stood, unless the answer was lost.
        """
        attempts = Attempts(self._policy)
        return self._answer(self._ask(self._call(frame, imu), attempts), attempts)

    def forget(self) -> bool:
        """Let the service forget it now; False: it had been forgotten, or could not be reached."""
        try:
            self._ask(self._end(), Attempts(RetryPolicy(attempts=1)))
        except ServiceError:
            return False
        return True


class AsyncClientStream(_Streaming):
    """Of ``AsyncClient.stream``: ``ClientStream`` for asyncio."""

    def __init__(
        self, ask: AskAsync, url: str, stream_id: str, policy: RetryPolicy, *, keep: bool, **setup: Any
    ) -> None:
        super().__init__(url, stream_id, policy, **setup)
        self._ask = ask
        self._keep = keep

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *failure: object) -> None:
        if self._begun and not self._keep:
            await self.forget()

    async def send(self, *, frame: Frame | EncodedFrame | None = None, imu: ImuSamples | None = None) -> StreamAnswer:
        """As ``ClientStream.send``."""
        attempts = Attempts(self._policy)
        return self._answer(await self._ask(self._call(frame, imu), attempts), attempts)

    async def forget(self) -> bool:
        """As ``ClientStream.forget``."""
        try:
            await self._ask(self._end(), Attempts(RetryPolicy(attempts=1)))
        except ServiceError:
            return False
        return True


def stream_options(model: str | None, include_masks: bool, regions: Mapping[str, Any] | None) -> dict[str, Any]:
    """The ``options`` of a stream, those that are not the service's own."""
    given = {"model": model, "include_masks": include_masks or None, "regions": dict(regions) if regions else None}
    return {name: value for name, value in given.items() if value is not None}
