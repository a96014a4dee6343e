"""SIGTERM and SIGINT: what was accepted is answered, what cannot be finished is refused, the status is 0."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from rule_detector import RuleDetector
from service_world import assert_problem, json_request, live_server, wait_until
from serving_process import ServingProcess, serving_process
from test_service_load import begin_request

STOP = [signal.SIGTERM, signal.SIGINT]
PATIENT = {"queue_timeout_s": 60.0, "shutdown_timeout_s": 60}
"""A process's first pair takes seconds on a busy machine."""


def in_flight(serving: ServingProcess) -> float:
    with serving.client() as client:
        lines = client.get("/metrics").text.splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("viflow_requests_in_flight "))


@pytest.mark.parametrize("number", STOP)
def test_accepted_work_is_finished_also_what_still_waits(number: signal.Signals) -> None:
    with (
        serving_process(delay_s=0.4, max_concurrent=1, max_queued=3, **PATIENT) as serving,
        serving.client() as client,
        ThreadPoolExecutor(max_workers=4) as clients,
    ):
        running = [clients.submit(client.post, "/detect", json=json_request(seed=seed)) for seed in range(4)]
        wait_until(lambda: in_flight(serving) == 4, seconds=30)
        serving.process.send_signal(number)
        assert [answer.result().status_code for answer in running] == [200] * 4
        assert serving.process.wait(timeout=15) == 0
        wait_until(lambda: serving.statuses() == [200] * 4)
        assert not [line for line in serving.log if line["level"] == "error"]
        assert not serving.other_lines


def test_what_cannot_be_finished_in_time_is_refused_not_dropped() -> None:
    with (
        serving_process(delay_s=3.0, max_concurrent=1, max_queued=3, shutdown_timeout_s=1) as serving,
        serving.client() as client,
        ThreadPoolExecutor(max_workers=2) as clients,
    ):
        running = [clients.submit(client.post, "/detect", json=json_request(seed=seed)) for seed in range(2)]
        with begin_request(serving.port, b"{", announced=1000) as uploading:
            wait_until(lambda: in_flight(serving) == 3)
            serving.process.terminate()
            for answer in running:
                assert_problem(answer.result(), 503, "shutting_down", None)
                assert answer.result().headers["retry-after"] == "1"
            assert uploading.recv(65536).startswith(b"HTTP/1.1 503 ")
        assert serving.process.wait(timeout=20) == 0


def test_a_signal_while_the_model_loads() -> None:
    with serving_process(before_load="time.sleep(1)", ready=False) as serving:
        serving.process.terminate()
        assert serving.process.wait(timeout=20) == 0


def test_nobody_is_admitted_once_the_gate_is_closed() -> None:
    with live_server(lambda settings: RuleDetector()) as server:
        server.app.state.core.gate.close()
        for response in (server.client.get("/readyz"), server.post_json(json_request())):
            assert_problem(response, 503, "shutting_down", None)
        assert server.client.get("/healthz").status_code == 200


def test_several_processes_finish_their_work_and_end_together() -> None:
    with serving_process(delay_s=0.5, workers=2, max_concurrent=1, max_queued=8, **PATIENT) as serving:
        with ThreadPoolExecutor(max_workers=6) as clients:

            def ask(seed: int) -> int:
                with serving.client() as client:
                    return client.post("/detect", json=json_request(seed=seed)).status_code

            running = [clients.submit(ask, seed) for seed in range(6)]
            wait_until(lambda: in_flight(serving) == 6, seconds=30)
            serving.process.terminate()
            assert [answer.result() for answer in running] == [200] * 6
        assert serving.process.wait(timeout=20) == 0
        assert not [line for line in serving.log if line["level"] == "error"]


def test_several_processes_answer_and_their_numbers_add_up() -> None:
    with serving_process(workers=2) as serving:
        pids = {record["pid"] for record in serving.events("model_loaded")}
        assert len(pids) == 2
        for seed in range(12):  # a connection each, which the system deals out
            with serving.client() as client:
                assert client.post("/detect", json=json_request(seed=seed)).status_code == 200
        for _ in range(4):
            with serving.client() as client:
                text = client.get("/metrics").text
            assert 'viflow_detections_total{model="default",status="ok"} 12.0' in text
            assert "viflow_ready_processes 2.0" in text
            for pid in pids:
                assert f'viflow_resident_memory_bytes{{pid="{pid}"}}' in text
        serving.process.terminate()
        assert serving.process.wait(timeout=20) == 0


def test_a_process_that_dies_is_replaced_and_counts_no_longer() -> None:
    with serving_process(workers=2) as serving:
        victim = serving.events("worker_started")[0]["worker"]
        os.kill(victim, signal.SIGKILL)
        wait_until(lambda: len(serving.events("model_loaded")) == 3, seconds=30)
        (died,) = serving.events("worker_died")
        assert (died["worker"], died["exit_status"]) == (victim, -signal.SIGKILL)
        with serving.client() as client:
            text = client.get("/metrics").text
        assert "viflow_ready_processes 2.0" in text
        assert f'pid="{victim}"' not in text


def test_processes_end_with_a_parent_that_is_killed() -> None:
    with serving_process(workers=2) as serving:
        serving.process.kill()
        serving.process.wait()

        def refused() -> bool:
            try:
                socket.create_connection(("127.0.0.1", serving.port), timeout=5).close()
            except ConnectionRefusedError:
                return True
            return False

        wait_until(refused, seconds=20)


def test_processes_whose_model_cannot_be_loaded_end_the_service_with_its_message() -> None:
    failing = (
        "from viflow_anomaly.errors import CheckpointError; raise CheckpointError('model: broken', code='checkpoint_x')"
    )
    with serving_process(workers=2, before_load=failing, ready=False) as serving:
        assert serving.process.wait(timeout=30) != 0
        wait_until(lambda: any("ConfigError: workers: expected 2 processes" in line for line in serving.other_lines))
        assert "error: model: broken [checkpoint_x]\n" in serving.other_lines


def test_the_address_of_another_service_is_refused_also_for_several_processes() -> None:
    with serving_process(workers=2) as serving:
        command = [sys.executable, "-m", "viflow_anomaly_service"]
        ended = subprocess.run(
            command,
            env=os.environ | {"VIFLOW_PORT": str(serving.port), "VIFLOW_WORKERS": "2"},
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert ended.returncode == 2
        assert f"127.0.0.1:{serving.port}" in ended.stderr


def test_who_is_inside_when_the_time_is_up_is_refused_and_the_worker_told() -> None:
    may_go = threading.Event()
    detector = RuleDetector(may_go=may_go)
    with (
        live_server(lambda settings: detector, max_concurrent=1, max_queued=1) as server,
        ThreadPoolExecutor(max_workers=2) as clients,
    ):
        try:
            running = [clients.submit(server.post_json, json_request()) for _ in range(2)]
            wait_until(lambda: server.app.state.core.gate.present == 2)
            wait_until(lambda: len(detector.calls) == 1)
            gate = server.app.state.core.gate
            server.loop.call_soon_threadsafe(gate.expel)
            for answer in running:
                assert_problem(answer.result(), 503, "shutting_down", None)
            assert gate.present == 0
        finally:
            may_go.set()
        assert server.post_json(json_request()).status_code == 200
        assert len(detector.calls) == 2
