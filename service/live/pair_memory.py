"""The latest judged pairs of every stream, bounded in number and bytes; whoever follows is told of new ones.

All of it happens on the event loop. Followers hold a number, not a queue: who is slow misses pairs and costs nothing.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final
from weakref import WeakSet

from viflow_anomaly.detection import Detection
from viflow_anomaly.inspection import PairSigns
from viflow_anomaly.pair_detector import PairDetector
from viflow_anomaly.sensor_data import FramePair
from viflow_anomaly_service.metrics import ServiceMetrics
from viflow_anomaly_service.models.table import LoadedModel
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.settings import ServiceSettings

UPLOADS: Final = "~uploads"
"""The stream of pairs that were sent to ``POST /inspect``; no real stream can have this name."""
MAX_FOLLOWERS: Final = 64
_PAIR_OVERHEAD_BYTES: Final = 4096


@dataclass(frozen=True, eq=False)
class JudgedPair:
    """A pair as it was judged, and the answer.

    Attributes:
        pair: what the detector was given, corrected by the rig's estimate.
        model: whose detector it was; it counts as one in memory as long as its pairs are remembered.
        detector: with the configuration it was judged under.
        detection, body: the answer, and its JSON.
        signs: of the IMU and the correction.
    """

    pair: FramePair
    model: LoadedModel
    detector: PairDetector
    detection: Detection
    body: str
    signs: PairSigns


@dataclass(frozen=True, eq=False)
class RememberedPair:
    """A judged pair with its place.

    Attributes:
        number: grows from pair to pair over all streams, over restarts of the service, too.
        detection_id: under which the detection is stored.
        rig: the stream's estimate behind this pair, as in ``run.json``.
    """

    number: int
    stream_id: str
    session_id: str
    received_at_ns: int
    judged: JudgedPair
    detection_id: str | None
    rig: dict[str, Any] | None

    @property
    def size_bytes(self) -> int:
        """Neighbours share a frame, so that less is really held."""
        pair = self.judged.pair
        imu = (pair.imu.timestamps_ns, pair.imu.gyro_rad_s, pair.imu.accel_m_s2)
        arrays = (pair.source.image, pair.target.image, *imu)
        return sum(array.nbytes for array in arrays if array is not None) + len(self.judged.body) + _PAIR_OVERHEAD_BYTES

    def to_json(self) -> str:
        """As listed and followed; the detection is what was answered, to the byte."""
        head = {
            "number": self.number,
            "stream_id": self.stream_id,
            "session_id": self.session_id,
            "received_at_ns": self.received_at_ns,
            "detection_id": self.detection_id,
            "rig": self.rig,
            "signs": self.judged.signs._asdict(),
        }
        return f'{json.dumps(head, separators=(",", ":"))[:-1]},"detection":{self.judged.body}}}'


@dataclass
class StreamTally:
    """What a stream came to since it was first remembered.

    Attributes:
        footage_s: between the frames of all pairs that were judged.
        alarms: regions labelled as motion, counted for each pair as ``calibrate`` counts them.
    """

    footage_s: float = 0.0
    pairs: int = 0
    abstained: int = 0
    alarms: int = 0
    numbers: deque[int] = field(default_factory=deque)

    def count(self, judged: JudgedPair) -> None:
        self.pairs += 1
        if judged.detection.status == "abstained":
            self.abstained += 1
            return
        self.footage_s += judged.pair.interval_ns * 1e-9
        self.alarms += sum(roi.label == "independent_motion" for roi in judged.detection.rois)


class PairMemory:
    """Recent pairs by stream.

    Args:
        settings: how many of a stream, how many bytes together.
        metrics: told of the bytes.

    Attributes:
        followers: who follow now.
    """

    def __init__(self, settings: ServiceSettings, metrics: ServiceMetrics) -> None:
        self._most = settings.live_pairs
        self._most_bytes = settings.live_bytes
        self._pairs: dict[int, RememberedPair] = {}
        self._tallies: dict[str, StreamTally] = {}
        self._models_gone: WeakSet[LoadedModel] = WeakSet()
        self._total_bytes = 0
        self._last_number = time.time_ns() // 1_000_000  # later than any of a former process, exact in a double
        self._changed = asyncio.Event()
        self.followers = 0
        self._bytes_gauge = metrics.gauge("viflow_live_bytes", "Images and IMU samples of remembered pairs")

    @property
    def enabled(self) -> bool:
        return self._most > 0

    @property
    def newest_number(self) -> int:
        return self._last_number

    def remember(
        self,
        stream_id: str,
        session_id: str,
        judged: JudgedPair,
        *,
        detection_id: str | None = None,
        rig: dict[str, Any] | None = None,
    ) -> RememberedPair:
        """The newest pair of a stream; the oldest ones make room."""
        self._last_number += 1
        number, now = self._last_number, time.time_ns()
        one = RememberedPair(number, stream_id, session_id, now, judged, detection_id, rig)
        tally = self._tallies.setdefault(stream_id, StreamTally())
        tally.count(judged)
        tally.numbers.append(number)
        self._pairs[number] = one
        self._total_bytes += one.size_bytes
        if len(tally.numbers) > self._most:
            self._drop(tally.numbers[0])
        while self._total_bytes > self._most_bytes and self._pairs:
            self._drop(next(iter(self._pairs)))
        self._bytes_gauge.set(self._total_bytes)
        self._changed.set()
        self._changed = asyncio.Event()
        return one

    def forget(self, stream_id: str) -> None:
        """All pairs of a stream."""
        self._drop_all(one for one in self._pairs.values() if one.stream_id == stream_id)

    def forget_model(self, model: LoadedModel) -> None:
        """All pairs of a model that was unloaded or replaced: they would keep its weights in memory."""
        self._models_gone.add(model)
        self._drop_all(one for one in self._pairs.values() if one.judged.model is model)

    def ended(self, stream_id: str) -> None:
        """A stream judges no more: its pairs stay, but for those of models that were let go meanwhile."""
        tally = self._tallies.get(stream_id)
        kept = [self._pairs[number] for number in tally.numbers] if tally else []
        self._drop_all(one for one in kept if one.judged.model in self._models_gone)

    def streams(self) -> Iterator[tuple[str, StreamTally, RememberedPair]]:
        """Name, tally and newest pair, by name."""
        for stream_id, tally in sorted(self._tallies.items()):
            yield stream_id, tally, self._pairs[tally.numbers[-1]]

    def newest_first(self, stream_id: str) -> list[RememberedPair]:
        """All of a stream.

        Raises:
            Problem: 404 ``stream_not_found``.
        """
        tally = self._tallies.get(stream_id)
        if tally is None:
            detail = f"expected a stream of which pairs are remembered, found {stream_id!r:.80}"
            raise Problem(404, code="stream_not_found", detail=detail)
        return [self._pairs[number] for number in reversed(tally.numbers)]

    def require(self, stream_id: str, number: str) -> RememberedPair:
        """One pair.

        Raises:
            Problem: 404 ``pair_not_found``.
        """
        known = number.isascii() and number.isdecimal() and len(number) <= 20
        found = self._pairs.get(int(number)) if known else None
        if found is None or found.stream_id != stream_id:
            detail = f"expected the number of a pair that is still remembered, found {number!r:.40}"
            raise Problem(404, code="pair_not_found", detail=detail)
        return found

    def find(self, number: int) -> RememberedPair | None:
        """One pair, if it is still remembered."""
        return self._pairs.get(number)

    def numbers_after(self, number: int, stream_id: str | None) -> list[int]:
        """Of what is newer, of one stream or of all, oldest first."""
        if number >= self._last_number:
            return []
        found = []
        for one in reversed(self._pairs.values()):
            if one.number <= number:
                break
            if stream_id in (None, one.stream_id):
                found.append(one.number)
        return found[::-1]

    async def wait(self, seconds: float) -> None:
        """Until there is something new, or so long."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._changed.wait()

    def enter(self) -> None:
        """One more follower, until ``leave``.

        Raises:
            Problem: 503 ``live_full``.
        """
        if self.followers >= MAX_FOLLOWERS:
            detail = f"expected at most {MAX_FOLLOWERS} followers at once, found one more"
            raise Problem(503, code="live_full", detail=detail, retry_after_s=5)
        self.followers += 1

    def leave(self) -> None:
        """A follower that has entered is gone."""
        self.followers -= 1

    def _drop_all(self, pairs: Iterable[RememberedPair]) -> None:
        for number in [one.number for one in pairs]:
            self._drop(number)
        self._bytes_gauge.set(self._total_bytes)

    def _drop(self, number: int) -> None:
        one = self._pairs.pop(number)
        tally = self._tallies[one.stream_id]
        tally.numbers.remove(number)
        if not tally.numbers:
            del self._tallies[one.stream_id]
        self._total_bytes -= one.size_bytes
