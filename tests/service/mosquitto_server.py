"""A real Mosquitto in a temporary folder, from the system's packages, and somebody who listens to it."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from service_world import wait_until


def find_mosquitto() -> str | None:
    return shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin")


@dataclass
class MosquittoServer:
    """``start`` and ``stop`` may be called again and again; what it has acknowledged it keeps."""

    folder: Path
    port: int
    acl: str = ""
    options: tuple[str, ...] = ()
    process: subprocess.Popen[bytes] | None = None

    @property
    def url(self) -> str:
        return f"mqtt://tester:secret@127.0.0.1:{self.port}"

    def start(self) -> None:
        program = find_mosquitto()
        assert program is not None
        lines = [
            f"listener {self.port} 127.0.0.1",
            "persistence true",
            f"persistence_location {self.folder}/",
            "allow_anonymous true",
            *self.options,
        ]
        if os.geteuid() == 0:
            lines.append("user root")
        if self.acl:
            (self.folder / "acl").write_text(self.acl, encoding="utf-8")
            lines.append(f"acl_file {self.folder}/acl")
        (self.folder / "mosquitto.conf").write_text("\n".join(lines) + "\n", encoding="utf-8")
        with (self.folder / "server.log").open("ab") as log:
            command = [program, "-c", str(self.folder / "mosquitto.conf")]
            self.process = subprocess.Popen(command, stdout=log, stderr=log)
        wait_until(self.answers, seconds=30)

    def answers(self) -> bool:
        try:
            socket.create_connection(("127.0.0.1", self.port), timeout=1).close()
        except OSError:
            return False
        return True

    def stop(self) -> None:
        if self.process is not None:
            self.process.terminate()
            self.process.wait(30)
            self.process = None


@contextlib.contextmanager
def mosquitto_server(*, acl: str = "", options: tuple[str, ...] = ()) -> Iterator[MosquittoServer]:
    """Started, and gone afterwards; skips the test where it is not installed."""
    if find_mosquitto() is None:
        pytest.skip("Mosquitto is not installed (on Debian: apt-get install mosquitto)")
    with tempfile.TemporaryDirectory(prefix="viflow-mosquitto-", ignore_cleanup_errors=True) as name:
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        server = MosquittoServer(Path(name), port, acl, options)
        server.start()
        try:
            yield server
        finally:
            server.stop()


@dataclass
class Listener:
    """Everything that was published, in its order; ``retained``: what a newcomer would be told first."""

    messages: list[tuple[str, str]] = field(default_factory=list)
    retained: dict[str, str] = field(default_factory=dict)
    subscribed: threading.Event = field(default_factory=threading.Event)

    def of(self, topic: str) -> list[str]:
        return [payload for name, payload in self.messages if name == topic]


@contextlib.contextmanager
def listening(server: MosquittoServer, *, name: str = "listener") -> Iterator[Listener]:
    """With a session that the broker keeps while it or the listener is away."""
    from paho.mqtt.client import Client  # noqa: PLC0415 - the tests that need it ask for it
    from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion  # noqa: PLC0415
    from paho.mqtt.packettypes import PacketTypes  # noqa: PLC0415
    from paho.mqtt.properties import Properties  # noqa: PLC0415

    heard = Listener()
    client = Client(CallbackAPIVersion.VERSION2, client_id=name, protocol=MQTTProtocolVersion.MQTTv5)

    def on_connect(client: Any, userdata: Any, flags: Any, reason: Any, properties: Any) -> None:
        client.subscribe("#", qos=1)

    def on_message(client: Any, userdata: Any, message: Any) -> None:
        payload = message.payload.decode()
        heard.retained[message.topic] = payload
        if not message.retain:
            heard.messages.append((message.topic, payload))

    client.on_connect = on_connect
    client.on_subscribe = lambda *given: heard.subscribed.set()
    client.on_message = on_message
    client.reconnect_delay_set(1, 1)
    session = Properties(PacketTypes.CONNECT)
    session.SessionExpiryInterval = 3600
    client.connect("127.0.0.1", server.port, keepalive=10, clean_start=False, properties=session)
    client.loop_start()
    try:
        assert heard.subscribed.wait(30)
        yield heard
    finally:
        client.disconnect()
        client.loop_stop()
