"""The one detector of a process: absent while it loads, then there for good."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import Any

from viflow_anomaly.pair_detector import PairDetector
from viflow_anomaly_service.metrics import ServiceMetrics
from viflow_anomaly_service.problems import Problem

logger = logging.getLogger(__name__)


class DetectorSlot:
    """Loads the detector in a thread, so that ``/healthz`` answers meanwhile.

    Args:
        load: makes the detector; called once.
        prepare: called once with it, before anybody else may use it.
        metrics: told which model it is, once it is there.
        on_failure: told when it could not be made; the slot then stays empty.
    """

    def __init__(
        self,
        load: Callable[[], PairDetector],
        *,
        prepare: Callable[[PairDetector], Awaitable[None]],
        metrics: ServiceMetrics,
        on_failure: Callable[[Exception], Any],
    ) -> None:
        self._load = load
        self._prepare = prepare
        self._metrics = metrics
        self._on_failure = on_failure
        self._detector: PairDetector | None = None
        self._failed = False

    @property
    def detector(self) -> PairDetector | None:
        return self._detector

    async def fill(self) -> None:
        """Load; never raises, because nobody awaits it before the process ends."""
        try:
            detector = await asyncio.to_thread(self._load)
            await self._prepare(detector)
        except Exception as err:
            self._failed = True
            logger.exception("model_load_failed")
            self._on_failure(err)
        else:
            self._detector = detector
            model = detector.model_info
            self._metrics.observe_model(model)
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
