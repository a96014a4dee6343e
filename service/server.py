"""What ``viflow-anomaly serve`` and ``python -m viflow_anomaly_service`` run: one process that serves, or several.

Nothing of the application is imported before it is known how many there will be (see ``metrics``).
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Final

import uvicorn

from viflow_anomaly.allocator import keep_freed_memory
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.idle_threads import keep_idle_threads_from_spinning
from viflow_anomaly_service.access_rules import require_keys_or_loopback
from viflow_anomaly_service.api_keys import read_key_file
from viflow_anomaly_service.connection_guard import guarded_protocol
from viflow_anomaly_service.json_log import configure_logging
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.socket_guard import socket_options
from viflow_anomaly_service.stop_signals import StopSignals

if TYPE_CHECKING:
    from viflow_anomaly_service.admission import AdmissionGate
    from viflow_anomaly_service.detector_loading import DetectorLoader

logger = logging.getLogger(__name__)

BACKLOG: Final = 128
FAREWELL_SECONDS: Final = 3
"""For the answers of those who are refused at the very end."""


def run(settings: ServiceSettings, *, load_detector: DetectorLoader | None = None) -> None:
    """Serve until SIGINT or SIGTERM; running requests get ``shutdown_timeout_s`` to finish.

    Takes the process over: its log goes to stderr as JSON lines, and idle threads are kept from spinning (which
    has an effect only if numpy and torch were not imported before).

    Args:
        load_detector: the bundled or configured one when not given; called in every serving process.

    Raises:
        ConfigError: ``keys_missing``, ``address_unavailable``, ``workers_unsupported``, ``workers_failed``; the key
            file, or another setting (see ``create_app``), cannot be used.
        MissingDependencyError: a setting asks for an extra that is not installed.
        Exception: what ``load_detector`` raised (``CheckpointError`` for a checkpoint that cannot be used); the
            server has ended by then.
    """
    require_keys_or_loopback(settings)
    if settings.key_file is not None:
        read_key_file(settings.key_file)  # before processes are started that would each fail on it
    keep_idle_threads_from_spinning()
    keep_freed_memory()
    configure_logging(settings.log_level)
    stop = StopSignals()
    stop.install()
    try:
        if settings.workers > 1:
            from viflow_anomaly_service.supervisor import supervise  # noqa: PLC0415 - it imports this module

            supervise(settings, load_detector, stop)
        else:
            serve(settings, load_detector, stop, on_listening=partial(log_address, workers=1))
    finally:
        stop.restore()


def serve(
    settings: ServiceSettings,
    load_detector: DetectorLoader | None,
    stop: StopSignals,
    *,
    on_listening: Callable[[socket.socket], None],
    shared: bool = False,
) -> None:
    """Serve in this process; raises as ``run``.

    Args:
        on_listening: told of the socket once what comes there is answered, which is never the case where the settings
            cannot be used.
        shared: as for ``bind``.
    """
    from viflow_anomaly_service.app import create_app  # noqa: PLC0415 - imports prometheus-client
    from viflow_anomaly_service.detector_loading import load_bundled_or_configured  # noqa: PLC0415

    failures: list[Exception] = []

    def end_server(err: Exception) -> None:
        failures.append(err)
        server.should_exit = True

    app = create_app(settings, load_detector=load_detector or load_bundled_or_configured, on_load_failure=end_server)
    config = uvicorn.Config(
        app,
        http=guarded_protocol(settings),
        **socket_options(settings),
        lifespan="on",
        log_config=None,
        access_log=False,
        server_header=False,
        backlog=BACKLOG,
        timeout_graceful_shutdown=settings.shutdown_timeout_s + FAREWELL_SECONDS,
    )
    server = GracefulServer(
        config,
        gate=app.state.core.gate,
        patience_s=settings.shutdown_timeout_s,
        on_listening=lambda: on_listening(listener),
    )
    stop.tell(server)
    with bind(settings.host, settings.port, shared=shared) as listener:
        server.run(sockets=[listener])
    if failures:
        raise failures[0]


class GracefulServer(uvicorn.Server):
    """Answers everybody before it ends: what was accepted is finished, or refused when the patience is over.

    Args:
        gate: closed as soon as the server is to end.
        patience_s: for what is inside then.
        on_listening: called once connections are answered.
    """

    def __init__(
        self,
        config: uvicorn.Config,
        *,
        gate: AdmissionGate,
        patience_s: float,
        on_listening: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(config)
        self._gate = gate
        self._patience_s = patience_s
        self._on_listening = on_listening

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self._on_listening()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._gate.close()
        expelling = asyncio.get_running_loop().call_later(self._patience_s, self._gate.expel)
        await super().shutdown(sockets)
        expelling.cancel()


def bind(host: str, port: int, *, shared: bool = False) -> socket.socket:
    """A listening socket.

    Args:
        shared: one of several on the same address, among which the system deals connections out.

    Raises:
        ConfigError: ``address_unavailable``: in use, not this machine's, or not permitted.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family, backlog=BACKLOG, reuse_port=shared)
        # Connections inherit it. asyncio sets it for sockets that name TCP only; without it an answer's body waits for
        # the client to acknowledge the head: 40 ms on a connection that is kept.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    except OSError as err:
        raise ConfigError(
            f"expected an address this machine can listen on, found {host}:{port}: {err.strerror or err}",
            code="address_unavailable",
            field="port",
        ) from err
    return listener


def log_address(listener: socket.socket, *, workers: int) -> None:
    """Tell the log, and whoever started us with port 0."""
    host, port = listener.getsockname()[:2]
    logger.info("listening", extra={"host": host, "port": port, "workers": workers})
