"""A recording, sent to a service as its camera and IMU would have sent it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from viflow_anomaly.client.streaming import ClientStream, StreamAnswer
from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.imu_log import ImuLog
from viflow_anomaly.sensor_data import Frame, ImuSamples

LEAD_NS: Final = 1_000_000_000
"""IMU samples from so long before the first frame on: more than any window looks back."""


class RecordedCall(NamedTuple):
    """A frame and the samples since the one before; the first sample behind the frame is among them, so that the pair
    that ends here can be judged at once."""

    frame: Frame
    imu: ImuSamples | None


def recorded_calls(recording: Recording) -> Iterator[RecordedCall]:
    """What a stream's ``send`` is called with, frame by frame; no sample comes twice and none in between is left out.

    Raises:
        DatasetError: ``image_missing``.
        InvalidInputError: for a frame that cannot be decoded; ``imu_unsorted``, ``imu_duplicate_timestamps``.
    """
    camera = recording.camera
    offset_ns = 0 if camera is None else round(camera.time_offset_s * 1e9)
    sent_ns = int(recording.frame_timestamps_ns[0]) + offset_ns - LEAD_NS
    for k, stamp_ns in enumerate(recording.frame_timestamps_ns.tolist()):
        samples = _samples(recording.imu, sent_ns, stamp_ns + offset_ns)
        yield RecordedCall(recording.frame(k), samples)
        sent_ns = sent_ns if samples is None else int(samples.timestamps_ns[-1])


def _samples(log: ImuLog, sent_ns: int, until_ns: int) -> ImuSamples | None:
    """Those later than ``sent_ns``, up to the first behind ``until_ns``; None: there are none."""
    try:
        found = log.between(sent_ns + 1, until_ns)
    except InvalidInputError as err:
        if err.code != "imu_not_covering":
            raise
        return None  # the service says of which pairs nothing can be said
    new = found.timestamps_ns > sent_ns
    if not new.any():
        return None
    return ImuSamples(
        found.timestamps_ns[new], found.gyro_rad_s[new], None if found.accel_m_s2 is None else found.accel_m_s2[new]
    )


def replay(
    recording: Recording,
    stream: ClientStream,
    *,
    speed: float = 1.0,
    now_s: Callable[[], float] = time.monotonic,
    wait: Callable[[float], None] = time.sleep,
) -> Iterator[StreamAnswer]:
    """Send a recording; an answer for each of its frames.

    A service that is slower than the recording is not overrun: the next frame waits for its answer.

    Args:
        recording: as ``open_recording`` gives it.
        stream: of ``Client.stream``, opened with the recording's camera.
        speed: how many times as fast as it was recorded; 0: as fast as answers come.
        now_s, wait: a clock and how to wait for it, in seconds.

    Raises:
        ServiceError: as ``ClientStream.send``.
        DatasetError, InvalidInputError: as ``recorded_calls``.
    """
    began_s, first_ns = now_s(), int(recording.frame_timestamps_ns[0])
    for call in recorded_calls(recording):
        if speed:
            due_s = began_s + (call.frame.timestamp_ns - first_ns) * 1e-9 / speed
            wait(max(0.0, due_s - now_s()))
        yield stream.send(frame=call.frame, imu=call.imu)
