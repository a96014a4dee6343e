"""The models of a process by name: absent while they load, exchanged whole, kept by whoever began with them.

Changes happen on the event loop; a request works with the ``ModelSet`` that it found when it came, in any thread.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import time
import weakref
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from viflow_anomaly.errors import ViflowError
from viflow_anomaly.pair_detector import PairDetector
from viflow_anomaly_service.metrics import ServiceMetrics
from viflow_anomaly_service.models.named import DEFAULT_NAME
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.settings import ServiceSettings

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class LoadedModel:
    """One of them; ``loaded_at_ns`` is Unix time, ``calibration`` the file that its detector was made with."""

    name: str
    detector: PairDetector
    calibration: Path | None = None
    loaded_at_ns: int = field(default_factory=time.time_ns)

    @property
    def version(self) -> str:
        return self.detector.model_info.version

    def is_called(self, wanted: str) -> bool:
        """By its name, or ``name@version``; the version with what follows its plus or without."""
        versions = (self.version, self.version.partition("+")[0])
        return wanted in (self.name, *(f"{self.name}@{version}" for version in versions))


@dataclass(frozen=True)
class ModelSet:
    """The models of one moment."""

    models: tuple[LoadedModel, ...]
    default_name: str = DEFAULT_NAME

    @property
    def default(self) -> LoadedModel:
        return next(one for one in self.models if one.name == self.default_name)

    def find(self, name: str) -> LoadedModel | None:
        return next((one for one in self.models if one.name == name), None)

    def chosen(self, wanted: str | None, field: str) -> LoadedModel:
        """The one that a request asks for, or the default.

        Raises:
            Problem: 422 ``model_unknown`` in ``field``.
        """
        if wanted is None:
            return self.default
        for one in self.models:
            if one.is_called(wanted):
                return one
        loaded = ", ".join(f"{one.name}@{one.version}" for one in self.models)
        detail = f"{field}: expected one of {loaded}, found {wanted!r:.80}"
        raise Problem(422, code="model_unknown", detail=detail, field=field)


class ModelTable:
    """Loads models in threads, so that ``/healthz`` answers and running models judge meanwhile.

    Args:
        settings: of the service: what is loaded at its start, and how many models there may be.
        load: makes the detector that such settings describe.
        prepare: called once with each, before anybody else may use it.
        on_let_go: told of each that was unloaded or replaced, so that nobody keeps it without need.
        metrics: told which models there are.
        on_failure: told when one of the start could not be made; there are none then.
    """

    def __init__(
        self,
        settings: ServiceSettings,
        load: Callable[[ServiceSettings], PairDetector],
        *,
        prepare: Callable[[PairDetector], Awaitable[None]],
        on_let_go: Callable[[LoadedModel], Any],
        metrics: ServiceMetrics,
        on_failure: Callable[[Exception], Any],
    ) -> None:
        self._settings = settings
        self._load = load
        self._prepare = prepare
        self._on_let_go = on_let_go
        self._metrics = metrics
        self._on_failure = on_failure
        self._current: ModelSet | None = None
        self._failed = False
        self._in_memory: weakref.WeakSet[LoadedModel] = weakref.WeakSet()
        self._loading: asyncio.Task[LoadedModel] | None = None

    @property
    def current(self) -> ModelSet | None:
        """None while they load, or when that failed."""
        return self._current

    async def fill(self) -> None:
        """Load what the settings name; never raises, because nobody awaits it before the process ends."""
        settings = self._settings
        wanted = {DEFAULT_NAME: settings} | {name: one.applied_to(settings) for name, one in settings.models.items()}
        try:
            loaded = [await self._made(name, settings_of_it) for name, settings_of_it in wanted.items()]
        except Exception as err:
            self._failed = True
            expected = isinstance(err, ViflowError)  # a file that cannot be used, and no fault of the code's
            logger.log(
                logging.ERROR, "model_load_failed", extra={"cause": str(err)}, exc_info=None if expected else err
            )
            self._on_failure(err)
            return
        self._current = ModelSet(tuple(loaded))
        for one in loaded:
            self._announce(one)
        self._metrics.ready.set(1)

    def require(self) -> ModelSet:
        """The models.

        Raises:
            Problem: 503 ``model_loading`` or ``model_load_failed``.
        """
        if self._current is not None:
            return self._current
        if self._failed:
            raise Problem(503, code="model_load_failed", detail="The model could not be loaded; see the log.")
        raise Problem(503, code="model_loading", detail="The model is still being loaded.", retry_after_s=2)

    async def load(self, name: str, settings: ServiceSettings, *, sha256: str | None) -> LoadedModel:
        """Load a model beside the others, then put it in the place of its name; it goes on if the caller leaves.

        Args:
            settings: that describe it.
            sha256: of the network's weights, None: whatever they are.

        Raises:
            Problem: 409 ``model_load_running``, ``models_full``, ``model_checksum_mismatch``; 422 with the library's
                code, or ``model_load_failed``. The models are then what they were.
        """
        current = self.require()
        if self._loading is not None:
            raise Problem(409, code="model_load_running", detail="expected no other model to be loading, found one")
        self._require_room(replacing=current.find(name) is not None)
        self._loading = asyncio.create_task(self._loaded(name, settings, sha256))
        self._loading.add_done_callback(self._load_ended)
        return await asyncio.shield(self._loading)

    def switch(self, name: str) -> ModelSet:
        """Make another model the default.

        Raises:
            Problem: 422 ``model_unknown``.
        """
        current = self.require()
        if current.find(name) is None:
            found = ", ".join(one.name for one in current.models)
            raise Problem(
                422, code="model_unknown", detail=f"name: expected one of {found}, found {name!r:.80}", field="name"
            )
        self._current = replace(current, default_name=name)
        logger.info("model_switched", extra={"served_as": name})
        return self._current

    def unload(self, name: str) -> None:
        """Let a model go; who began with it ends with it.

        Raises:
            Problem: 404 ``model_not_found``; 409 ``model_is_default``.
        """
        current = self.require()
        if (found := current.find(name)) is None:
            raise Problem(404, code="model_not_found", detail=f"expected a model that is loaded, found {name!r:.80}")
        if found is current.default:
            detail = f"expected another model than the default, found {name!r}; switch the default first"
            raise Problem(409, code="model_is_default", detail=detail)
        self._current = replace(current, models=tuple(one for one in current.models if one is not found))
        self._let_go(found)
        logger.info("model_unloaded", extra={"served_as": name})

    async def close(self) -> None:
        """Let a load that is under way go."""
        if self._loading is not None:
            self._loading.cancel()
            with contextlib.suppress(asyncio.CancelledError, Problem):
                await self._loading

    def _require_room(self, *, replacing: bool) -> None:
        """Models that were let go count as long as a stream or a request has them; one more for a replacement."""
        limit = self._settings.max_models + replacing
        if len(self._in_memory) >= limit:
            gc.collect()  # an error's traceback may hold one
        if len(self._in_memory) >= limit:
            detail = (
                f"expected at most {self._settings.max_models} models in memory, found no room for another; models "
                "that were unloaded or replaced stay as long as streams use them"
            )
            raise Problem(409, code="models_full", detail=detail)

    async def _loaded(self, name: str, settings: ServiceSettings, sha256: str | None) -> LoadedModel:
        try:
            new = await self._made(name, settings, sha256=sha256)
        except Problem:
            raise
        except Exception as err:
            logger.exception("model_load_failed", extra={"served_as": name})
            code = err.code if isinstance(err, ViflowError) else "model_load_failed"
            detail = f"expected a model that can be loaded, found a fault ({code}); the service's log says more"
            field = err.field if isinstance(err, ViflowError) else None
            raise Problem(422, code=code, detail=detail, field=field) from err
        current = self.require()
        replaced = current.find(name)
        others = tuple(one for one in current.models if one.name != name)
        self._current = replace(current, models=(*others, new))
        if replaced is not None:
            self._let_go(replaced)
        self._announce(new)
        return new

    async def _made(self, name: str, settings: ServiceSettings, *, sha256: str | None = None) -> LoadedModel:
        """One that is ready to judge."""
        detector = await asyncio.to_thread(self._load, settings)
        found = detector.model_info.sha256
        if sha256 not in (None, found):
            detail = f"sha256: expected the weights {sha256}, found {found}"
            raise Problem(409, code="model_checksum_mismatch", detail=detail, field="sha256")
        await self._prepare(detector)
        model = LoadedModel(name, detector, settings.calibration)
        self._in_memory.add(model)
        return model

    def _let_go(self, model: LoadedModel) -> None:
        self._metrics.forget_model(model.name, model.detector.model_info)
        self._on_let_go(model)

    def _load_ended(self, task: asyncio.Task[LoadedModel]) -> None:
        self._loading = None
        if not task.cancelled():
            task.exception()  # who asked for it may have left: nobody else looks at it

    def _announce(self, model: LoadedModel) -> None:
        info = model.detector.model_info
        self._metrics.observe_model(model.name, info)
        about = {"served_as": model.name, "model": info.name, "model_version": info.version}
        logger.info("model_loaded", extra=about)
