"""One uvicorn process: what ``viflow-anomaly serve`` and ``python -m viflow_anomaly_service`` run."""

from __future__ import annotations

import contextlib
import logging
import os
import socket

import uvicorn

from viflow_anomaly.allocator import keep_freed_memory
from viflow_anomaly.errors import ConfigError
from viflow_anomaly_service.app import DetectorLoader, create_app, load_bundled_or_configured
from viflow_anomaly_service.request_log import configure_logging
from viflow_anomaly_service.settings import ServiceSettings

logger = logging.getLogger(__name__)


def run(settings: ServiceSettings, *, load_detector: DetectorLoader = load_bundled_or_configured) -> None:
    """Serve until SIGINT or SIGTERM; running requests get ``shutdown_timeout_s`` to finish.

    Takes the process over: its log goes to stderr as JSON lines, and idle OpenMP threads are told to sleep (which
    has an effect only if torch was not imported before).

    Raises:
        ConfigError: ``address_unavailable``.
        Exception: what ``load_detector`` raised (``CheckpointError`` for a checkpoint that cannot be used); the
            server has ended by then.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    keep_freed_memory()
    configure_logging(settings.log_level)
    listener = bind(settings.host, settings.port)
    failures: list[Exception] = []

    def end_server(err: Exception) -> None:
        failures.append(err)
        server.should_exit = True

    app = create_app(settings, load_detector=load_detector, on_load_failure=end_server)
    server = uvicorn.Server(
        uvicorn.Config(
            app,
            http="h11",
            ws="none",
            lifespan="on",
            log_config=None,
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=settings.shutdown_timeout_s,
        )
    )
    host, port = listener.getsockname()[:2]
    logger.info("listening", extra={"host": host, "port": port})
    with listener, contextlib.suppress(KeyboardInterrupt):  # uvicorn raises SIGINT again once it has ended well
        server.run(sockets=[listener])
    if failures:
        raise failures[0]


def bind(host: str, port: int) -> socket.socket:
    """A listening socket.

    Raises:
        ConfigError: ``address_unavailable``: in use, not this machine's, or not permitted.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=128)
    except OSError as err:
        raise ConfigError(
            f"expected an address this machine can listen on, found {host}:{port}: {err.strerror or err}",
            code="address_unavailable",
            field="port",
        ) from err
