"""The parent of several processes and the wish to end, without processes: what is done about each way of dying."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from viflow_anomaly.errors import ConfigError
from viflow_anomaly_service import metrics_folder as metrics_folder_module
from viflow_anomaly_service import supervisor as supervisor_module
from viflow_anomaly_service.metrics_folder import metrics_folder
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


def test_without_a_folder_in_memory_the_temporary_one_is_taken(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(metrics_folder_module, "MEMORY_FOLDER", "/no such place")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with metrics_folder() as folder:
        assert Path(folder).parent == tmp_path
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_service_left_behind_is_removed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(metrics_folder_module, "MEMORY_FOLDER", str(tmp_path))
    left, just_made, other = (tmp_path / f"viflow-metrics-{name}" for name in ("left", "made", "other"))
    for folder in (left, just_made, other):
        folder.mkdir()
        (folder / "counter_1.db").touch()
    for folder in (left, just_made):
        (folder / "held").touch()
    os.utime(left / "held", (1.0, 1.0))
    with metrics_folder() as first:
        os.utime(Path(first) / "held", (1.0, 1.0))
        with metrics_folder() as second:  # another service on the machine
            assert set(tmp_path.iterdir()) == {just_made, other, Path(first), Path(second)}


HELD_BY_A_CHILD = """
import os, sys
from viflow_anomaly_service import metrics_folder

metrics_folder.MEMORY_FOLDER = sys.argv[1]
with metrics_folder.metrics_folder() as folder:
    os.utime(os.path.join(folder, "held"), (1.0, 1.0))
    if os.fork() == 0:
        sys.stdin.read()
    os._exit(0)
"""


def test_a_process_that_outlives_its_parent_keeps_its_numbers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(metrics_folder_module, "MEMORY_FOLDER", str(tmp_path))
    command = [sys.executable, "-c", HELD_BY_A_CHILD, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as parent:
        assert parent.wait(60) == 0
        (held,) = tmp_path.iterdir()
        with metrics_folder():
            assert held.exists()
        assert parent.stdin is not None
        assert parent.stdout is not None
        parent.stdin.close()
        parent.stdout.read()  # ends with the last process that holds it
    with metrics_folder():
        assert not held.exists()


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
