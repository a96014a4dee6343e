"""Pictures of a remembered pair, made when somebody asks, by the detector's threads, and kept for the next who asks."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from typing import Any, Final, Literal, Protocol, cast
from weakref import WeakValueDictionary

from viflow_anomaly.errors import ViflowError
from viflow_anomaly.pair_detector import PairDetector
from viflow_anomaly.sensor_data import FramePair
from viflow_anomaly_service.admission import AdmissionGate
from viflow_anomaly_service.detector_pool import DetectorPool, Job
from viflow_anomaly_service.live.pair_memory import RememberedPair
from viflow_anomaly_service.picture_files import picture_file
from viflow_anomaly_service.problems import Problem, problem_of_error
from viflow_anomaly_service.settings import ServiceSettings

PictureName = Literal["source", "target", "residual", "evidence", "flow", "overlay"]
FRAMES: Final = ("source", "target")
MAPS: Final = ("residual", "evidence", "flow")
PICTURES: Final = (*FRAMES, *MAPS, "overlay")
_JPEG_QUALITY: Final = 85
CACHE_BYTES: Final = 32 * 1024 * 1024

Key = tuple[int, str, str]


class Analyzing(Protocol):
    """A detector that shows the maps behind its answer."""

    def analyze(self, pair: FramePair, *, decode_ms: float = 0.0) -> Any: ...


def analyzing(detector: PairDetector) -> Analyzing:
    """The detector, if it can show them.

    Raises:
        Problem: 501 ``maps_unavailable``.
    """
    if not hasattr(detector, "analyze"):
        raise Problem(501, code="maps_unavailable", detail="expected a detector that shows its maps, found another one")
    return cast(Analyzing, detector)


class PairPictures:
    """Makes pictures and remembers them.

    Args:
        pool, gate: where the work is done, and who lets it in: half of the places are never for pictures.
        settings: how long a turn may be waited for.
    """

    def __init__(self, pool: DetectorPool, gate: AdmissionGate, settings: ServiceSettings) -> None:
        self._pool = pool
        self._gate = gate
        self._patience_s = settings.queue_timeout_s
        self._cache: OrderedDict[Key, bytes] = OrderedDict()
        self._cached_bytes = 0
        self._turns: WeakValueDictionary[int, asyncio.Lock] = WeakValueDictionary()

    async def picture(self, remembered: RememberedPair, name: str, suffix: str) -> bytes:
        """An encoded picture; the first map of a pair brings the others with it.

        Raises:
            Problem: 503 ``overloaded``; 501 ``maps_unavailable``.
        """
        key = (remembered.number, name, suffix)
        turn = self._turns.setdefault(remembered.number, asyncio.Lock())
        async with turn:  # who asks for another map of the same pair waits for the one analysis
            if key not in self._cache:
                await self._make(remembered, name, suffix)
            self._cache.move_to_end(key)
            return self._cache[key]

    async def _make(self, remembered: RememberedPair, name: str, suffix: str) -> None:
        async with self._gate.admitted(looking_on=True):
            made = await self._gate.in_turn(
                self._pool, lambda job: _pictures(job, remembered, name, suffix), patience_s=self._patience_s
            )
        for made_name, data in made.items():
            self._keep((remembered.number, made_name, suffix), data)

    def _keep(self, key: Key, data: bytes) -> None:
        self._cached_bytes += len(data) - len(self._cache.pop(key, b""))
        self._cache[key] = data
        while self._cached_bytes > CACHE_BYTES and len(self._cache) > len(MAPS):
            _, oldest = self._cache.popitem(last=False)
            self._cached_bytes -= len(oldest)


def _pictures(job: Job[dict[str, bytes]], remembered: RememberedPair, name: str, suffix: str) -> dict[str, bytes]:
    """In a worker's thread."""
    judged = remembered.judged
    if name in FRAMES:
        return {name: picture_file(getattr(judged.pair, name).image, suffix, jpeg_quality=_JPEG_QUALITY)}
    from viflow_anomaly.drawing import draw_overlay  # noqa: PLC0415 - the pool's threads have loaded what it needs
    from viflow_anomaly.heat_maps import draw_evidence, draw_flow, draw_residual  # noqa: PLC0415

    try:
        analysis = analyzing(judged.detector).analyze(judged.pair)
    except ViflowError as err:
        raise problem_of_error(err) from err
    job.require_wanted()
    if name == "overlay":
        made = {name: draw_overlay(judged.pair.source.image, judged.detection, residual=analysis.residual)}
    else:
        made = {
            "residual": draw_residual(analysis.residual),
            "evidence": draw_evidence(analysis.evidence, learned=analysis.learned),
            "flow": draw_flow(analysis.flow_px),
        }
    return {one: picture_file(picture, suffix, jpeg_quality=_JPEG_QUALITY) for one, picture in made.items()}
