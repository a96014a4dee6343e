"""What breaks around a service that runs for years: disks, clocks, clients; docs/reliability.md lists all tests."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest
from rule_detector import RuleDetector
from service_world import assert_problem, json_request, live_server, problem_of, wait_until
from serving_process import serving_process

from viflow_anomaly_service.rate_limits import DAY_SECONDS, Allowance, RateLimiter
from viflow_anomaly_service.store import keeper as keeper_module
from viflow_anomaly_service.store.age_clock import DOUBT_SECONDS, AgeClock
from viflow_anomaly_service.store.detection_store import DetectionStore
from viflow_anomaly_service.store.record import IdMaker, Record


@contextlib.contextmanager
def small_disk(folder: Path, *, kib: int) -> Iterator[Path]:
    """A file system of its own, which needs rights that only some have."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={kib}k", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("a file system of a test's own needs root and the right to mount")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def is_ready(client: httpx.Client) -> bool:
    return client.get("/readyz").status_code == 200


def stored_ids(client: httpx.Client) -> set[str]:
    lines = client.get("/detections.ndjson").text.splitlines()
    return {json.loads(line)["id"] for line in lines}


def test_a_disk_that_fills_up_loses_nothing_that_was_answered(tmp_path: Path) -> None:
    with (
        small_disk(tmp_path / "disk", kib=1200) as disk,
        live_server(lambda settings: RuleDetector(), store_url=str(disk / "x.db")) as server,
    ):
        acknowledged = {server.post_json(json_request()).headers["x-detection-id"]}
        filler = disk / "filler"
        with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
            while True:
                file.write(bytes(4096))
        answers = []
        wait_until(lambda: answers.append(server.post_json(json_request())) or answers[-1].status_code == 503)
        assert_problem(answers[-1], 503, "store_full", None)
        assert int(answers[-1].headers["retry-after"]) > 0
        acknowledged |= {one.headers["x-detection-id"] for one in answers if one.status_code == 200}
        assert server.client.get("/healthz").status_code == 200
        assert stored_ids(server.client) == acknowledged
        filler.unlink()
        wait_until(lambda: is_ready(server.client), seconds=30)
        assert server.post_json(json_request()).status_code == 200
        assert stored_ids(server.client) > acknowledged


def test_a_disk_that_is_read_only_at_the_start(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", kib=2000) as disk:
        store = DetectionStore(str(disk / "x.db"))
        store.add([Record(IdMaker()(), 0, 1, "{}")])
        store.close()
        remount = ["mount", "-o", "remount,ro", str(disk)]
        subprocess.run(remount, check=True)
        with live_server(lambda settings: RuleDetector(), ready=False, store_url=str(disk / "x.db")) as server:
            wait_until(lambda: server.client.get("/readyz").json().get("code") == "store_read_only")
            assert_problem(server.post_json(json_request()), 503, "store_read_only", None)
            subprocess.run([*remount[:2], "remount,rw", str(disk)], check=True)
            wait_until(lambda: is_ready(server.client), seconds=30)
            assert server.post_json(json_request()).status_code == 200
            assert len(stored_ids(server.client)) == 2


def test_a_log_that_cannot_be_written_stops_nobody(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("the system has no /dev/full")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    program = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from rule_detector import RuleDetector\n"
        "from viflow_anomaly_service.server import run\n"
        "from viflow_anomaly_service.settings import load_settings\n"
        f"run(load_settings(port={port}, warm_up=''), load_detector=lambda settings: RuleDetector())\n"
    )
    with Path("/dev/full").open("wb") as full:
        process = subprocess.Popen([sys.executable, "-c", program], stderr=full, stdout=full)
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", trust_env=False, timeout=20) as client:

            def answers() -> bool:
                with contextlib.suppress(httpx.TransportError):
                    return is_ready(client)
                return False

            wait_until(answers, seconds=30)
            assert [client.post("/detect", json=json_request()).status_code for _ in range(3)] == [200] * 3
        process.terminate()
        assert process.wait(timeout=20) == 0
    finally:
        process.kill()
        process.wait()


def test_clients_of_a_killed_process_see_a_broken_connection_a_refusal_or_the_right_answer() -> None:
    """The other process goes on; a new one takes the place of the dead."""
    outcomes: list[str] = []

    def ask(port: int) -> None:
        for _ in range(30):
            try:
                answer = httpx.post(f"http://127.0.0.1:{port}/detect", json=json_request(), timeout=30, trust_env=False)
                outcomes.append("right" if answer.status_code == 200 else problem_of(answer)["code"])
            except httpx.TransportError:
                outcomes.append("broken")

    with serving_process(workers=2, delay_s=0.01) as serving, ThreadPoolExecutor(4) as clients:
        asking = [clients.submit(ask, serving.port) for _ in range(4)]
        wait_until(lambda: len(outcomes) > 10, seconds=30)
        os.kill(serving.events("worker_started")[0]["worker"], signal.SIGKILL)
        for one in asking:
            one.result()
        wait_until(lambda: len(serving.events("model_loaded")) == 3, seconds=30)
        with serving.client() as client:
            assert client.post("/detect", json=json_request()).status_code == 200
    assert set(outcomes) <= {"right", "broken", "model_loading"}  # the new process listens before it is ready
    assert outcomes.count("broken") <= 8
    assert outcomes.count("right") >= 60


class Clock:
    def __init__(self) -> None:
        self.seconds = 1_700_000_000.0

    def __call__(self) -> float:
        return self.seconds


@pytest.mark.parametrize("jump_s", [86_400.0 * 400, -86_400.0 * 400])
def test_a_clock_that_jumps_deletes_nothing_and_stops_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, jump_s: float
) -> None:
    monkeypatch.setattr(keeper_module, "PRUNE_SECONDS", 0.05)
    real, offset = time.time, [0.0]
    monkeypatch.setattr(time, "time", lambda: real() + offset[0])
    monkeypatch.setattr(time, "time_ns", lambda: int((real() + offset[0]) * 1e9))
    with live_server(
        lambda settings: RuleDetector(), store_url=str(tmp_path / "x.db"), store_max_age_s=3600, rate_limit_per_s=1000
    ) as server:
        ids = [server.post_json(json_request()).headers["x-detection-id"]]
        offset[0] = jump_s
        ids += [server.post_json(json_request()).headers["x-detection-id"] for _ in range(3)]
        wait_until(lambda: "clock_jumped" in [record.getMessage() for record in caplog.records])
        offset[0] = 0.0
        ids += [server.post_json(json_request()).headers["x-detection-id"] for _ in range(3)]
        assert ids == sorted(ids)
        assert stored_ids(server.client) == set(ids)
        assert is_ready(server.client)


