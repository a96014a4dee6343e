"""Several processes behind one address: each loads its own model and has its own limits; one parent looks after them.

The parent imports what a detection needs and then forks, so that the processes share the memory of the code. It never
loads a model: the networks' threads and locks do not survive a fork. Every process listens on a socket of its own on
the same address (``SO_REUSEPORT``), and the system deals the connections out among them.
"""

from __future__ import annotations

import ctypes
import gc
import logging
import multiprocessing
import multiprocessing.connection
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING, Final

from viflow_anomaly.errors import ConfigError, ViflowError
from viflow_anomaly_service.server import FAREWELL_SECONDS, bind, log_address, serve
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.stop_signals import StopSignals

if TYPE_CHECKING:
    from viflow_anomaly_service.detector_loading import DetectorLoader

logger = logging.getLogger(__name__)

EXIT_BAD_INPUT: Final = 2
RESTART_SECONDS: Final = 1.0
LOOK_SECONDS: Final = 0.2
KILL_AFTER_SECONDS: Final = 15
"""Behind the time for requests and their farewell: ``closing_time.CLOSE_SECONDS``, and the interpreter's own end."""
_PR_SET_PDEATHSIG: Final = 1


def supervise(settings: ServiceSettings, load_detector: DetectorLoader | None, stop: StopSignals) -> None:
    """Keep ``settings.workers`` processes serving until ``stop`` is requested, then let them end in order.

    Raises:
        ConfigError: ``address_unavailable``; ``workers_unsupported`` on another system than Linux; ``workers_failed``:
            a process could not start (its own message is on stderr), or did not end.
    """
    if sys.platform != "linux":
        raise ConfigError(
            f"workers: expected 1 on this system, found {settings.workers}: several need Linux",
            code="workers_unsupported",
            field="workers",
        )
    from viflow_anomaly_service.metrics_folder import metrics_folder  # noqa: PLC0415 - fcntl is not on every system

    with bind(settings.host, settings.port) as alone:  # fails where anybody listens; a shared one would join in
        host, port = alone.getsockname()[:2]
    with (
        socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as reserved,
        metrics_folder() as folder,
    ):
        reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        reserved.bind((host, port))  # holds the address while processes come and go; it does not listen
        on_listening = partial(log_address, reserved, workers=settings.workers)
        settings = settings.model_copy(update={"host": host, "port": port})
        if "prometheus_client" in sys.modules:
            raise AssertionError(
                "prometheus_client was imported before it could learn that processes share its numbers"
            )
        os.environ["PROMETHEUS_MULTIPROC_DIR"] = folder
        if load_detector is None:
            from viflow_anomaly_service.detector_loading import preload  # noqa: PLC0415 - heavy

            preload()
        import viflow_anomaly_service.app  # noqa: F401, PLC0415 - after the variable above was set

        gc.collect()
        gc.freeze()  # a collection in a process would else copy every page it looks at
        Supervisor(settings, load_detector, stop, on_listening=on_listening).run()


class Supervisor:
    """The loop of the parent: starts processes, replaces those that die, ends them all.

    Args:
        on_listening: called when the first of the processes answers connections.
    """

    def __init__(
        self,
        settings: ServiceSettings,
        load_detector: DetectorLoader | None,
        stop: StopSignals,
        *,
        on_listening: Callable[[], None] = lambda: None,
    ) -> None:
        self._settings = settings
        self._load_detector = load_detector
        self._context = multiprocessing.get_context("fork")
        self._processes: list[BaseProcess] = []
        self._stop = stop
        self._on_listening = on_listening
        self._told_listening = False
        self._heard, self._tell = self._context.Pipe(duplex=False)

    def run(self) -> None:
        """Until it is to end; raises as ``supervise``."""
        failed = False
        while not self._stop.requested and not failed:
            while len(self._processes) < self._settings.workers and not self._stop.requested:
                self._start()
            sentinels = [process.sentinel for process in self._processes]
            multiprocessing.connection.wait([*sentinels, self._heard], timeout=LOOK_SECONDS)
            self._hear()
            failed = self._bury()
        ended = self._end()
        if failed or not ended:
            found = "one that could not start" if failed else "one that had to be killed"
            raise ConfigError(
                f"workers: expected {self._settings.workers} processes that serve and end in order, found {found}",
                code="workers_failed",
                field="workers",
            )

    def _start(self) -> None:
        process = self._context.Process(
            target=_serve_in_child,
            args=(self._settings, self._load_detector, os.getpid(), self._tell),
            name="viflow-worker",
        )
        process.start()
        self._processes.append(process)
        logger.info("worker_started", extra={"worker": process.pid})

    def _hear(self) -> None:
        """Take what the processes tell, also when it is no news: a pipe that is full would hold them up."""
        while self._heard.poll():
            self._heard.recv_bytes()
            if not self._told_listening:
                self._told_listening = True
                self._on_listening()

    def _bury(self) -> bool:
        """Forget the dead; True: one of them ended for a reason that its successor would end for, too."""
        from prometheus_client.multiprocess import mark_process_dead  # noqa: PLC0415

        dead = [process for process in self._processes if not process.is_alive()]
        self._processes = [process for process in self._processes if process not in dead]
        for process in dead:
            mark_process_dead(process.pid)  # type: ignore[no-untyped-call]
            if not self._stop.requested:
                logger.error("worker_died", extra={"worker": process.pid, "exit_status": process.exitcode})
        if any((process.exitcode or 0) > 0 for process in dead):  # a signal's status is negative
            return True
        if dead and not self._stop.requested:
            time.sleep(RESTART_SECONDS)  # one that dies at once shall not keep the machine busy with starting it
        return False

    def _end(self) -> bool:
        """Ask all to end, and wait; False: some had to be killed."""
        for process in self._processes:
            process.terminate()
        deadline = time.monotonic() + self._settings.shutdown_timeout_s + FAREWELL_SECONDS + KILL_AFTER_SECONDS
        for process in self._processes:
            process.join(max(0.0, deadline - time.monotonic()))
        stuck = [process for process in self._processes if process.is_alive()]
        for process in stuck:
            logger.error("worker_killed", extra={"worker": process.pid})
            process.kill()
            process.join()
        return not stuck


def _serve_in_child(
    settings: ServiceSettings, load_detector: DetectorLoader | None, parent: int, tell: Connection
) -> None:
    stop = StopSignals()
    stop.install()
    _end_with(parent)
    try:
        serve(settings, load_detector, stop, on_listening=lambda listener: tell.send_bytes(b"."), shared=True)
    except ViflowError as err:
        sys.stderr.write(f"error: {' '.join(err.message.split())} [{err.code}]\n")
        sys.exit(EXIT_BAD_INPUT)


def _end_with(parent: int) -> None:
    """A parent that is killed takes its processes along: else they would hold the address."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGTERM)
