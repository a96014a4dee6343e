"""One MQTT 5 connection on the event loop: Eclipse Paho's client runs in a thread of its own."""

from __future__ import annotations

import asyncio
import contextlib
import ssl
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any, Final

from paho.mqtt.client import Client, MQTTMessageInfo
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.reasoncodes import ReasonCode

from viflow_anomaly_service.events.courier import ATTEMPT_SECONDS, DeliveryRefusedError, SinkUnreachableError

KEEPALIVE_SECONDS: Final = 15
_FAILURE: Final = 128
"""MQTT 5: reason codes from here on mean that it was not done."""


@dataclass(frozen=True)
class Broker:
    """Where, and as whom. ``client_id``: a later connection of the same name ends an earlier one."""

    host: str
    port: int
    client_id: str
    user: str | None = None
    password: str | None = None
    tls: ssl.SSLContext | None = None


class MqttConnection:
    """Publishes with QoS 1, one message at a time.

    Attributes:
        broken: set when the connection is no more.
    """

    def __init__(self, broker: Broker, will: tuple[str, bytes]) -> None:
        self._broker = broker
        self._loop = asyncio.get_running_loop()
        self._connected: asyncio.Future[None] = self._loop.create_future()
        self._waiting: dict[int, asyncio.Future[None]] = {}
        self.broken = asyncio.Event()
        self._client = client = Client(
            CallbackAPIVersion.VERSION2,
            client_id=broker.client_id,
            protocol=MQTTProtocolVersion.MQTTv5,
            reconnect_on_failure=False,
        )
        client.connect_timeout = ATTEMPT_SECONDS / 2
        client.username_pw_set(broker.user, broker.password)
        if broker.tls is not None:
            client.tls_set_context(broker.tls)
        client.will_set(*will, qos=1, retain=True)
        client.on_connect = self._on_connect
        client.on_disconnect = self._on_disconnect
        client.on_publish = self._on_publish

    async def connect(self) -> None:
        """Until the broker has accepted.

        Raises:
            SinkUnreachableError: it has not, or not in time.
        """
        broker = self._broker
        try:
            async with asyncio.timeout(ATTEMPT_SECONDS):
                await asyncio.to_thread(self._client.connect, broker.host, broker.port, KEEPALIVE_SECONDS)
                self._client.loop_start()
                await self._connected
        except TimeoutError:
            raise SinkUnreachableError("no answer in time") from None
        except (OSError, ValueError) as err:  # ssl's errors are OSErrors
            raise SinkUnreachableError(f"{type(err).__name__}: {err}") from err

    async def publish(self, topic: str, payload: str, *, retain: bool) -> None:
        """Until the broker has acknowledged it.

        Raises:
            DeliveryRefusedError: it says that it has not taken it.
            SinkUnreachableError: the connection ended first, or nothing came in time.
        """
        if self.broken.is_set():
            raise SinkUnreachableError("the connection ended")
        sent: MQTTMessageInfo = self._client.publish(topic, payload, qos=1, retain=retain)
        acknowledged = self._waiting[sent.mid] = self._loop.create_future()  # before any callback has its turn
        try:
            async with asyncio.timeout(ATTEMPT_SECONDS):
                await acknowledged
        except TimeoutError:
            self.broken.set()
            raise SinkUnreachableError("no acknowledgement in time") from None
        finally:
            self._waiting.pop(sent.mid, None)

    async def close(self) -> None:
        """Say goodbye, so that the broker keeps the will to itself."""
        self._client.disconnect()
        await asyncio.to_thread(self._client.loop_stop)

    def _on_connect(self, client: Client, userdata: Any, flags: Any, reason: ReasonCode, properties: Any) -> None:
        if reason.value < _FAILURE:
            self._call(self._accept)
        else:
            self._call(self._end, f"refused: {reason}")

    def _on_disconnect(self, client: Client, userdata: Any, flags: Any, reason: ReasonCode, properties: Any) -> None:
        self._call(self._end, f"the connection ended: {reason}")

    def _on_publish(self, client: Client, userdata: Any, mid: int, reason: ReasonCode, properties: Any) -> None:
        self._call(self._acknowledge, mid, reason)

    def _accept(self) -> None:
        if not self._connected.done():
            self._connected.set_result(None)

    def _acknowledge(self, mid: int, reason: ReasonCode) -> None:
        future = self._waiting.get(mid)
        if future is None or future.done():  # nobody waits for it any more
            return
        if reason.value < _FAILURE:
            future.set_result(None)
        else:
            future.set_exception(DeliveryRefusedError(f"refused by the broker: {reason}"))

    def _end(self, cause: str) -> None:
        self.broken.set()
        for future in (self._connected, *self._waiting.values()):
            if not future.done():
                future.set_exception(SinkUnreachableError(cause))
        if not self._connected.cancelled():
            self._connected.exception()  # whoever waited for it has been told; nobody else will ask

    def _call(self, action: Callable[..., object], *values: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has been closed: nobody waits
            self._loop.call_soon_threadsafe(action, *values)


@asynccontextmanager
async def mqtt_connection(broker: Broker, will: tuple[str, bytes]) -> AsyncIterator[MqttConnection]:
    """Connected, and closed afterwards.

    Raises:
        SinkUnreachableError: the broker cannot be reached or refuses.
    """
    connection = MqttConnection(broker, will)
    try:
        await connection.connect()
        yield connection
    finally:
        await connection.close()