def test_a_clock_that_was_set_is_believed_after_an_hour(caplog: pytest.LogCaptureFixture) -> None:
    wall, steady = Clock(), Clock()
    clock = AgeClock(wall, steady)
    assert clock.is_believed()
    wall.seconds += 1e7
    assert not clock.is_believed()
    assert [record.getMessage() for record in caplog.records] == ["clock_jumped"]
    for one in (wall, steady):
        one.seconds += DOUBT_SECONDS - 1
    assert not clock.is_believed()
    for one in (wall, steady):
        one.seconds += 2
    assert clock.is_believed()
    wall.seconds += 30  # what a time server corrects
    assert clock.is_believed()


def test_a_clock_that_was_far_ahead_does_not_stop_the_quota_for_good() -> None:
    clock = Clock()
    limiter, allowance = RateLimiter(clock), Allowance(rate_per_s=None, burst=1, daily=1)
    clock.seconds += 300 * DAY_SECONDS
    limiter.charge("drone", allowance, detection=True)
    clock.seconds -= 300 * DAY_SECONDS
    limiter.charge("drone", allowance, detection=True)  # today's


def big_store(path: Path, *, detections: int, size: int) -> None:
    store, new_id = DetectionStore(str(path)), IdMaker()
    store.add([Record(new_id(), 0, 1, json.dumps("x" * size)) for _ in range(detections)])
    store.close()


def test_a_client_that_stops_reading_is_given_up(tmp_path: Path) -> None:
    big_store(tmp_path / "x.db", detections=600, size=100_000)
    wanted = 600 * 100_000
    settings = {"store_url": str(tmp_path / "x.db"), "request_timeout_s": 1.0}
    with (
        live_server(lambda settings: RuleDetector(), **settings) as server,
        socket.create_connection(("127.0.0.1", server.port)) as client,
    ):
        client.settimeout(30)
        client.sendall(b"GET /detections.ndjson HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert client.recv(1000).startswith(b"HTTP/1.1 200")
        for _ in range(3):
            assert server.client.get("/healthz").status_code == 200
            assert server.post_json(json_request()).status_code == 200
        wait_until(lambda: "viflow_clients_gone_total 1.0" in server.client.get("/metrics").text, seconds=30)
        received = 0
        with contextlib.suppress(OSError):
            while chunk := client.recv(2**20):
                received += len(chunk)
        assert received < wanted
        assert server.client.get("/readyz").status_code == 200
