"""Keys, limits, CORS and headers at the door of a live service."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import httpx
import pytest
from rule_detector import RuleDetector
from service_world import LiveServer, assert_problem, json_request, live_server, problem_of, wait_until
from serving_process import serving_process
from starlette.requests import ClientDisconnect

from viflow_anomaly.errors import CheckpointError, ConfigError
from viflow_anomaly_service.access_control import AccessMiddleware, RequestTimeMiddleware
from viflow_anomaly_service.api_keys import new_key
from viflow_anomaly_service.app import create_app
from viflow_anomaly_service.server import run
from viflow_anomaly_service.settings import ServiceSettings, load_settings


class Guarded(NamedTuple):
    server: LiveServer
    keys: dict[str, str]

    def bearer(self, name: str) -> dict[str, str]:
        return {"Authorization": f"Bearer {self.keys[name]}"}


def write_keys(folder: Path, **lines: tuple[str, str]) -> tuple[Path, dict[str, str]]:
    """name=(scope, limits) -> the file and the keys by name."""
    made = {name: new_key(name, scope.split(",")) for name, (scope, _) in lines.items()}
    path = folder / "keys.txt"
    path.write_text("".join(f"{made[name][1]} {limits}\n" for name, (_, limits) in lines.items()))
    return path, {name: key for name, (key, _) in made.items()}


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    path, keys = write_keys(
        tmp_path_factory.mktemp("keys"),
        drone=("detect", ""),
        reader=("read", ""),
        boss=("admin", ""),
        slow=("detect,read", "rate=0.01 burst=2"),
        poor=("detect,read", "daily=1"),
    )
    with live_server(
        lambda settings: RuleDetector(), key_file=path, allowed_origins="https://dashboard.example"
    ) as server:
        yield Guarded(server, keys)


def test_health_and_readiness_need_no_key(guarded: Guarded) -> None:
    for path in ("/healthz", "/readyz"):
        assert guarded.server.client.get(path).status_code == 200


def test_without_a_key_nothing_else_answers(guarded: Guarded) -> None:
    for path in (
        "/version",
        "/openapi.json",
        "/docs",
        "/schemas/detection-1.0.json",
        "/nowhere",
        "/healthz/",
        "/dashboard",
        "/live",
    ):
        response = guarded.server.client.get(path)
        assert_problem(response, 401, "key_missing", None)
        assert response.headers["www-authenticate"].startswith("Bearer")
    assert_problem(guarded.server.post_json(json_request()), 401, "key_missing", None)


@pytest.mark.parametrize("value", ["Bearer vfa_drone_x", "Bearer \xff", "Bearer  x y", "bearer vfa__"])
def test_a_wrong_key_is_refused(guarded: Guarded, value: str) -> None:
    response = guarded.server.post_json(json_request(), headers={"Authorization": value.encode("latin-1")})
    assert_problem(response, 401, "key_invalid", None)


@pytest.mark.parametrize("value", ["Bearer", "Basic dXNlcjpwdw==", ""])
def test_another_scheme_is_no_key(guarded: Guarded, value: str) -> None:
    assert_problem(guarded.server.client.get("/version", headers={"Authorization": value}), 401, "key_missing", None)


def test_a_key_opens_what_its_scope_says(guarded: Guarded) -> None:
    answers = {}
    for name in ("drone", "reader", "boss"):
        headers = guarded.bearer(name)
        answers[name] = (
            guarded.server.post_json(json_request(), headers=headers).status_code,
            guarded.server.client.get("/metrics", headers=headers | {"X-Forwarded-For": "8.8.8.8"}).status_code,
            guarded.server.client.get("/version", headers=headers).status_code,
            guarded.server.client.delete("/detect", headers=headers).status_code,
        )
    assert answers == {"drone": (200, 403, 200, 403), "reader": (403, 200, 200, 403), "boss": (200, 200, 200, 405)}
    for path, statuses in (("/events", (403, 501, 501)), ("/events/deliveries", (403, 403, 501))):
        found = [guarded.server.client.get(path, headers=guarded.bearer(name)).status_code for name in answers]
        assert tuple(found) == statuses
    retry = f"/events/deliveries/{'0' * 32}.mqtt/retry"
    found = [guarded.server.client.post(retry, headers=guarded.bearer(name)).status_code for name in answers]
    assert found == [403, 403, 501]
    refused = guarded.server.post_json(json_request(), headers=guarded.bearer("reader"))
    assert_problem(refused, 403, "scope_missing", None)


def test_the_key_may_stand_in_a_header_of_its_own(guarded: Guarded) -> None:
    headers = {"X-API-Key": guarded.keys["drone"]}
    assert guarded.server.client.get("/version", headers=headers).status_code == 200


def test_metrics_are_open_to_this_machine_but_not_through_its_proxy(guarded: Guarded) -> None:
    assert guarded.server.client.get("/metrics").status_code == 200
    for address in ("8.8.8.8", "127.0.0.1"):
        response = guarded.server.client.get("/metrics", headers={"X-Forwarded-For": address})
        assert_problem(response, 401, "key_missing", None)


def test_a_key_that_asks_too_often_is_told_when_to_come_back(guarded: Guarded) -> None:
    headers = guarded.bearer("slow")
    statuses = [guarded.server.post_json(json_request(), headers=headers).status_code for _ in range(2)]
    assert statuses == [200, 200]
    response = guarded.server.post_json(json_request(), headers=headers)
    assert_problem(response, 429, "rate_limited", None)
    assert 1 <= int(response.headers["retry-after"]) <= 100
    assert guarded.server.post_json(json_request(), headers=guarded.bearer("drone")).status_code == 200


def test_a_spent_quota_leaves_reading_open(guarded: Guarded) -> None:
    headers = guarded.bearer("poor")
    assert guarded.server.post_json(json_request(), headers=headers).status_code == 200
    response = guarded.server.post_json(json_request(), headers=headers)
    assert_problem(response, 429, "quota_exhausted", None)
    assert guarded.server.client.get("/version", headers=headers).status_code == 200


def test_refusals_are_counted(guarded: Guarded) -> None:
    guarded.server.client.get("/version")
    counted = 'viflow_problems_total{code="key_missing"}'
    wait_until(lambda: counted in guarded.server.client.get("/metrics").text)


def test_a_page_of_an_allowed_origin_may_ask(guarded: Guarded) -> None:
    client, origin = guarded.server.client, {"Origin": "https://dashboard.example"}
    asked = origin | {"Access-Control-Request-Method": "POST", "Access-Control-Request-Headers": "authorization"}
    preflight = client.options("/detect", headers=asked)
    assert preflight.status_code == 200
    assert preflight.headers["access-control-allow-origin"] == "https://dashboard.example"
    answer = guarded.server.post_json(json_request(), headers=guarded.bearer("drone") | origin)
    assert answer.status_code == 200
    assert answer.headers["access-control-allow-origin"] == "https://dashboard.example"
    assert "access-control-allow-credentials" not in answer.headers
    foreign = client.options("/detect", headers=asked | {"Origin": "https://other.example"})
    assert foreign.status_code == 400
    assert "access-control-allow-origin" not in foreign.headers


def test_every_answer_has_the_security_headers(guarded: Guarded) -> None:
    for response in (
        guarded.server.client.get("/healthz"),
        guarded.server.client.get("/nowhere"),
        guarded.server.client.get("/docs", headers=guarded.bearer("boss")),
        guarded.server.post_json(json_request(), headers=guarded.bearer("boss")),
    ):
        assert response.headers["x-content-type-options"] == "nosniff"
        assert response.headers["x-frame-options"] == "DENY"
        assert response.headers["cache-control"] == "no-store"
        assert "frame-ancestors 'none'" in response.headers["content-security-policy"]
        assert "x-request-id" in response.headers


def test_no_key_reaches_the_log(guarded: Guarded, caplog: pytest.LogCaptureFixture) -> None:
    def names() -> dict[str, str | None]:
        """Request id -> name of the key, as they were logged; a line may follow its answer by a moment."""
        lines = [record for record in caplog.records if record.getMessage() == "request"]
        return {vars(line)["request_id"]: getattr(line, "key", None) for line in lines}

    with caplog.at_level("INFO"):
        guarded.server.client.get("/version", headers=guarded.bearer("boss") | {"X-Request-ID": "right"})
        guarded.server.client.get("/version", headers={"X-API-Key": "vfa_boss_nearly", "X-Request-ID": "wrong"})
        wait_until(lambda: {"right", "wrong"} <= set(names()))
    assert (names()["right"], names()["wrong"]) == ("boss", None)
    written = " ".join(str(vars(record)) for record in caplog.records)
    assert guarded.keys["boss"] not in written
    assert "vfa_boss_nearly" not in written


# --- without keys


def test_without_keys_cors_is_closed_and_foreign_pages_are_refused(server: LiveServer) -> None:
    refused = server.post_json(json_request(), headers={"Origin": "https://other.example"})
    assert_problem(refused, 403, "origin_refused", "Origin")
    local = server.post_json(json_request(), headers={"Origin": "http://localhost:3000"})
    assert local.status_code == 200
    assert "access-control-allow-origin" not in local.headers


def test_without_keys_a_browser_that_names_no_origin_is_asked_where_its_page_is_from(server: LiveServer) -> None:
    refused = server.post_json(json_request(), headers={"Sec-Fetch-Site": "cross-site"})
    assert_problem(refused, 403, "origin_refused", "Origin")
    for site in ("same-origin", "none"):
        assert server.post_json(json_request(), headers={"Sec-Fetch-Site": site}).status_code == 200


CHANGING = (
    ("POST", "/detect"),
    ("POST", "/inspect"),
    ("POST", "/streams/a/frames"),
    ("DELETE", "/streams/a"),
    ("POST", "/streams/a/pairs/1/inspect"),
    ("POST", "/models/a/load"),
    ("PUT", "/models/default"),
    ("DELETE", "/models/a"),
    ("POST", f"/events/deliveries/{'0' * 32}.mqtt/retry"),
)
"""All that changes something, or takes a worker's time."""


