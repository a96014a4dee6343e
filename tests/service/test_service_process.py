"""The server as a process: it starts, says where, ends well on a signal, and says why when it cannot start."""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from serving_process import serving_process

from viflow_anomaly.errors import CheckpointError, ConfigError
from viflow_anomaly_service import server as service_server
from viflow_anomaly_service.__main__ import main
from viflow_anomaly_service.settings import ServiceSettings


def run_module(**environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "viflow_anomaly_service"],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_wrong_settings_end_the_process_with_status_2() -> None:
    ended = run_module(VIFLOW_PORT="ninety")
    assert ended.returncode == 2
    assert "port" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_a_misspelt_variable_ends_the_process_with_status_2() -> None:
    ended = run_module(VIFLOW_PROT="8000")
    assert ended.returncode == 2
    assert "found VIFLOW_PROT; the closest known one is VIFLOW_PORT" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_a_port_in_use_ends_the_process_with_status_2() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        ended = run_module(VIFLOW_PORT=str(port))
    assert ended.returncode == 2
    assert f"127.0.0.1:{port}" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.fixture
def untouched_logging(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    root = logging.getLogger()
    level = root.level
    monkeypatch.setattr(root, "handlers", list(root.handlers))
    yield
    root.setLevel(level)


def test_run_ends_with_the_error_of_a_model_that_cannot_be_loaded(
    untouched_logging: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)

    def load(settings: ServiceSettings) -> Any:
        raise CheckpointError("model.safetensors: expected a checkpoint", code="checkpoint_truncated")

    with pytest.raises(CheckpointError, match=r"model\.safetensors"):
        service_server.run(ServiceSettings(port=0), load_detector=load)
    assert os.environ["OMP_WAIT_POLICY"] == "PASSIVE"


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize(
    ("setup", "settings", "told"),
    [
        ("sys.modules['sqlalchemy'] = None", {"store_url": "unused.db"}, "pip install 'viflow-anomaly[store]'"),
        ("pass", {"mqtt_url": "mqtt://a.example"}, "mqtt_url: expected a store beside it"),
    ],
)
def test_what_cannot_be_used_ends_the_service_before_it_listens(
    workers: int, setup: str, settings: dict[str, Any], told: str
) -> None:
    with serving_process(setup=setup, workers=workers, ready=False, **settings) as serving:
        assert serving.process.wait(timeout=60) != 0
    assert any(told in line for line in serving.other_lines)
    assert not serving.events("listening")


@pytest.mark.parametrize("workers", [1, 2])
def test_where_it_listens_is_told_once_and_is_answered(workers: int) -> None:
    with serving_process(workers=workers) as serving, serving.client() as client:
        assert client.get("/healthz").status_code == 200
        (told,) = serving.events("listening")
        assert (told["host"], told["workers"]) == ("127.0.0.1", workers)


def test_bind_both_families_and_refuses_what_is_not_ours() -> None:
    with service_server.bind("127.0.0.1", 0) as listener:
        assert listener.family == socket.AF_INET
        with socket.create_connection(listener.getsockname(), timeout=5):
            accepted, _ = listener.accept()
            with accepted:
                assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        with pytest.raises(ConfigError) as caught:
            service_server.bind(*listener.getsockname())
        assert (caught.value.code, caught.value.field) == ("address_unavailable", "port")
    for host in ("203.0.113.7", "no such host", "::ffff:203.0.113.7"):
        with pytest.raises(ConfigError, match="found"):
            service_server.bind(host, 0)


def test_importing_the_service_loads_no_torch() -> None:
    code = "import sys, viflow_anomaly_service.server; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0


def test_main_turns_errors_into_a_status(
    untouched_logging: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("VIFLOW_PORT", "-5")
    assert main() == 2
    assert capsys.readouterr().err.startswith("error: service settings: port")


def test_arguments_are_refused_and_not_passed_over(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 2
    found = capsys.readouterr().err
    assert "found '--help'" in found
    assert "viflow-anomaly serve --help" in found


def test_main_ends_with_status_0(monkeypatch: pytest.MonkeyPatch) -> None:
    served: list[ServiceSettings] = []
    monkeypatch.setenv("VIFLOW_PORT", "1234")
    monkeypatch.setattr("viflow_anomaly_service.__main__.run", served.append)
    assert main() == 0
    assert [settings.port for settings in served] == [1234]
