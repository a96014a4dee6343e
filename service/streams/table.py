"""The streams of a process: found by name, one call at a time each, forgotten when idle, bounded in number and bytes.

All of it happens on the event loop; worker threads see the values only that they are given.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
import uuid
from collections import Counter as Tally
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from typing import Any, Final

from prometheus_client import Counter

from viflow_anomaly.stream import StreamState, StreamStep
from viflow_anomaly_service.admission import AdmissionGate
from viflow_anomaly_service.events.event_rules import EndReason, EventState
from viflow_anomaly_service.metrics import ServiceMetrics
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.streams.work import BegunStream

logger = logging.getLogger(__name__)

CALLS_AT_ONCE: Final = 8
"""Of one stream: one is judged, the others wait for their turn."""
LOOK_SECONDS: Final = 1.0


@dataclass(eq=False)
class LiveStream:
    """One stream between its calls.

    Attributes:
        begun: None until a call has begun it.
        state: after the last call that was answered.
        calls: at work or waiting for their turn.
        gone: deleted or expired; whoever still waits begins another one.
        events: what is open, after the same call.
    """

    stream_id: str
    session_id: str = field(default_factory=lambda: uuid.uuid4().hex)
    begun_at_ns: int = field(default_factory=time.time_ns)
    begun: BegunStream | None = None
    state: StreamState = field(default_factory=StreamState)
    turn: asyncio.Lock = field(default_factory=asyncio.Lock)
    calls: int = 0
    gone: bool = False
    used_at: float = field(default_factory=time.monotonic)
    received_frames: int = 0
    received_imu_samples: int = 0
    judged_pairs: int = 0
    faults: Tally[str] = field(default_factory=Tally)
    events: EventState = field(default_factory=EventState)

    @property
    def state_bytes(self) -> int:
        return state_bytes(self.state)

    def status(self) -> dict[str, Any]:
        """Plain JSON values; of a stream that was begun."""
        assert self.begun is not None  # noqa: S101 - ours
        model = self.begun.model
        imu, frames = self.state.imu, self.state.frames
        return {
            "stream_id": self.stream_id,
            "session_id": self.session_id,
            "begun_at_ns": self.begun_at_ns,
            "model": {"name": model.name, "version": model.version},
            "idle_s": round(time.monotonic() - self.used_at, 3),
            "received_frames": self.received_frames,
            "received_imu_samples": self.received_imu_samples,
            "judged_pairs": self.judged_pairs,
            "faults": dict(sorted(self.faults.items())),
            "newest_frame_ns": frames[-1].timestamp_ns if frames else None,
            "newest_imu_ns": None if imu is None else int(imu.timestamps_ns[-1]),
            "kept_frames": len(frames),
            "kept_imu_samples": 0 if imu is None else len(imu),
            "state_bytes": self.state_bytes,
        }


def state_bytes(state: StreamState) -> int:
    """What a state holds in images and samples."""
    total = sum(frame.image.nbytes for frame in state.frames)
    if state.imu is not None:
        arrays = (state.imu.timestamps_ns, state.imu.gyro_rad_s, state.imu.accel_m_s2)
        total += sum(array.nbytes for array in arrays if array is not None)
    return total


class StreamTable:
    """Streams by name.

    Args:
        settings: how many, how large, how long.
        gate: counts who is refused.
        metrics: told of the streams.
        on_forget: called with each stream that is let go, and why.
    """

    def __init__(
        self,
        settings: ServiceSettings,
        gate: AdmissionGate,
        metrics: ServiceMetrics,
        *,
        on_forget: Callable[[LiveStream, EndReason], None] = lambda stream, reason: None,
    ) -> None:
        self._on_forget = on_forget
        self._settings = settings
        self._gate = gate
        self._streams: dict[str, LiveStream] = {}
        self._later_s = round(settings.stream_idle_s) + 1
        self._faults = Counter("viflow_stream_faults", "Faults of streams", ("code",), registry=metrics.registry)
        self._count = metrics.gauge("viflow_streams", "Streams that are remembered")
        self._bytes = metrics.gauge("viflow_stream_bytes", "Images and IMU samples that streams remember")

    def begun(self) -> list[LiveStream]:
        """All streams, by name."""
        return [one for _, one in sorted(self._streams.items()) if one.begun is not None]

    def require(self, stream_id: str) -> LiveStream:
        """A stream.

        Raises:
            Problem: 404 ``stream_not_found``.
        """
        found = self._streams.get(stream_id)
        if found is None or found.begun is None:
            detail = f"expected a stream that was begun and is not forgotten, found {stream_id!r:.80}"
            raise Problem(404, code="stream_not_found", detail=detail)
        return found

    def forget(self, stream: LiveStream, reason: EndReason = "stream_deleted") -> None:
        """Let a stream go; a call at work is still answered."""
        stream.gone = True
        if self._streams.get(stream.stream_id) is stream:
            del self._streams[stream.stream_id]
        self._on_forget(stream, reason)
        self._observe()

    @contextlib.asynccontextmanager
    async def turn(self, stream_id: str) -> AsyncIterator[LiveStream]:
        """The stream, for one call alone, in the order of asking; a new one where there is none.

        Raises:
            Problem: 503 ``streams_full``, ``stream_busy``; ``overloaded`` when no turn came in time.
        """
        patience_s = self._settings.queue_timeout_s
        deadline = time.monotonic() + patience_s
        while True:
            stream = self._streams.get(stream_id) or self._new(stream_id)
            if stream.calls >= CALLS_AT_ONCE:
                detail = f"expected at most {CALLS_AT_ONCE} calls of a stream at once, found more"
                raise Problem(503, code="stream_busy", detail=detail, retry_after_s=1)
            stream.calls += 1
            try:
                try:
                    async with asyncio.timeout(max(0.0, deadline - time.monotonic())):
                        await stream.turn.acquire()
                except TimeoutError as err:
                    raise self._gate.no_turn(patience_s) from err
                try:
                    if not stream.gone:
                        yield stream
                        return
                finally:
                    stream.turn.release()
            finally:
                stream.calls -= 1
                stream.used_at = time.monotonic()
                if stream.begun is None and not stream.calls and not stream.gone:
                    self.forget(stream)  # its first call failed: nothing was begun

    def require_room(self, stream: LiveStream, state: StreamState) -> None:
        """Nothing, if the stream may take this state.

        Raises:
            Problem: 503 ``streams_full``.
        """
        others = sum(one.state_bytes for one in self._streams.values() if one is not stream)
        limit = self._settings.max_stream_bytes
        if others + state_bytes(state) > limit:
            detail = f"expected streams that remember at most {limit} bytes together, found more"
            raise Problem(
                503, code="streams_full", detail=detail, retry_after_s=round(self._settings.stream_idle_s) + 1
            )

    def advance(self, stream: LiveStream, begun: BegunStream, step: StreamStep) -> None:
        """What a call came to becomes what the stream remembers."""
        stream.begun, stream.state = begun, step.state
        stream.judged_pairs += len(step.detections)
        for fault in step.faults:
            stream.faults[fault.code] += 1
            self._faults.labels(fault.code).inc()
        self._observe()

    async def watch(self) -> None:
        """Forget what was idle for too long."""
        while True:
            await asyncio.sleep(min(LOOK_SECONDS, self._settings.stream_idle_s / 2))
            try:
                self._forget_idle()
            except Exception:  # a fault of ours, which must not end the watch
                logger.exception("streams_not_watched")

    def _forget_idle(self) -> None:
        """Apart from the loop, which would keep the last stream that it looked at while it sleeps: images, model."""
        now = time.monotonic()
        for stream in list(self._streams.values()):
            if not stream.calls and now - stream.used_at > self._settings.stream_idle_s:
                self.forget(stream, "stream_expired")
                logger.info("stream_expired", extra={"stream": stream.stream_id, "pairs": stream.judged_pairs})

    def _new(self, stream_id: str) -> LiveStream:
        if len(self._streams) >= self._settings.max_streams:
            detail = f"expected at most {self._settings.max_streams} streams at once, found one more"
            raise Problem(
                503, code="streams_full", detail=detail, retry_after_s=round(self._settings.stream_idle_s) + 1
            )
        stream = self._streams[stream_id] = LiveStream(stream_id)
        return stream

    def _observe(self) -> None:
        self._count.set(len(self._streams))
        self._bytes.set(sum(one.state_bytes for one in self._streams.values()))
