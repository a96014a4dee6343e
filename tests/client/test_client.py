"""The client against real servers: ours, and made-up ones that answer what a test wants."""

from __future__ import annotations

import asyncio
import json
import pickle
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client_world import frame_pair, guarded_service

from viflow_anomaly.client import (
    AsyncClient,
    Client,
    EncodedPair,
    RetryPolicy,
    ServiceBusyError,
    ServiceError,
    ServiceFaultError,
    ServiceRefusedError,
    ServiceUnreachableError,
    read_api_key,
)
from viflow_anomaly.client.answers import retry_after_s
from viflow_anomaly.client.retry_policy import Attempts
from viflow_anomaly.detection import Detection, to_json_dict
from viflow_anomaly.errors import ConfigError, ViflowError
from viflow_anomaly.sensor_data import ImuSamples

QUICK = RetryPolicy(attempts=3, first_wait_s=0.01, longest_wait_s=2.0)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, dict[str, str]]]:
    with guarded_service(tmp_path_factory.mktemp("keys")) as running:
        yield running


def without_times(detection: Detection) -> dict[str, Any]:
    values = to_json_dict(detection)
    del values["timings_ms"]
    return values


# --- against the service


def test_it_gets_what_the_detector_says(service: tuple[str, dict[str, str]]) -> None:
    from rule_detector import RuleDetector  # noqa: PLC0415

    url, keys = service
    pair = frame_pair()
    with Client(url, api_key=keys["drone"]) as client:
        assert client.is_ready()
        detection = client.detect(pair)
    assert without_times(detection) == without_times(RuleDetector().detect(pair))


def test_the_asynchronous_one_gets_the_same(service: tuple[str, dict[str, str]]) -> None:
    url, keys = service

    async def ask() -> tuple[bool, list[Detection], str]:
        async with AsyncClient(url, api_key=keys["drone"]) as client:
            found = await asyncio.gather(*(client.detect(frame_pair()) for _ in range(4)))
            return await client.is_ready(), found, (await client.version())["schema_version"]

    ready, found, version = asyncio.run(ask())
    with Client(url, api_key=keys["drone"]) as client:
        expected = without_times(client.detect(frame_pair()))
    assert (ready, version) == (True, "1.0")
    assert [without_times(detection) for detection in found] == [expected] * 4


def test_options_reach_the_service(service: tuple[str, dict[str, str]]) -> None:
    url, keys = service
    with Client(url, api_key=keys["drone"]) as client:
        masked = client.detect(frame_pair(), include_masks=True, regions={"max_regions": 1})
        assert len(masked.rois) == 1
        assert masked.rois[0].mask_rle is not None
        with pytest.raises(ServiceRefusedError, match="422") as caught:
            client.detect(frame_pair(), regions={"max_regions": 0})
    assert caught.value.field is not None
    assert caught.value.field.endswith("regions.max_regions")
    assert caught.value.request_id


def test_camera_gyro_alone_and_command_are_sent() -> None:
    pair = frame_pair()
    gyro_only = ImuSamples(pair.imu.timestamps_ns, pair.imu.gyro_rad_s, None)
    encoded = EncodedPair(b"s", b"t", 1, 2, gyro_only, motor_command=(0.5, 1.0))
    parts = encoded.parts(include_masks=False, regions=None)
    assert "accel_m_s2" not in json.loads(parts["imu"][1])
    assert json.loads(parts["request"][1])["motor_command"] == [0.5, 1.0]
    whole = EncodedPair.of(pair).parts(include_masks=True, regions=None)
    assert json.loads(whole["request"][1])["camera"]["fx"] == 70.0
    assert whole["source"][1].startswith(b"\x89PNG")


def test_models_and_version_need_their_scope(service: tuple[str, dict[str, str]]) -> None:
    url, keys = service
    with Client(url, api_key=keys["reader"]) as client:
        assert client.models()["models"][0]["name"] == "rule"
        with pytest.raises(ServiceRefusedError) as caught:
            client.detect(frame_pair())
    assert (caught.value.status, caught.value.code) == (403, "scope_missing")
    with Client(url) as stranger, pytest.raises(ServiceRefusedError) as caught:
        stranger.version()
    assert (caught.value.status, caught.value.code) == (401, "key_missing")


