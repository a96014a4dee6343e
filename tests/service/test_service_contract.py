"""The OpenAPI document and the service agree: what schemathesis makes of the one, the other answers as it says."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import httpx
import pytest
from rule_detector import RuleDetector
from service_world import LiveServer, live_server

from viflow_anomaly_service.api_keys import new_key

pytest.importorskip("schemathesis")
pytestmark = pytest.mark.timeout(280)
ENDLESS = r"^/(events/live|live/pairs|streams/\{stream_id\}/live)$"
"""Answers that go on for as long as somebody listens: tests of their own read them."""
EXAMPLES = "4"
"""Random ones for each operation, beside those that cover each rule of a schema."""


def check_contract(server: LiveServer, folder: Path, *options: str) -> None:
    """All checks in all phases (examples, coverage, fuzzing, stateful)."""
    program = "from schemathesis.cli import schemathesis; schemathesis()"
    document = f"http://127.0.0.1:{server.port}/openapi.json"
    config = str(Path(__file__).with_name("schemathesis.toml"))
    command = [sys.executable, "-c", program, "--config-file", config, "run", document, "--checks", "all"]
    # One worker: in threads, the parser of Python 3.11, which Hypothesis needs, miscounts its recursion at times.
    command += [
        "--no-color",
        "--max-examples",
        EXAMPLES,
        "--generation-deterministic",
        "--workers",
        "1",
        "--no-shrink",
        "--exclude-path-regex",
        ENDLESS,
        *options,
    ]
    answer = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=240, check=False)
    assert answer.returncode == 0, f"{answer.stdout[:8000]}\n...\n{answer.stdout[-2000:]}{answer.stderr[-2000:]}"


def test_without_keys_and_store(tmp_path: Path) -> None:
    with live_server(lambda settings: RuleDetector()) as server:
        check_contract(server, tmp_path, "--phases", "examples")


def test_with_keys_and_a_store(tmp_path: Path) -> None:
    shown, line = new_key("contract", ["admin"])
    keys = tmp_path / "keys.txt"
    keys.write_text(f"{line}\n", encoding="utf-8")
    with live_server(lambda settings: RuleDetector(), key_file=keys, store_url=str(tmp_path / "x.db")) as server:
        check_contract(server, tmp_path, "--header", f"Authorization: Bearer {shown}")


@pytest.mark.parametrize(
    ("method", "path", "allowed"),
    [
        ("PUT", "/streams/a", "DELETE, GET, HEAD, OPTIONS"),
        ("GET", "/detect", "OPTIONS, POST"),
        ("POST", "/detections/a", "GET, HEAD, OPTIONS"),
        ("PATCH", "/models/default", "OPTIONS, PUT"),
        ("PUT", "/models/day", "DELETE, OPTIONS"),
    ],
)
def test_a_wrong_method_is_told_all_that_are_right(server: LiveServer, method: str, path: str, allowed: str) -> None:
    answer: httpx.Response = server.client.request(method, path)
    assert answer.status_code == 405
    assert answer.headers["allow"] == allowed
