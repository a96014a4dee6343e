"""A recording, sent to a service as its camera and IMU would have sent it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Final, NamedTuple

from viflow_anomaly.client.streaming import ClientStream, StreamAnswer
from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.detection import Reason
from viflow_anomaly.errors import ConfigError, DatasetError, InvalidInputError
from viflow_anomaly.imu_log import ImuLog
from viflow_anomaly.sensor_data import Frame, ImuSamples

LEAD_NS: Final = 1_000_000_000
"""IMU samples from so long before the first frame on: more than any window looks back."""
SAMPLES_A_CALL: Final = 5_000
"""Where a camera pauses for long, its samples come in several calls: a service takes no endless ones."""
SLOWEST, FASTEST = 1e-3, 1e3


class RecordedCall(NamedTuple):
    """What one call sends: a frame and the samples since the call before, with the first one behind the frame where
    there is one, so that the pair that ends here can be judged at once.

    Attributes:
        due_ns: when, in the camera's clock.
        frame: None where samples go ahead of it, and where it cannot be read.
        imu: None where there are none.
        left_out: what of the recording cannot be sent, and why.
    """

    due_ns: int
    frame: Frame | None
    imu: ImuSamples | None
    left_out: tuple[Reason, ...] = ()


def recorded_calls(recording: Recording) -> Iterator[RecordedCall]:
    """What a stream's ``send`` is called with, frame by frame; no sample comes twice and none in between is left out.

    A frame that cannot be read, or samples in disorder, are left out and told, as a camera might drop a frame.
    """
    camera = recording.camera
    offset_ns = 0 if camera is None else round(camera.time_offset_s * 1e9)
    sent_ns = int(recording.frame_timestamps_ns[0]) + offset_ns - LEAD_NS
    for k, stamp_ns in enumerate(recording.frame_timestamps_ns.tolist()):
        left_out, samples, frame = [], None, None
        try:
            samples = _samples(recording.imu, sent_ns, stamp_ns + offset_ns)
        except InvalidInputError as err:
            left_out.append(Reason(err.code, err.message))
            sent_ns = max(sent_ns, stamp_ns + offset_ns)
        try:
            frame = recording.frame(k)
        except (DatasetError, InvalidInputError) as err:
            left_out.append(Reason(err.code, err.message))
        sent_ns = sent_ns if samples is None else int(samples.timestamps_ns[-1])
        *ahead, last = _in_parts(samples)
        yield from (RecordedCall(stamp_ns, None, part) for part in ahead)
        yield RecordedCall(stamp_ns, frame, last, tuple(left_out))


def _samples(log: ImuLog, sent_ns: int, until_ns: int) -> ImuSamples | None:
    """Those later than ``sent_ns``, up to the first behind ``until_ns``; None: there are none."""
    try:
        found = log.between(sent_ns + 1, until_ns)
    except InvalidInputError as err:
        if err.code != "imu_not_covering":
            raise
        return None  # before the first or behind the last: nothing is wrong with what there is
    is_new = found.timestamps_ns > sent_ns
    return _part(found, slice(int(is_new.argmax()), None)) if is_new.any() else None


def _in_parts(samples: ImuSamples | None) -> list[ImuSamples | None]:
    if samples is None:
        return [None]
    starts = range(0, len(samples), SAMPLES_A_CALL)
    return [_part(samples, slice(start, start + SAMPLES_A_CALL)) for start in starts]


def _part(samples: ImuSamples, rows: slice) -> ImuSamples:
    accel_m_s2 = None if samples.accel_m_s2 is None else samples.accel_m_s2[rows]
    return ImuSamples(samples.timestamps_ns[rows], samples.gyro_rad_s[rows], accel_m_s2)


def _taken() -> ConfigError:
    return ConfigError(
        "stream: expected a name that the service does not know yet, found that of a stream that goes on there; choose "
        "another, or have it forgotten (DELETE /streams/NAME)",
        code="stream_taken",
        field="stream",
    )


def replay(
    recording: Recording,
    stream: ClientStream,
    *,
    speed: float = 1.0,
    now_s: Callable[[], float] = time.monotonic,
    wait: Callable[[float], None] = time.sleep,
) -> Iterator[StreamAnswer]:
    """Send a recording; an answer for every call, whose ``faults`` begin with what the recording itself lacks.

    Where a frame cannot be read and there are no samples either, nothing is sent, and the answer says only that. A
    service that is slower than the recording is not overrun: the next frame waits for its answer. Frames whose pair
    waits for samples that the recording does not have are the last answer's ``waiting_frames``.

    Args:
        recording: as ``open_recording`` gives it.
        stream: of ``Client.stream``, opened with the recording's camera.
        speed: how many times as fast as it was recorded; 0: as fast as answers come.
        now_s, wait: a clock and how to wait for it, in seconds.

    Raises:
        ConfigError: ``speed_out_of_range``; ``stream_taken`` where the service knew the stream before.
        DatasetError: ``recording_too_short``.
        ServiceError: as ``ClientStream.send``.
    """
    if speed and not SLOWEST <= speed <= FASTEST:
        raise ConfigError(
            f"speed: expected 0 or {SLOWEST} to {FASTEST:.0f}, found {speed}", code="speed_out_of_range", field="speed"
        )
    if len(recording) < 2:
        raise DatasetError(
            f"{recording.root}: expected at least 2 frames, found {len(recording)}", code="recording_too_short"
        )
    began_s, first_ns = now_s(), int(recording.frame_timestamps_ns[0])
    answer = StreamAnswer((), (), session_id="", begun=False, waiting_frames=0, detection_ids=None)
    for call in recorded_calls(recording):
        if speed:
            due_s = began_s + (call.due_ns - first_ns) * 1e-9 / speed
            wait(max(0.0, due_s - now_s()))
        if call.frame is None and call.imu is None:
            answer = replace(answer, detections=(), faults=call.left_out, begun=False, answer_lost=False)
        else:
            answer, is_first = stream.send(frame=call.frame, imu=call.imu), not answer.session_id
            if is_first and not answer.begun:
                raise _taken()
            answer = replace(answer, faults=(*call.left_out, *answer.faults))
        yield answer
