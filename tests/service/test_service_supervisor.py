"""The parent of several processes and the wish to end, without processes: what is done about each way of dying."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from viflow_anomaly.errors import ConfigError
from viflow_anomaly_service import supervisor as supervisor_module
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.stop_signals import StopSignals
from viflow_anomaly_service.supervisor import Supervisor, supervise


class Worker:
    """Stands in for a process."""

    def __init__(self, *, exitcode: int | None = None, obeys: bool = True) -> None:
        self.pid = 4_000_000
        self.exitcode = exitcode
        self.obeys = obeys
        self.killed = False
        self.sentinel = os.pipe()[0]

    def is_alive(self) -> bool:
        return self.exitcode is None

    def terminate(self) -> None:
        if self.obeys:
            self.exitcode = 0

    def kill(self) -> None:
        self.killed = True
        self.exitcode = -signal.SIGKILL

    def join(self, timeout: float | None = None) -> None:
        assert timeout is None or timeout < 100


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    monkeypatch.setattr(supervisor_module, "RESTART_SECONDS", 0.0)
    monkeypatch.setattr(supervisor_module, "LOOK_SECONDS", 0.0)
    monkeypatch.setenv("PROMETHEUS_MULTIPROC_DIR", str(tmp_path))


def started_with(
    monkeypatch: pytest.MonkeyPatch,
    coming: list[Worker],
    *,
    stop_after: int,
    on_listening: Callable[[], None] = lambda: None,
) -> Supervisor:
    """A supervisor of two whose processes are ``coming``, one after the other; ends when that many were started. Each
    says at once that it listens."""
    stop = StopSignals()
    supervisor = Supervisor(ServiceSettings(workers=2), None, stop, on_listening=on_listening)
    started: list[Worker] = []

    def process(*, args: tuple[Any, ...], **_: Any) -> Any:
        args[-1].send_bytes(b".")
        worker = coming[len(started)]
        started.append(worker)
        stop.requested = len(started) == stop_after
        worker.start = lambda: None  # type: ignore[attr-defined]
        return worker

    monkeypatch.setattr(supervisor, "_context", SimpleNamespace(Process=process))
    return supervisor


def test_a_process_that_a_signal_ended_is_replaced(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    workers = [Worker(exitcode=-signal.SIGKILL), Worker(), Worker()]
    started_with(monkeypatch, workers, stop_after=3).run()
    assert [worker.exitcode for worker in workers] == [-signal.SIGKILL, 0, 0]
    assert caplog.messages == ["worker_died"]


def test_the_first_process_that_listens_is_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    workers = [Worker(exitcode=-signal.SIGKILL), Worker(), Worker()]
    started_with(monkeypatch, workers, stop_after=3, on_listening=lambda: told.append("listening")).run()
    assert told == ["listening"]


def test_a_process_that_cannot_start_ends_all(monkeypatch: pytest.MonkeyPatch) -> None:
    workers = [Worker(exitcode=2), Worker()]
    with pytest.raises(ConfigError, match="found one that could not start") as caught:
        started_with(monkeypatch, workers, stop_after=99).run()
    assert caught.value.code == "workers_failed"
    assert workers[1].exitcode == 0


def test_a_process_that_does_not_end_is_killed(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    workers = [Worker(obeys=False), Worker()]
    with pytest.raises(ConfigError, match="found one that had to be killed"):
        started_with(monkeypatch, workers, stop_after=2).run()
    assert [worker.killed for worker in workers] == [True, False]
    assert "worker_killed" in caplog.messages


def test_another_system_than_linux_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    with pytest.raises(ConfigError, match="several need Linux") as caught:
        supervise(ServiceSettings(workers=2), None, StopSignals())
    assert (caught.value.code, caught.value.field) == ("workers_unsupported", "workers")


def test_without_a_folder_in_memory_the_temporary_one_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor_module, "MEMORY_FOLDER", "/no such place")
    assert supervisor_module._memory_folder() is None


WISH = """
import os, signal, sys, time
from types import SimpleNamespace
from viflow_anomaly_service.stop_signals import StopSignals

number = int(sys.argv[1])
before = signal.getsignal(number)
stop = StopSignals()
stop.install()
early, late = SimpleNamespace(should_exit=None), SimpleNamespace(should_exit=None)
stop.tell(early)
assert early.should_exit is False
os.kill(os.getpid(), number)
while not stop.requested:
    time.sleep(0.01)
assert early.should_exit is True
stop.tell(late)
assert late.should_exit is True
stop.restore()
assert signal.getsignal(number) is before
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_a_wish_before_and_after_there_is_a_server(number: signal.Signals) -> None:
    """In a process of its own: one whose main thread has dropped an OpenVINO model does not survive any signal."""
    subprocess.run([sys.executable, "-c", WISH, str(int(number))], check=True, timeout=60)