def test_a_spent_quota_is_told_at_once(service: tuple[str, dict[str, str]]) -> None:
    url, keys = service
    with Client(url, api_key=keys["poor"], retries=RetryPolicy(longest_wait_s=0.5)) as client:
        client.detect(frame_pair())
        with pytest.raises(ServiceBusyError) as caught:
            client.detect(frame_pair())
    assert caught.value.code == "quota_exhausted"
    assert (caught.value.retry_after_s or 0) >= 1


# --- against made-up servers


@dataclass
class MadeUpServer:
    """Answers each request with the next of ``answers``; the last one again and again."""

    answers: list[tuple[int, dict[str, str], bytes]]
    url: str = ""
    requests: list[tuple[str, str, dict[str, str], bytes]] = field(default_factory=list)


@contextmanager
def made_up(*answers: tuple[int, dict[str, str], bytes]) -> Iterator[MadeUpServer]:
    state = MadeUpServer(list(answers))

    class Handler(BaseHTTPRequestHandler):
        def answer(self) -> None:
            body = self.rfile.read(int(self.headers.get("content-length", 0)))
            state.requests.append((self.command, self.path, {k.lower(): v for k, v in self.headers.items()}, body))
            status, headers, content = state.answers.pop(0) if len(state.answers) > 1 else state.answers[0]
            self.send_response(status)
            for name, value in {"Content-Length": str(len(content)), **headers}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)

        do_GET = do_POST = answer  # noqa: N815

        def log_message(self, *arguments: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    state.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield state
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def problem(status: int, code: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    body = {"type": "about:blank", "status": status, "code": code, "detail": "expected x", "request_id": "r1"}
    return status, {"Content-Type": "application/problem+json", **headers}, json.dumps(body).encode()


OK = (200, {"Content-Type": "application/json"}, b'{"version": "1"}')


@pytest.mark.parametrize("status", [408, 429, 502, 503, 504])
def test_what_may_pass_is_tried_again(status: int) -> None:
    with (
        made_up(problem(status, "busy"), problem(status, "busy"), OK) as server,
        Client(server.url, retries=QUICK) as c,
    ):
        assert c.version() == {"version": "1"}
    assert len(server.requests) == 3


@pytest.mark.parametrize(("status", "code"), [(400, "json_invalid"), (422, "x"), (500, "internal_error"), (401, "k")])
def test_what_will_not_pass_is_not(status: int, code: str) -> None:
    with made_up(problem(status, code), OK) as server, Client(server.url, retries=QUICK) as client:
        with pytest.raises(ServiceError) as caught:
            client.version()
        assert type(caught.value) is (ServiceFaultError if status == 500 else ServiceRefusedError)
    error = caught.value
    assert (error.status, error.code, error.request_id, len(server.requests)) == (status, code, "r1", 1)
    assert error.message == f"{server.url}: {status}: expected x"


def test_a_model_that_could_not_be_loaded_is_not_waited_for() -> None:
    with (
        made_up(problem(503, "model_load_failed"), OK) as server,
        Client(server.url, retries=QUICK) as client,
        pytest.raises(ServiceBusyError),
    ):
        client.version()
    assert len(server.requests) == 1


def test_attempts_end() -> None:
    with (
        made_up(problem(503, "overloaded")) as server,
        Client(server.url, retries=QUICK) as client,
        pytest.raises(ServiceBusyError) as caught,
    ):
        client.version()
    assert (caught.value.code, len(server.requests)) == ("overloaded", 3)


def test_retry_after_is_respected(monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []
    monkeypatch.setattr("viflow_anomaly.client.calling.time.sleep", slept.append)
    soon, late = {"Retry-After": "1"}, {"Retry-After": "3"}
    with made_up(problem(429, "rate_limited", **soon), OK) as server, Client(server.url, retries=QUICK) as client:
        client.version()
    assert slept == [1.0]
    with (
        made_up(problem(429, "rate_limited", **late), OK) as server,
        Client(server.url, retries=QUICK) as client,
        pytest.raises(ServiceBusyError) as caught,
    ):
        client.version()
    assert (slept, caught.value.retry_after_s) == ([1.0], 3.0)


def test_waits_double_within_their_limits() -> None:
    policy = RetryPolicy(attempts=5, first_wait_s=1.0, longest_wait_s=3.0, total_s=100.0)
    attempts, error = Attempts(policy), ServiceUnreachableError("x", code="service_unreachable")
    waits = [attempts.wait_after(error) for _ in range(4)]
    assert all(longest / 2 <= wait <= longest for wait, longest in zip(waits, (1.0, 2.0, 3.0, 3.0), strict=True))
    with pytest.raises(ServiceUnreachableError):
        attempts.wait_after(error)
    with pytest.raises(ServiceUnreachableError):
        Attempts(RetryPolicy(first_wait_s=5.0, total_s=1.0)).wait_after(error)


@pytest.mark.parametrize(
    ("text", "seconds"), [("7", 7.0), ("0", 0.0), ("", None), ("soon", None), ("-1", None), ("²", None)]
)
def test_retry_after_in_seconds(text: str, seconds: float | None) -> None:
    assert retry_after_s({"retry-after": text}) == seconds


def test_retry_after_as_a_date() -> None:
    later = format_datetime(datetime.now(UTC) + timedelta(seconds=60), usegmt=True)
    assert 55 <= (retry_after_s({"retry-after": later}) or 0) <= 60
    assert retry_after_s({"retry-after": "Wed, 21 Oct 2015 07:28:00 GMT"}) == 0.0


@pytest.mark.parametrize(
    ("answer", "kind"),
    [
        ((200, {}, b"<html>"), ServiceFaultError),
        ((200, {}, b"[1]"), ServiceFaultError),
        ((200, {}, b"[" * 100_000), ServiceFaultError),
        ((204, {}, b""), ServiceFaultError),
        ((302, {"Location": "http://elsewhere.example/"}, b""), ServiceFaultError),
        ((404, {}, b"nothing here"), ServiceFaultError),
        ((404, {"Content-Type": "application/problem+json"}, b"{}"), ServiceFaultError),
        ((404, {"Content-Type": "application/problem+json"}, b"{"), ServiceFaultError),
        ((502, {}, b"<html>bad gateway"), ServiceBusyError),
        (problem(200, "odd"), None),
    ],
)
def test_what_is_no_service_is_told(answer: tuple[int, dict[str, str], bytes], kind: type[Exception] | None) -> None:
    with made_up(answer) as server, Client(server.url, retries=RetryPolicy(attempts=1)) as client:
        if kind is None:
            assert client.version()["code"] == "odd"
            return
        with pytest.raises(kind, match=server.url):
            client.version()


def test_a_detection_that_is_none_is_told() -> None:
    with made_up(OK) as server, Client(server.url) as client, pytest.raises(ServiceFaultError) as caught:
        client.detect(frame_pair())
    assert caught.value.code == "service_answer_unreadable"


def test_nobody_there_and_silence_are_told_apart() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        with Client(url, timeout_s=0.2, retries=RetryPolicy(attempts=1)) as client:
            with pytest.raises(ServiceUnreachableError) as caught:
                client.version()
            assert caught.value.code == "service_timeout"
            assert not client.is_ready()
    with Client(url, retries=QUICK) as client, pytest.raises(ServiceUnreachableError) as caught:
        client.version()
    assert (caught.value.code, caught.value.status) == ("service_unreachable", None)


def test_the_key_goes_to_the_service_and_not_into_messages() -> None:
    with (
        made_up(problem(401, "key_invalid")) as server,
        Client(server.url, api_key="geheim") as client,
        pytest.raises(ServiceRefusedError) as caught,
    ):
        client.version()
    assert server.requests[0][2]["authorization"] == "Bearer geheim"
    assert "geheim" not in caught.value.message


def test_the_asynchronous_one_tries_again_and_gives_up_alike() -> None:
    async def ask(url: str) -> dict[str, Any]:
        async with AsyncClient(url, retries=QUICK) as client:
            return await client.version()

    with made_up(problem(503, "overloaded"), OK) as server:
        assert asyncio.run(ask(server.url)) == {"version": "1"}
    with made_up(problem(503, "overloaded")) as server, pytest.raises(ServiceBusyError):
        asyncio.run(ask(server.url))
    assert len(server.requests) == 3
    with pytest.raises(ServiceUnreachableError):
        asyncio.run(ask(server.url))


# --- arguments


@pytest.mark.parametrize(
    "url",
    [
        "",
        "127.0.0.1:8000",
        "ftp://x",
        "http://",
        "http://[",
        "http://a b",
        "http://x:99999",
        "http://x?y",
        "http://x/#y",
        "http://a..b:80",
        f"http://{'a' * 64}.example",
        "http://127.0.0.1:8000/\n",
    ],
)
def test_an_address_must_be_one(url: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Client(url)
    assert (caught.value.code, caught.value.field) == ("service_url_invalid", "url")


def test_an_address_holds_no_password() -> None:
    with pytest.raises(ConfigError) as caught:
        Client("http://me:geheim@127.0.0.1")
    assert "geheim" not in caught.value.message


@pytest.mark.parametrize("proxy", ["foo://x:1", "http://x:one"])
def test_proxies_must_be_usable(proxy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HTTP_PROXY", proxy)
    with pytest.raises(ConfigError, match="HTTP_PROXY") as caught:
        Client("http://10.0.0.7:8000")
    assert caught.value.code == "proxy_invalid"


@pytest.mark.parametrize(
    ("make", "code"),
    [
        (lambda: Client("http://x", api_key="a b"), "api_key_invalid"),
        (lambda: Client("http://x", api_key="a\r\nX: y"), "api_key_invalid"),
        (lambda: Client("http://x", api_key=""), "api_key_invalid"),
        (lambda: Client("http://x", timeout_s=0.0), "timeout_invalid"),
        (lambda: Client("http://x", timeout_s=float("inf")), "timeout_invalid"),
        (lambda: RetryPolicy(attempts=0), "retry_policy_invalid"),
        (lambda: RetryPolicy(first_wait_s=-1.0), "retry_policy_invalid"),
        (lambda: RetryPolicy(longest_wait_s=float("nan")), "retry_policy_invalid"),
        (lambda: RetryPolicy(total_s=float("inf")), "retry_policy_invalid"),
    ],
)
def test_wrong_arguments_are_refused(make: Callable[[], object], code: str) -> None:
    with pytest.raises(ConfigError) as caught:
        make()
    assert caught.value.code == code


def test_a_key_is_read_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "key"
    path.write_text("  vfa_a_b\n")
    assert read_api_key(path) == "vfa_a_b"
    for text in ("", "a b", "vfa_a\nvfa_b", "drone7 detect sha256:" + "0" * 64, "ü"):
        path.write_text(text)
        with pytest.raises(ConfigError) as caught:
            read_api_key(path)
        assert caught.value.code == "api_key_invalid"
    with pytest.raises(ConfigError) as caught:
        read_api_key(tmp_path / "none")
    assert caught.value.code == "api_key_unreadable"


def test_errors_survive_a_process_boundary() -> None:
    error = ServiceBusyError("m", code="c", field="f", status=429, request_id="r", retry_after_s=2.0)
    again = pickle.loads(pickle.dumps(error))  # noqa: S301
    assert isinstance(again, ServiceBusyError)
    assert isinstance(again, ViflowError)
    assert vars(again) == vars(error)
    assert again.message == "m"


def test_it_loads_neither_torch_nor_the_service_nor_httpx() -> None:
    code = (
        "import sys, viflow_anomaly.client; "
        "print(sorted({'torch', 'fastapi', 'httpx', 'viflow_anomaly_service'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_without_httpx_the_install_line_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "httpx", None)
    with pytest.raises(ViflowError, match=r"pip install 'viflow-anomaly\[client\]'") as caught:
        Client("http://127.0.0.1")
    assert caught.value.code == "httpx_missing"


def test_png_holds_the_pixels() -> None:
    import cv2  # noqa: PLC0415

    pair = frame_pair()
    png = EncodedPair.of(pair).source
    assert np.array_equal(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED), pair.source.image)
