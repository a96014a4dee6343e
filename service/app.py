"""The HTTP service: endpoints around one :class:`AnomalyDetector`. It holds no logic that the library lacks."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from typing import Any, Final

from fastapi import FastAPI

from viflow_anomaly.pair_detector import PairDetector
from viflow_anomaly_service.access_control import add_access_control
from viflow_anomaly_service.admission import AdmissionGate
from viflow_anomaly_service.closing_time import KEPT_FROM_EVENTS, KEPT_FROM_STORE, KEPT_FROM_WORKERS, ClosingTime
from viflow_anomaly_service.dashboard.static_files import add_dashboard
from viflow_anomaly_service.detect_endpoint import add_detect
from viflow_anomaly_service.detector_loading import DetectorLoader, load_bundled_or_configured, warm_up
from viflow_anomaly_service.detector_pool import DetectorPool
from viflow_anomaly_service.events.attach import configured_events
from viflow_anomaly_service.events.endpoints import add_events
from viflow_anomaly_service.events.event_rules import EndReason
from viflow_anomaly_service.head_requests import HeadMiddleware
from viflow_anomaly_service.live.endpoints import add_live
from viflow_anomaly_service.live.pair_memory import PairMemory
from viflow_anomaly_service.metrics import ServiceMetrics
from viflow_anomaly_service.models.endpoints import add_models
from viflow_anomaly_service.models.table import ModelTable
from viflow_anomaly_service.openapi import complete_openapi
from viflow_anomaly_service.problems import install_problem_handlers
from viflow_anomaly_service.request_log import RequestLogMiddleware
from viflow_anomaly_service.security_headers import SecurityHeadersMiddleware
from viflow_anomaly_service.service_core import ServiceCore
from viflow_anomaly_service.settings import ServiceSettings, load_settings
from viflow_anomaly_service.state_endpoints import VERSION, add_state
from viflow_anomaly_service.store.attach import configured_keeper
from viflow_anomaly_service.store.endpoints import add_detections
from viflow_anomaly_service.streams.endpoints import add_streams
from viflow_anomaly_service.streams.table import LiveStream, StreamTable
from viflow_anomaly_service.tracing import TracingMiddleware, configured_tracing, end_tracing

MEMORY_SECONDS: Final = 5.0


def create_app(
    settings: ServiceSettings | None = None,
    *,
    load_detector: DetectorLoader = load_bundled_or_configured,
    on_load_failure: Callable[[Exception], Any] = lambda err: None,
) -> FastAPI:
    """An application whose detector is loaded in a thread when it starts; ``app.state.core`` holds its parts.

    Args:
        settings: from the environment when not given.
        load_detector: makes the detector of a model from the settings that describe it; called outside the event loop.
        on_load_failure: told when that raised; ``/readyz`` then stays at 503.

    Raises:
        ConfigError: ``config_invalid``, an environment variable that cannot be used; ``store_url_invalid``.
            An event's rule, sink or secret that cannot be used: see ``configured_events``.
        MissingDependencyError: ``store_missing``, ``webhook_missing``, ``mqtt_missing``.
    """
    core = _build(settings or load_settings(), load_detector, on_load_failure)
    tracing = configured_tracing()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        core.pool.start()
        background = (core.models.fill(), _watch_memory(core.metrics), core.streams.watch())
        tasks = [asyncio.create_task(one) for one in background]
        if core.keeper is not None:
            core.keeper.start()
        core.events.start()
        closing_time = ClosingTime()
        async with AsyncExitStack() as closing:  # from the last line to the first, each whatever the others do
            if tracing is not None:
                closing.push_async_callback(_end_tracing, tracing, closing_time)
            closing.push_async_callback(_close_keeper, core, closing_time)
            closing.push_async_callback(_close_events, core, closing_time)
            closing.push_async_callback(_close_pool, core, closing_time)
            closing.push_async_callback(core.models.close)
            for task in tasks:
                closing.callback(task.cancel)
            closing.callback(core.gate.close)
            closing.callback(closing_time.begin)
            yield

    app = FastAPI(
        title="viflow-anomaly",
        version=VERSION,
        summary="Finds independent motion in what a moving camera sees",
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        lifespan=lifespan,
        redirect_slashes=False,
    )
    app.state.core = core
    app.add_middleware(HeadMiddleware)
    add_access_control(app, core.settings)
    if tracing is not None:
        app.add_middleware(TracingMiddleware, provider=tracing)
    app.add_middleware(RequestLogMiddleware, metrics=core.metrics)
    app.add_middleware(SecurityHeadersMiddleware)
    install_problem_handlers(app)
    add_state(app, core)
    add_detect(app, core)
    complete_openapi(app)
    add_models(app, core)
    add_detections(app, core)
    add_streams(app, core)
    add_events(app, core)
    add_live(app, core)
    if core.settings.dashboard:
        add_dashboard(app)
    return app


def _build(
    settings: ServiceSettings, load_detector: DetectorLoader, on_load_failure: Callable[[Exception], Any]
) -> ServiceCore:
    """The one place where the settings' numbers meet the parts."""
    metrics = ServiceMetrics()
    workers = settings.workers_at_once
    gate = AdmissionGate(places=workers + settings.max_queued, metrics=metrics)
    pool = DetectorPool(workers=workers, metrics=metrics)

    async def warm_up_everywhere(detector: PairDetector) -> None:
        for camera in settings.warm_up:
            await pool.run_everywhere(partial(warm_up, detector, camera))

    keeper = configured_keeper(settings, metrics)
    events = configured_events(settings, metrics, keeper, gate.closing)
    live = PairMemory(settings, metrics)

    def on_forget(stream: LiveStream, reason: EndReason) -> None:
        events.desk.end(stream, reason)
        live.ended(stream.stream_id)

    return ServiceCore(
        settings=settings,
        metrics=metrics,
        models=ModelTable(
            settings,
            load_detector,
            prepare=warm_up_everywhere,
            on_let_go=live.forget_model,
            metrics=metrics,
            on_failure=on_load_failure,
        ),
        gate=gate,
        pool=pool,
        keeper=keeper,
        streams=StreamTable(settings, gate, metrics, on_forget=on_forget),
        events=events,
        live=live,
    )


async def _close_pool(core: ServiceCore, time: ClosingTime) -> None:
    await asyncio.to_thread(core.pool.close, time.left_s(kept_s=KEPT_FROM_WORKERS))


async def _close_events(core: ServiceCore, time: ClosingTime) -> None:
    await core.events.close(core.streams.begun(), within_s=time.left_s(kept_s=KEPT_FROM_EVENTS))


async def _close_keeper(core: ServiceCore, time: ClosingTime) -> None:
    if core.keeper is not None:
        await core.keeper.close(within_s=time.left_s(kept_s=KEPT_FROM_STORE))


async def _end_tracing(provider: Any, time: ClosingTime) -> None:
    await end_tracing(provider, within_s=time.left_s())


async def _watch_memory(metrics: ServiceMetrics) -> None:
    while True:
        metrics.observe_memory()
        await asyncio.sleep(MEMORY_SECONDS)