@pytest.mark.parametrize(("method", "path"), CHANGING)
@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1.evil.example", "http://[", "x"])
def test_without_keys_a_foreign_page_changes_nothing(server: LiveServer, method: str, path: str, origin: str) -> None:
    for media_type in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data; boundary=x"):
        headers = {"Origin": origin, "Content-Type": media_type}  # what a page may send without asking first
        answer = server.client.request(method, path, headers=headers, content=b"{}")
        assert_problem(answer, 403, "origin_refused", "Origin")


def test_everything_that_changes_something_is_tried(server: LiveServer) -> None:
    paths = server.client.get("/openapi.json").json()["paths"]
    changing = {(method.upper(), path) for path, item in paths.items() for method in item if method != "get"}
    assert len(changing) == len(CHANGING), "one more belongs into CHANGING"


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8000", "127.0.0.1.evil.example", "10.0.0.7", "["])
def test_without_keys_a_name_that_was_turned_to_this_machine_is_refused(server: LiveServer, host: str) -> None:
    for path in ("/version", "/detections", "/metrics", "/live", "/docs"):
        assert_problem(server.client.get(path, headers={"Host": host}), 403, "host_refused", "Host")


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:1", "127.0.0.1:9000", "[::1]:8000", "127.8.0.1", ""])
def test_without_keys_the_names_of_this_machine_are_answered(server: LiveServer, host: str) -> None:
    assert server.client.get("/version", headers={"Host": host}).status_code == 200


def test_an_allowed_origin_is_a_name_of_the_service() -> None:
    with live_server(lambda settings: RuleDetector(), allowed_origins="https://robot.example") as server:
        headers = {"Host": "robot.example", "Origin": "https://robot.example"}
        assert server.post_json(json_request(), headers=headers).status_code == 200
        assert_problem(server.client.get("/version", headers={"Host": "evil.example"}), 403, "host_refused", "Host")


def test_a_service_that_everybody_may_ask_is_not_driven_by_foreign_pages() -> None:
    with live_server(lambda settings: RuleDetector(), insecure_no_keys=True) as server:
        address = {"Host": "robot.example:8000"}
        evil, own = {"Origin": "http://evil.example"}, {"Origin": "http://robot.example:8000"}
        for refused in (evil, evil | {"Sec-Fetch-Site": "cross-site"}, {"Sec-Fetch-Site": "cross-site"}):
            answer = server.post_json(json_request(), headers=address | refused)
            assert_problem(answer, 403, "origin_refused", "Origin")
        proxied = {"Host": "127.0.0.1:8000", "Origin": "https://robot.example", "Sec-Fetch-Site": "same-origin"}
        for taken in (address, address | own, proxied, address | {"Origin": "http://localhost:3000"}):
            assert server.post_json(json_request(), headers=taken).status_code == 200
        assert server.client.get("/version", headers=address | evil).status_code == 200


def test_without_keys_an_address_is_limited(tmp_path: Path) -> None:
    with live_server(lambda settings: RuleDetector(), rate_limit_per_s=0.01, rate_limit_burst=3) as server:
        statuses = [server.client.get("/version").status_code for _ in range(4)]
        assert statuses == [200, 200, 200, 429]
        assert server.client.get("/healthz").status_code == 200


def test_an_application_without_keys_answers_on_loopback_only() -> None:
    app = create_app(ServiceSettings(), load_detector=lambda settings: RuleDetector())

    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(app=app)
        async with httpx.AsyncClient(transport=transport, base_url="http://192.168.0.7:8000") as client:
            return await client.get("/version")

    body = problem_of(asyncio.run(ask()))
    assert (body["status"], body["code"]) == (403, "keys_missing")


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.0.7", "example.org"])  # noqa: S104
def test_it_does_not_start_elsewhere_without_keys(host: str) -> None:
    with pytest.raises(ConfigError) as caught:
        run(load_settings(host=host, port=0))
    assert caught.value.code == "keys_missing"
    assert "--insecure-no-keys" in caught.value.message
    assert "VIFLOW_KEY_FILE" in caught.value.message


def test_it_does_not_start_with_a_key_file_that_cannot_be_used(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        run(load_settings(port=0, key_file=tmp_path / "no.txt"))
    assert caught.value.code == "key_file_unreadable"


def test_it_starts_elsewhere_with_keys_or_when_told(tmp_path: Path) -> None:
    path, keys = write_keys(tmp_path, drone=("detect", ""))
    with serving_process(host="0.0.0.0", key_file=str(path)) as serving, serving.client() as client:  # noqa: S104
        refused = client.get("/version")
        assert refused.status_code == 401
        assert "server" not in refused.headers, "which server it is concerns nobody"
        assert client.get("/version", headers={"X-API-Key": keys["drone"]}).status_code == 200
    with serving_process(host="0.0.0.0", insecure_no_keys=True) as serving, serving.client() as client:  # noqa: S104
        assert client.get("/version").status_code == 200


# --- slow clients


def ends(connection: socket.socket, *, within_s: float) -> bool:
    """Whether the other side closes."""
    connection.settimeout(within_s)
    try:
        while connection.recv(65536):
            pass
    except TimeoutError:
        return False
    except ConnectionError:
        return True
    return True


def test_silent_and_slow_connections_are_closed_and_others_are_served() -> None:
    with serving_process(head_timeout_s=0.5, body_timeout_s=1.0) as serving, serving.client() as client:
        address = ("127.0.0.1", serving.port)
        silent, slow, second = (socket.create_connection(address) for _ in range(3))
        with silent, slow, second:
            slow.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\nX-")
            second.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
            assert b"200 OK" in second.recv(65536)
            second.sendall(b"G")  # ends the server's own keep-alive timer
            assert client.get("/healthz").status_code == 200
            assert all(ends(connection, within_s=10) for connection in (silent, slow, second))


def test_a_head_in_pieces_is_served() -> None:
    with (
        serving_process(head_timeout_s=5.0) as serving,
        socket.create_connection(("127.0.0.1", serving.port)) as connection,
    ):
        for piece in (b"GET /heal", b"thz HTTP/1.1\r\n", b"Host: x\r\n", b"\r\n"):
            connection.sendall(piece)
            time.sleep(0.05)
        assert b"200 OK" in connection.recv(65536)


def test_there_is_a_limit_of_connections() -> None:
    with serving_process(max_connections=4) as serving:
        address = ("127.0.0.1", serving.port)
        held = [socket.create_connection(address) for _ in range(4)]
        try:
            with socket.create_connection(address) as refused:
                assert ends(refused, within_s=10)
            held.pop().close()
            time.sleep(0.3)
            with serving.client() as client:
                assert client.get("/healthz").status_code == 200
        finally:
            for connection in held:
                connection.close()


def test_a_request_that_takes_too_long_is_ended() -> None:
    with serving_process(delay_s=5.0, request_timeout_s=0.5) as serving, serving.client() as client:
        response = client.post("/detect", json=json_request())
        assert_problem(response, 503, "request_timeout", None)
        assert response.headers["retry-after"] == "1"
        assert client.get("/healthz").status_code == 200


def asgi_request(app: Any, *, limit_s: float) -> list[dict[str, Any]]:
    """What ``app`` sends behind the time limit."""
    sent: list[dict[str, Any]] = []

    async def receive() -> dict[str, Any]:
        await asyncio.sleep(60)
        raise AssertionError

    async def send(message: Any) -> None:
        sent.append(dict(message))

    scope = {"type": "http", "method": "GET", "path": "/x", "headers": []}
    asyncio.run(RequestTimeMiddleware(app, limit_s=limit_s)(scope, receive, send))
    return sent


def parts(content_type: bytes, *, pause_s: float) -> Any:
    async def app(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-type", content_type)]})
        for _ in range(3):
            await asyncio.sleep(pause_s)
            await send({"type": "http.response.body", "body": b"x", "more_body": True})
        await send({"type": "http.response.body", "body": b"", "more_body": False})

    return app


def test_an_answer_in_parts_has_its_time_for_each() -> None:
    assert len(asgi_request(parts(b"application/x-ndjson", pause_s=0.2), limit_s=0.4)) == 5
    with pytest.raises(ClientDisconnect):
        asgi_request(parts(b"application/x-ndjson", pause_s=0.4), limit_s=0.2)


def test_the_events_of_a_stream_may_be_far_apart() -> None:
    assert len(asgi_request(parts(b"text/event-stream; charset=utf-8", pause_s=0.3), limit_s=0.1)) == 5


def test_a_fault_that_is_a_timeout_of_its_own_is_not_taken_for_the_limit() -> None:
    async def app(scope: Any, receive: Any, send: Any) -> None:
        raise TimeoutError

    with pytest.raises(TimeoutError):
        asgi_request(app, limit_s=5.0)


def test_a_websocket_needs_a_key_before_it_is_accepted(tmp_path: Path) -> None:
    path, keys = write_keys(tmp_path, drone=("detect", ""), reader=("read", ""))
    reached: list[str] = []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        reached.append(scope["viflow_key_name"])

    async def ask(key: str) -> list[dict[str, Any]]:
        sent: list[dict[str, Any]] = []

        async def send(message: Any) -> None:
            sent.append(dict(message))

        headers = [(b"x-api-key", key.encode())] if key else []
        # Without a key the first message of a stream may bring it; nowhere else.
        asked = "/streams/1" if key else "/elsewhere"
        scope = {"type": "websocket", "path": asked, "headers": headers, "client": ("10.0.0.1", 1)}
        await AccessMiddleware(app, ServiceSettings(key_file=path))(scope, send, send)
        return sent

    for key, code in (("", "key_missing"), ("vfa_drone_x", "key_invalid"), (keys["reader"], "scope_missing")):
        assert asyncio.run(ask(key)) == [{"type": "websocket.close", "code": 1008, "reason": code}]
    assert asyncio.run(ask(keys["drone"])) == []
    assert reached == ["drone"]


def test_each_of_several_processes_asks_for_keys(tmp_path: Path) -> None:
    path, keys = write_keys(tmp_path, drone=("detect", ""))
    with serving_process(host="0.0.0.0", workers=2, key_file=str(path)) as serving:  # noqa: S104
        pids = set()
        for _ in range(40):
            with serving.client() as client:  # a connection of its own: the system deals them out
                assert client.post("/detect", json=json_request()).status_code == 401
                assert client.post("/detect", json=json_request(), headers={"X-API-Key": keys["drone"]}).is_success
            pids = {record["pid"] for record in serving.events("request")}
            if len(pids) == 2:
                break
        assert len(pids) == 2


def test_a_model_that_cannot_be_loaded_tells_no_path() -> None:
    def fail(settings: ServiceSettings) -> RuleDetector:
        raise CheckpointError("/srv/secret/model.safetensors: broken", code="checkpoint_corrupt")

    with live_server(fail, ready=False) as server:
        wait_until(lambda: server.client.get("/readyz").json()["code"] == "model_load_failed")
        for response in (server.client.get("/readyz"), server.client.get("/models"), server.post_json(json_request())):
            assert_problem(response, 503, "model_load_failed", None)
            assert "/srv" not in response.text
