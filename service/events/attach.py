"""The settings' numbers and addresses become the parts that make, keep and deliver events."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import random
import ssl
import uuid
from collections.abc import Coroutine, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import SplitResult, unquote, urlsplit

from viflow_anomaly.errors import ConfigError, MissingDependencyError
from viflow_anomaly_service.events.desk import EventDesk
from viflow_anomaly_service.events.event_rules import EventRules
from viflow_anomaly_service.events.live import LiveReaders
from viflow_anomaly_service.events.log import EventLog, MemoryLog
from viflow_anomaly_service.events.metrics import EventMetrics
from viflow_anomaly_service.metrics import ServiceMetrics
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.settings import ServiceSettings

if TYPE_CHECKING:
    from viflow_anomaly_service.events.courier import Courier, Sink
    from viflow_anomaly_service.events.delivery_store import DeliveryStore
    from viflow_anomaly_service.events.event_store import EventStore
    from viflow_anomaly_service.events.store_log import StoreLog
    from viflow_anomaly_service.store.keeper import ResultKeeper
    from viflow_anomaly_service.streams.table import LiveStream

logger = logging.getLogger(__name__)

LOOK_SECONDS: Final = 1.0
CLOSE_SECONDS: Final = 4.0
"""For all that events need before the service stops, if there is as much; the store, which may hang, is closed after
that."""
ENDS_SECONDS: Final = 2.0
"""Of these, for the ends of what is open to be kept; what does not come through is ended by the next process."""
TOLD_SECONDS: Final = 3.0
"""Of these, until sinks have been told of the ends: what is left is for them to be left in order."""
_PORTS: Final = {"mqtt": 1883, "mqtts": 8883}


async def _ended(tasks: Sequence[asyncio.Task[None]]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


async def _released(courier: Courier) -> None:
    try:
        await courier.release()
    except Problem as problem:
        logger.warning("event_sink_not_released", extra={"code": problem.code})


@dataclass(frozen=True)
class StoredEvents:
    """What there is of events with a store only."""

    events: EventStore
    deliveries: DeliveryStore
    log: StoreLog
    couriers: Sequence[Courier]


class EventParts:
    """All that events need in one process, and its life.

    Attributes:
        desk: makes events of detections.
        readers: those who read live.
        stored: with a store.
    """

    def __init__(
        self,
        desk: EventDesk,
        readers: LiveReaders,
        metrics: EventMetrics,
        keeper: ResultKeeper | None,
        stored: StoredEvents | None,
    ) -> None:
        self.desk = desk
        self.readers = readers
        self.stored = stored
        self._metrics = metrics
        self._keeper = keeper
        self._tasks: list[asyncio.Task[None]] = []
        self._courier_tasks: list[asyncio.Task[None]] = []

    def start(self) -> None:
        """On the event loop, once the store is being opened."""
        work: list[Coroutine[Any, Any, None]] = [self.desk.watch()]
        if self.stored is not None and self._keeper is not None:
            from viflow_anomaly_service.events.abandoned import watch_abandoned  # noqa: PLC0415 - needs the extra

            stored = self.stored
            work.append(watch_abandoned(stored.events, stored.log, self._keeper, self._metrics))
            work.append(self._look(stored.log))
            self._courier_tasks = [asyncio.create_task(courier.run()) for courier in stored.couriers]
        self._tasks = [asyncio.create_task(one) for one in work]

    async def close(self, streams: Sequence[LiveStream], *, within_s: float) -> None:
        """After the last request, before the store is closed; takes ``CLOSE_SECONDS`` at most, each step its share of
        what there is."""
        began = asyncio.get_running_loop().time()
        share = min(1.0, within_s / CLOSE_SECONDS)
        couriers = self.stored.couriers if self.stored is not None else ()
        try:
            async with asyncio.timeout_at(began + share * CLOSE_SECONDS):
                await _ended(self._tasks)
                await self.desk.close(streams, until=began + share * ENDS_SECONDS)
                with contextlib.suppress(Problem, TimeoutError):  # what is left waits in the store for the next process
                    async with asyncio.timeout_at(began + share * TOLD_SECONDS):
                        await asyncio.gather(*(courier.settle() for courier in couriers))
                await _ended(self._courier_tasks)
                for courier in couriers:
                    await _released(courier)
        except TimeoutError:
            logger.warning("events_not_closed_in_time")

    async def _look(self, log: StoreLog) -> None:
        """For events of other processes, while somebody reads live."""
        while True:
            await asyncio.sleep(LOOK_SECONDS)
            if self.readers.present:
                try:
                    await log.look()
                except Problem as problem:
                    logger.debug("events_not_watched", extra={"code": problem.code})
                except Exception:  # a fault of ours, which must not end the watch
                    logger.exception("events_not_watched")


def configured_events(
    settings: ServiceSettings, metrics: ServiceMetrics, keeper: ResultKeeper | None, closing: asyncio.Event
) -> EventParts:
    """The parts that the settings ask for, not yet started.

    Args:
        closing: set when the service stops.

    Raises:
        ConfigError: ``event_rules_invalid``, ``event_store_missing``, ``webhook_url_invalid``,
            ``webhook_secret_missing``, ``mqtt_url_invalid``, ``mqtt_ca_invalid``.
        MissingDependencyError: ``webhook_missing``, ``mqtt_missing``.
    """
    rules, own = _rules(settings), EventMetrics(metrics)
    sinks_wanted = bool(settings.webhook_urls) or settings.mqtt_url is not None
    if keeper is None:
        if sinks_wanted:
            field = "webhook_urls" if settings.webhook_urls else "mqtt_url"
            raise ConfigError(
                f"{field}: expected a store beside it, which keeps what is not delivered yet, found none: set "
                "VIFLOW_STORE_URL, for instance to a path",
                code="event_store_missing",
                field="store_url",
            )
        memory: EventLog = MemoryLog(settings.event_ring)
        readers = LiveReaders(memory, limit=settings.max_event_readers, closing=closing, metrics=own)
        return EventParts(EventDesk(rules, memory, own), readers, own, None, None)
    stored = _stored(settings, own, keeper)
    readers = LiveReaders(stored.log, limit=settings.max_event_readers, closing=closing, metrics=own)
    return EventParts(EventDesk(rules, stored.log, own), readers, own, keeper, stored)


def _stored(settings: ServiceSettings, metrics: EventMetrics, keeper: ResultKeeper) -> StoredEvents:
    from viflow_anomaly_service.events.abandoned import HOLD_SECONDS  # noqa: PLC0415 - these need the extra `store`
    from viflow_anomaly_service.events.courier import Courier  # noqa: PLC0415
    from viflow_anomaly_service.events.delivery_store import DeliveryStore  # noqa: PLC0415
    from viflow_anomaly_service.events.event_store import EventStore  # noqa: PLC0415
    from viflow_anomaly_service.events.store_log import StoreLog  # noqa: PLC0415

    holder = uuid.uuid4().hex
    deliveries = DeliveryStore(keeper.store, holder=holder)
    sinks = [*_webhooks(settings), *_mqtt(settings, deliveries, keeper)]
    names = [sink.name for sink in sinks]
    events = EventStore(keeper.store, sinks=names, holder=holder, hold_s=HOLD_SECONDS)
    log = StoreLog(events, keeper)
    couriers = [
        Courier(
            sink,
            deliveries=deliveries,
            log=log,
            keeper=keeper,
            metrics=metrics,
            attempts=settings.event_delivery_attempts,
            chance=random.Random(sink.name),  # noqa: S311 - spreads waits, guards nothing
        )
        for sink in sinks
    ]
    return StoredEvents(events, deliveries, log, couriers)


def _rules(settings: ServiceSettings) -> EventRules:
    if settings.event_end_score > settings.event_start_score:
        raise ConfigError(
            f"event_end_score: expected at most event_start_score={settings.event_start_score:g}, found "
            f"{settings.event_end_score:g}",
            code="event_rules_invalid",
            field="event_end_score",
        )
    return EventRules(
        start_score=settings.event_start_score,
        start_pairs=settings.event_start_pairs,
        end_score=settings.event_end_score,
        end_s=settings.event_end_s,
        update_s=settings.event_update_s,
        cooldown_s=settings.event_cooldown_s,
    )


def _webhooks(settings: ServiceSettings) -> list[Sink]:
    urls = [secret.get_secret_value() for secret in settings.webhook_urls]
    if not urls:
        return []
    for url in urls:
        split = _split(url)
        if split is None or split.scheme not in ("http", "https"):
            raise ConfigError(  # names no URL: it may hold a token
                "webhook_urls: expected URLs such as https://host/path, found something else",
                code="webhook_url_invalid",
                field="webhook_urls",
            )
    secret = settings.webhook_secret.get_secret_value() if settings.webhook_secret is not None else ""
    if not secret:
        raise ConfigError(
            "webhook_urls: expected a secret beside them, with which events are signed, found none: set "
            "VIFLOW_WEBHOOK_SECRET",
            code="webhook_secret_missing",
            field="webhook_secret",
        )
    try:
        from viflow_anomaly_service.events.webhook import WebhookSink  # noqa: PLC0415
    except ImportError as err:
        raise _missing("webhook_urls", "webhook", err) from err
    return [WebhookSink(url, secret) for url in dict.fromkeys(urls)]


def _mqtt(settings: ServiceSettings, deliveries: DeliveryStore, keeper: ResultKeeper) -> list[Sink]:
    if settings.mqtt_url is None:
        return []
    split = _split(settings.mqtt_url.get_secret_value())
    if split is None or split.scheme not in _PORTS or split.path not in ("", "/") or split.query:
        raise ConfigError(  # shows nothing of what was found: it may hold a password
            "mqtt_url: expected mqtt://user:password@host:1883 or mqtts://..., found something else",
            code="mqtt_url_invalid",
            field="mqtt_url",
        )
    try:
        from viflow_anomaly_service.events.mqtt import MQTT_NAME, MqttSink, Topics, client_id  # noqa: PLC0415
        from viflow_anomaly_service.events.mqtt_connection import Broker  # noqa: PLC0415
    except ImportError as err:
        raise _missing("mqtt_url", "mqtt", err) from err
    broker = Broker(
        host=split.hostname or "",
        port=split.port or _PORTS[split.scheme],
        client_id=client_id(settings.mqtt_prefix),
        user=None if split.username is None else unquote(split.username),
        password=None if split.password is None else unquote(split.password),
        tls=_trusting(settings) if split.scheme == "mqtts" else None,
    )
    topics = Topics(settings.mqtt_prefix, settings.mqtt_discovery_prefix, version("viflow-anomaly"))
    return [MqttSink(broker, topics, lambda: keeper.read(partial(deliveries.open_things, MQTT_NAME)))]


def _trusting(settings: ServiceSettings) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=settings.mqtt_ca_file)
    except OSError as err:  # ssl's errors are OSErrors
        raise ConfigError(
            f"mqtt_ca_file: expected a file of certificates, found {settings.mqtt_ca_file}: {err.strerror or err}",
            code="mqtt_ca_invalid",
            field="mqtt_ca_file",
        ) from err


def _split(url: str) -> SplitResult | None:
    """The parts of a URL that names a host; None for what is no such thing."""
    try:
        split = urlsplit(url)
        found = split.hostname and (split.port is None or split.port > 0) and not any(c.isspace() for c in url)
    except ValueError:
        return None
    return split if found else None


def _missing(field: str, extra: str, err: ImportError) -> MissingDependencyError:
    return MissingDependencyError(
        f"{field}: expected the packages of the extra `{extra}`, found no {err.name}: "
        f"pip install 'viflow-anomaly[{extra}]'",
        code=f"{extra}_missing",
        field=field,
    )
