"""The one detector of a process: absent while it loads, then there for good."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Any, Protocol, Self

from viflow_anomaly.config import DetectorConfig, MotorSource
from viflow_anomaly.detection import Detection
from viflow_anomaly.sensor_data import FramePair
from viflow_anomaly_service.problems import Problem

logger = logging.getLogger(__name__)


class ModelIdentity(Protocol):
    """Which weights answer."""

    @property
    def name(self) -> str: ...

    @property
    def version(self) -> str: ...

    @property
    def sha256(self) -> str: ...


class PairDetector(Protocol):
    """What the service needs of ``viflow_anomaly.detector.AnomalyDetector``; ``detect`` is called from many threads."""

    @property
    def model_info(self) -> ModelIdentity: ...

    @property
    def config(self) -> DetectorConfig: ...

    @property
    def motor_source(self) -> MotorSource | None: ...

    def with_config(self, config: DetectorConfig) -> Self: ...

    def detect(self, pair: FramePair, *, decode_ms: float = 0.0) -> Detection: ...


class DetectorSlot:
    """Loads the detector in a thread, so that ``/healthz`` answers meanwhile.

    Args:
        load: makes the detector; called once.
        on_failure: told when it could not be made; the slot then stays empty.
    """

    def __init__(self, load: Callable[[], PairDetector], *, on_failure: Callable[[Exception], Any]) -> None:
        self._load = load
        self._on_failure = on_failure
        self._detector: PairDetector | None = None
        self._failed = False

    @property
    def detector(self) -> PairDetector | None:
        return self._detector

    async def fill(self) -> None:
        """Load; never raises, because nobody awaits it before the process ends."""
        try:
            self._detector = await asyncio.to_thread(self._load)
        except Exception as err:
            self._failed = True
            logger.exception("model_load_failed")
            self._on_failure(err)
        else:
            model = self._detector.model_info
            logger.info("model_loaded", extra={"model": model.name, "model_version": model.version})

    def require(self) -> PairDetector:
        """The detector.

        Raises:
            Problem: 503 ``model_loading`` or ``model_load_failed``.
        """
        if self._detector is not None:
            return self._detector
        if self._failed:
            raise Problem(503, code="model_load_failed", detail="The model could not be loaded; see the log.")
        raise Problem(503, code="model_loading", detail="The model is still being loaded.", retry_after_s=2)
