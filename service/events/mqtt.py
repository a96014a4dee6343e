"""Events over MQTT 5: each as a message, whether something moves as a retained state, and what Home Assistant needs."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import logging
import re
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any, Final

from viflow_anomaly_service.events.courier import DeliveryRefusedError, SinkUnreachableError
from viflow_anomaly_service.events.event_record import EventRecord
from viflow_anomaly_service.events.mqtt_connection import Broker, MqttConnection, mqtt_connection

logger = logging.getLogger(__name__)

MAX_HANGUPS = 3
"""Connections in a row that end while states are announced."""

MQTT_NAME: Final = "mqtt"
ONLINE: Final = "online"
OFFLINE: Final = "offline"
FAREWELL_SECONDS: Final = 1.0
_UNSAFE: Final = re.compile(r"[^A-Za-z0-9-]", re.ASCII)


@dataclass(frozen=True)
class Topics:
    """Where what is published.

    Attributes:
        prefix: ahead of everything of this service; no other one may take it.
        discovery: ahead of what Home Assistant reads.
        version: of this software, shown there.
    """

    prefix: str
    discovery: str
    version: str

    @property
    def availability(self) -> str:
        return f"{self.prefix}/availability"

    def events(self, stream_id: str) -> str:
        return f"{self.prefix}/{stream_id}/events"

    def motion(self, stream_id: str) -> str:
        return f"{self.prefix}/{stream_id}/motion"

    def sensor(self, stream_id: str) -> tuple[str, dict[str, Any]]:
        """Topic and configuration of a stream's binary sensor, as Home Assistant's MQTT discovery has it."""
        name = _identifier(f"{self.prefix}/{stream_id}")
        config = {
            "name": "Motion",
            "unique_id": name,
            "device_class": "motion",
            "state_topic": self.motion(stream_id),
            "payload_on": "ON",
            "payload_off": "OFF",
            "availability_topic": self.availability,
            "payload_available": ONLINE,
            "payload_not_available": OFFLINE,
            "json_attributes_topic": self.events(stream_id),
            "qos": 1,
            "device": {"identifiers": [name], "name": f"{self.prefix} {stream_id}", "manufacturer": "viflow-anomaly"},
            "origin": {"name": "viflow-anomaly", "sw_version": self.version},
        }
        return f"{self.discovery}/binary_sensor/{name}/config", config


class MqttSink:
    """A broker.

    Args:
        broker: where it is.
        topics: where what is published.
        open_things: for each known stream what is open in it, as far as the broker was told.
    """

    name = MQTT_NAME

    def __init__(
        self, broker: Broker, topics: Topics, open_things: Callable[[], Awaitable[dict[str, set[str]]]]
    ) -> None:
        self._broker = broker
        self._topics = topics
        self._open_things = open_things
        self._hung_up = 0

    @asynccontextmanager
    async def session(self) -> AsyncIterator[MqttSession]:
        will = (self._topics.availability, OFFLINE.encode())
        async with mqtt_connection(self._broker, will) as connection:
            session = MqttSession(connection, self._topics, await self._open_things())
            await self._announce(session)
            try:
                yield session
            finally:
                with contextlib.suppress(SinkUnreachableError, TimeoutError):
                    async with asyncio.timeout(FAREWELL_SECONDS):
                        await session.leave()

    async def _announce(self, session: MqttSession) -> None:
        """Unless the broker hung up on it again and again: events are not held up by that."""
        if self._hung_up >= MAX_HANGUPS:
            logger.warning("mqtt_states_not_announced")
            return
        try:
            await session.announce()
        except SinkUnreachableError:
            self._hung_up += 1
            raise
        self._hung_up = 0


class MqttSession:
    """A connection, and what the broker was told on it."""

    def __init__(self, connection: MqttConnection, topics: Topics, open_things: dict[str, set[str]]) -> None:
        self._connection = connection
        self._topics = topics
        self._open = open_things
        self._announced: set[str] = set()
        self._refused: set[str] = set()
        self.broken = connection.broken

    async def announce(self) -> None:
        """Retained states once more: the broker may have lost them."""
        for stream_id in list(self._open):
            await self._show(stream_id)
        await self._state(self._topics.availability, ONLINE)

    async def leave(self) -> None:
        await self._state(self._topics.availability, OFFLINE)

    async def send(self, event: EventRecord) -> None:
        stream_id = event.stream_id
        moving = self._open.setdefault(stream_id, set())
        if event.kind == "end":
            moving.discard(event.thing_id)
        else:
            moving.add(event.thing_id)
        await self._connection.publish(self._topics.events(stream_id), event.body, retain=False)
        if event.kind != "update" or stream_id not in self._announced:
            await self._show(stream_id)

    async def _show(self, stream_id: str) -> None:
        if stream_id not in self._announced:
            topic, config = self._topics.sensor(stream_id)
            await self._state(topic, json.dumps(config))
            self._announced.add(stream_id)
        await self._state(self._topics.motion(stream_id), "ON" if self._open[stream_id] else "OFF")

    async def _state(self, topic: str, payload: str) -> None:
        """Retained; a broker that refuses it (not every one lets us tell Home Assistant) still gets the events."""
        try:
            await self._connection.publish(topic, payload, retain=True)
        except DeliveryRefusedError as err:
            if topic not in self._refused:
                logger.warning("mqtt_state_refused", extra={"topic": topic, "cause": str(err)})
            self._refused.add(topic)


def client_id(prefix: str) -> str:
    """The same for all processes of a service, so that a new connection ends the one it replaces, and its will."""
    return f"viflow-{hashlib.sha256(prefix.encode()).hexdigest()[:12]}"


def _identifier(text: str) -> str:
    """Different ones for different texts, of the characters that Home Assistant takes."""
    return "viflow_" + _UNSAFE.sub(lambda found: f"_{ord(found[0]):02x}", text)
