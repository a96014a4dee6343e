"""WebSockets of a live service, asked with the websockets library: POST's answers, in order, bounded, closed well."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import threading
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from socket import SHUT_RDWR, SO_RCVBUF, SOL_SOCKET
from socket import socket as new_socket
from typing import Any

import pytest
from difference_detector import DifferenceDetector
from service_world import LiveServer, live_server, png, wait_until
from serving_process import serving_process
from test_service_metrics import scraped
from test_streams import FRAMES, call, camera, expected_detections, untimed
from websockets.asyncio.client import connect as connect_async
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from worlds import World, make_world

from viflow_anomaly.sensor_data import FramePair
from viflow_anomaly_service.api_keys import new_key
from viflow_anomaly_service.streams.sockets import AHEAD, Inbox

PROTOCOL = "viflow.v1"
ANSWERED = ("viflow_requests_total", ("MESSAGE", "/streams/{stream_id}", "422"))


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(frames=FRAMES, shift_px=0, square_px=24)


@pytest.fixture(scope="module")
def streaming() -> Iterator[LiveServer]:
    with live_server(lambda settings: DifferenceDetector(), max_websocket_bytes=256 * 1024) as running:
        yield running


def url(port: int, name: str) -> str:
    return f"ws://127.0.0.1:{port}/streams/{name}"


class Gate:
    """Holds pairs up in the detector until it is opened."""

    def __init__(self) -> None:
        self.reached = threading.Event()
        self._may_go = threading.Event()

    def hold(self, pair: FramePair) -> None:
        self.reached.set()
        self._may_go.wait(60)

    def open(self) -> None:
        self._may_go.set()


@contextlib.contextmanager
def opened(server: Any, name: str, opening: dict[str, Any] | None = None, **options: Any) -> Iterator[ClientConnection]:
    """A connection whose stream is open."""
    with connect(url(server.port, name), proxy=None, **options) as socket:
        socket.send(json.dumps(opening or {}))
        assert json.loads(socket.recv(30)) == {"opened": {"stream_id": name}}
        yield socket


def binary(head: Any, image: bytes = b"") -> bytes:
    data = head if isinstance(head, bytes) else json.dumps(head).encode()
    return len(data).to_bytes(4, "big") + data + image


def frame_message(world: World, k: int, *, as_binary: bool, message_id: int | str | None = None) -> str | bytes:
    body = call(world, k) | ({} if message_id is None else {"id": message_id})
    if not as_binary:
        return json.dumps(body)
    return binary(body | {"frame": {"timestamp_ns": body["frame"]["timestamp_ns"]}}, png(world.images[k]))


def answered(socket: ClientConnection) -> dict[str, Any]:
    return dict(json.loads(socket.recv(30)))


def closing(socket: ClientConnection) -> tuple[int, str]:
    """The code and reason that the service closes with; what it says before is passed over."""
    with pytest.raises(ConnectionClosed) as closed:  # noqa: PT012
        while True:
            socket.recv(30)
    assert closed.value.rcvd is not None
    return closed.value.rcvd.code, closed.value.rcvd.reason


def refusal(port: int, name: str, **options: Any) -> tuple[int, str]:
    """Status and code of a handshake that is refused."""
    with pytest.raises(InvalidStatus) as refused, connect(url(port, name), proxy=None, **options):
        pass
    response = refused.value.response
    assert response.headers["content-type"] == "application/problem+json"
    problem = json.loads(response.body or b"")
    assert problem["request_id"] == response.headers["x-request-id"]
    return response.status_code, problem["code"]


# --- answers


@pytest.mark.parametrize("as_binary", [False, True])
def test_the_answers_are_those_of_post_in_order(streaming: LiveServer, world: World, as_binary: bool) -> None:
    name, found = f"same-{as_binary}", []
    with opened(streaming, name, {"camera": camera(world)}) as socket:
        for k in range(FRAMES):  # all at once: the answers keep the order
            socket.send(frame_message(world, k, as_binary=as_binary, message_id=k if k % 2 else f"n{k}"))
        for k in range(FRAMES):
            said = answered(socket)
            assert said["id"] == (k if k % 2 else f"n{k}")
            assert said["answer"]["begun"] == (k == 0)
            found += [untimed(detection) for detection in said["answer"]["detections"]]
    assert found == expected_detections(world)
    assert streaming.client.get(f"/streams/{name}").json()["received_frames"] == FRAMES


def test_post_and_socket_share_a_stream(streaming: LiveServer, world: World) -> None:
    with opened(streaming, "shared", {"camera": camera(world)}) as socket:
        socket.send(frame_message(world, 0, as_binary=True))
        assert answered(socket)["answer"]["begun"]
        posted = streaming.client.post("/streams/shared/frames", json=call(world, 1)).json()
        assert len(posted["detections"]) == 1
        socket.send(frame_message(world, 1, as_binary=True))
        assert answered(socket)["answer"]["faults"][0]["code"] == "imu_duplicate"
        socket.send(frame_message(world, 2, as_binary=False))
        assert len(answered(socket)["answer"]["detections"]) == 1
    with opened(streaming, "shared", {"camera": camera(world) | {"fx": 1.0}}) as socket:
        socket.send(frame_message(world, 3, as_binary=True))
        assert answered(socket)["problem"]["code"] == "stream_setup_changed"


def test_stored_detections_are_named(world: World, tmp_path: Path) -> None:
    with (
        live_server(lambda settings: DifferenceDetector(), store_url=str(tmp_path / "x.db")) as server,
        opened(server, "kept", {"camera": camera(world)}) as socket,
    ):
        for k in range(2):
            socket.send(frame_message(world, k, as_binary=True))
            said = answered(socket)["answer"]
        assert len(said["detection_ids"]) == len(said["detections"]) == 1
        assert server.client.get(f"/detections/{said['detection_ids'][0]}").status_code == 200


def test_messages_are_counted_and_logged(world: World, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    with live_server(lambda settings: DifferenceDetector()) as server:
        headers = {"X-Request-ID": "robot-1"}
        with opened(server, "counted", additional_headers=headers) as socket:
            assert socket.response is not None
            assert socket.response.headers["x-request-id"] == "robot-1"
            socket.send(frame_message(world, 0, as_binary=True))
            assert answered(socket)["answer"]["begun"]
            socket.send("{")
            assert answered(socket)["problem"]["request_id"] == "robot-1-2"
            values = scraped(server)
            assert values["viflow_websockets", ()] == 1
            assert values["viflow_requests_total", ("MESSAGE", "/streams/{stream_id}", "200")] == 1
            assert values["viflow_requests_total", ("MESSAGE", "/streams/{stream_id}", "400")] == 1
            assert values["viflow_problems_total", ("json_invalid",)] == 1
        wait_until(lambda: scraped(server)["viflow_websockets", ()] == 0)
        wait_until(lambda: "websocket" in caplog.messages)
    (line,) = (record for record in caplog.records if record.message == "websocket")
    assert (line.request_id, line.closed_with, line.messages) == ("robot-1", 1000, 2)  # type: ignore[attr-defined]
    assert [record.status for record in caplog.records if record.message == "message"] == [200, 400]  # type: ignore[attr-defined]


# --- wrong messages

STAMP = {"timestamp_ns": 10**18}
WRONG_MESSAGES: list[tuple[str | bytes, int, str, str | None, int | None]] = [
    ("{", 400, "json_invalid", None, None),
    ("[1]", 422, "field_invalid", None, None),
    ('{"id": 4}', 422, "field_missing", "frame", 4),
    ('{"id": 4, "camera": {}}', 422, "field_unknown", "camera", 4),
    ('{"id": 1.5}', 422, "field_invalid", "id.function-after[_in_int64(), int]", None),
    ('{"id": 4, "frame": {"timestamp_ns": 1, "image_base64": "?"}}', 422, "image_base64_invalid", None, 4),
    (b"", 400, "message_invalid", None, None),
    (b"\0\0", 400, "message_invalid", None, None),
    (b"\0\0\0\x09{}", 400, "message_invalid", None, None),
    (b"\xff\xff\xff\xff{}", 400, "message_invalid", None, None),
    (binary({"id": 4, "frame": STAMP}), 422, "field_missing", "frame", 4),
    (binary({"id": 4}, b"x"), 422, "field_missing", "frame", 4),
    (binary({"id": 4, "frame": STAMP}, b"GIF89a"), 415, "image_unsupported_type", "frame", 4),
    (binary({"id": 4, "frame": {"timestamp_ns": 2**62 + 1}}, b"x"), 422, "timestamp_out_of_range", None, 4),
    (binary({"id": 4, "imu": {"timestamps_ns": [2, 1], "gyro_rad_s": [[0, 0, 0]] * 2}}), 422, "imu_unsorted", None, 4),
    (binary(b"\xff"), 400, "json_invalid", None, None),
]


@pytest.mark.parametrize("message", range(len(WRONG_MESSAGES)))
def test_a_wrong_message_is_answered_and_changes_nothing(streaming: LiveServer, world: World, message: int) -> None:
    sent, status, code, field, message_id = WRONG_MESSAGES[message]
    with opened(streaming, f"wrong-{message}", {"camera": camera(world)}) as socket:
        for k in range(2):
            socket.send(sent)
            said = answered(socket)
            problem = said["problem"]
            assert (problem["status"], problem["code"], said["id"]) == (status, code, message_id), problem
            assert field is None or problem["field"] == field
            socket.send(frame_message(world, k, as_binary=True))
            assert answered(socket)["answer"]["begun"] == (k == 0)


@pytest.mark.parametrize("in_fragments", [False, True])
def test_a_message_too_large_closes_with_1009(streaming: LiveServer, in_fragments: bool) -> None:
    with opened(streaming, "large") as socket:

        def fragments() -> Iterator[bytes]:
            """One too many, and no more before the answer: what arrives at a closed connection would reset it."""
            yield from [b"x" * 1024] * 257
            wait_until(lambda: socket.protocol.close_rcvd is not None)
            yield b"x"

        with pytest.raises(ConnectionClosed) as closed:  # noqa: PT012 - by the sending, where the refusal is quick
            socket.send(fragments() if in_fragments else b"x" * (256 * 1024 + 1))
            socket.recv(30)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1009


@pytest.mark.parametrize("in_fragments", [False, True])
def test_text_that_is_none_closes_with_1007(
    streaming: LiveServer, caplog: pytest.LogCaptureFixture, in_fragments: bool
) -> None:
    caplog.set_level("INFO")
    with opened(streaming, "text") as socket:
        socket.send([b'{"id": "', b"\xff\xfe"] if in_fragments else b"\xff\xfe", text=True)
        assert closing(socket)[0] == 1007
    wait_until(lambda: "websocket" in caplog.messages)
    assert no_faults(caplog)
    (line,) = (record for record in caplog.records if record.message == "websocket")
    assert line.closed_with == 1007  # type: ignore[attr-defined]


def test_a_letter_in_two_fragments_is_text(streaming: LiveServer) -> None:
    with opened(streaming, "letter") as socket:
        socket.send([b'{"id": "\xc3', b'\xa4"}'], text=True)
        assert answered(socket)["id"] == "\xe4"


def test_text_that_is_none_in_place_of_the_opening_closes(
    streaming: LiveServer, caplog: pytest.LogCaptureFixture
) -> None:
    with connect(url(streaming.port, "text"), proxy=None) as socket:
        socket.send(b"\xff", text=True)
        assert closing(socket)[0] == 1007
    wait_until(lambda: scraped(streaming)["viflow_websockets", ()] == 0)
    assert no_faults(caplog)


def test_text_that_is_none_while_a_pair_is_judged_ends_the_call(world: World, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    gate = Gate()
    with live_server(lambda settings: DifferenceDetector(on_pair=gate.hold), max_concurrent=1) as server:
        try:
            with opened(server, "text", {"camera": camera(world)}) as socket:
                for k in range(2):
                    socket.send(frame_message(world, k, as_binary=True))
                assert gate.reached.wait(30)
                socket.send(b"\xff", text=True)
                assert closing(socket)[0] == 1007
            wait_until(lambda: scraped(server)["viflow_websockets", ()] == 0)
        finally:
            gate.open()
        wait_until(lambda: scraped(server)["viflow_requests_in_flight", ()] == 0)
    assert no_faults(caplog)
    assert [one.status for one in caplog.records if one.message == "message"] == [200, 499]  # type: ignore[attr-defined]


def no_faults(caplog: pytest.LogCaptureFixture) -> bool:
    return not [one for one in caplog.records if one.levelname in ("ERROR", "CRITICAL") or one.exc_info]


@pytest.mark.parametrize(
    ("opening", "code"),
    [
        (b"\0\0\0\x02{}", "opening_missing"),
        ("{", "json_invalid"),
        ('{"frame": {}}', "field_unknown"),
        ('{"fx": 70, "fy": 70}', "field_unknown"),
        ('{"options": {"model": 1}}', "field_invalid"),
        ('{"camera": "' + "x" * 70_000 + '"}', "body_too_large"),
    ],
)
def test_a_wrong_opening_is_told_and_closes(streaming: LiveServer, opening: str | bytes, code: str) -> None:
    with connect(url(streaming.port, "opening"), proxy=None) as socket:
        socket.send(opening)
        assert answered(socket)["problem"]["code"] == code
        assert closing(socket) == (1008, code)


def test_what_the_setup_means_is_told_with_the_first_call(streaming: LiveServer, world: World) -> None:
    for opening, code in (({"camera": {"fx": 1}}, "camera_invalid"), ({"options": {"model": "x"}}, "model_unknown")):
        with opened(streaming, f"setup-{code}", opening) as socket:
            socket.send(frame_message(world, 0, as_binary=True, message_id=9))
            said = answered(socket)
            assert (said["id"], said["problem"]["code"]) == (9, code)


# --- limits


def test_a_silent_socket_is_closed(world: World) -> None:
    with live_server(lambda settings: DifferenceDetector(), head_timeout_s=0.3, websocket_idle_s=0.6) as server:
        with connect(url(server.port, "a"), proxy=None) as socket:
            assert closing(socket) == (1008, "opening_timeout")
        with opened(server, "a") as socket:
            assert closing(socket) == (1008, "idle")


def test_one_socket_too_many_is_refused(world: World) -> None:
    with live_server(lambda settings: DifferenceDetector(), max_websockets=1) as server:
        with opened(server, "a"):
            assert refusal(server.port, "b") == (503, "sockets_full")
        wait_until(lambda: scraped(server)["viflow_websockets", ()] == 0)
        with opened(server, "b"):
            pass


def test_what_comes_too_fast_waits_in_the_network(world: World) -> None:
    gate = Gate()
    noise = b"\0" * (1024 * 1024)

    async def flood(port: int) -> int:
        async with connect_async(url(port, "fast"), proxy=None) as socket:
            await socket.send(json.dumps({"camera": camera(world)}))
            for k in range(2):
                await socket.send(frame_message(world, k, as_binary=True))
            assert await asyncio.to_thread(gate.reached.wait, 30)
            sent = 0
            with contextlib.suppress(TimeoutError):
                while sent < 128:
                    async with asyncio.timeout(2):
                        await socket.send(noise)
                    sent += 1
            gate.open()
            return sent

    with live_server(lambda settings: DifferenceDetector(on_pair=gate.hold), max_websocket_bytes=2**21) as server:
        try:
            assert asyncio.run(flood(server.port)) < 64
        finally:
            gate.open()


def test_before_the_opening_is_accepted_nothing_else_is_taken_in() -> None:
    class Sent:
        """A peer that has sent ten messages."""

        def __init__(self) -> None:
            self.scope: dict[str, Any] = {}
            self.messages = deque(str(number) for number in range(10))

        async def receive(self) -> dict[str, Any]:
            return {"type": "websocket.receive", "text": self.messages.popleft()}

    async def settled() -> None:
        for _ in range(50):
            await asyncio.sleep(0)

    async def take() -> None:
        sent = Sent()
        inbox = Inbox(sent, asyncio.Event())  # type: ignore[arg-type]
        async with inbox.filled():
            assert await inbox.next(30, "opening_timeout") == "0"
            await settled()
            assert len(sent.messages) == 9
            inbox.widen()
            await settled()
            assert len(sent.messages) == 9 - AHEAD
            assert await inbox.next(30, "idle") == "1"
            await settled()
            assert len(sent.messages) == 8 - AHEAD

    asyncio.run(take())


def test_who_does_not_read_answers_is_let_go() -> None:
    wrong = json.dumps({f"{number}" + "x" * 900: 1 for number in range(10)})  # a short question, a long answer
    with live_server(lambda settings: DifferenceDetector(), body_timeout_s=0.5) as server:

        async def ask_only() -> None:
            options = {"proxy": None, "max_queue": 1, "close_timeout": 0.1}
            async with connect_async(url(server.port, "mute"), **options) as socket:
                await socket.send("{}")
                while not enough.is_set():
                    with contextlib.suppress(ConnectionClosed, TimeoutError):
                        async with asyncio.timeout(1):
                            await socket.send(wrong)

        enough = threading.Event()
        with ThreadPoolExecutor(1) as pool, contextlib.ExitStack() as ending:
            ending.callback(enough.set)
            asking = pool.submit(lambda: asyncio.run(ask_only()))
            wait_until(lambda: scraped(server).get(ANSWERED, 0) > 1)
            wait_until(lambda: scraped(server)["viflow_websockets", ()] == 0, seconds=60)
            enough.set()
            asking.result(30)
        assert server.client.get("/readyz").status_code == 200


def test_an_overloaded_service_says_so_and_the_socket_goes_on(world: World) -> None:
    gate = Gate()
    limits = {"max_concurrent": 1, "max_queued": 0}
    with (
        live_server(lambda settings: DifferenceDetector(on_pair=gate.hold), **limits) as server,
        opened(server, "a", {"camera": camera(world)}) as first,
        opened(server, "b", {"camera": camera(world)}) as second,
    ):
        try:
            for k in range(2):
                first.send(frame_message(world, k, as_binary=True))
            assert answered(first)["answer"]["begun"]
            assert gate.reached.wait(30)
            second.send(frame_message(world, 0, as_binary=True, message_id=5))
            said = answered(second)
            assert (said["problem"]["code"], said["id"], said["retry_after_s"]) == ("overloaded", 5, 1)
        finally:
            gate.open()
        assert len(answered(first)["answer"]["detections"]) == 1
        second.send(frame_message(world, 0, as_binary=True))
        assert answered(second)["answer"]["begun"]


def test_several_processes_take_none() -> None:
    with serving_process(workers=2) as serving:
        assert refusal(serving.port, "a") == (501, "streams_need_one_process")


def test_a_wrong_name_and_other_paths(streaming: LiveServer) -> None:
    assert refusal(streaming.port, "a%20b") == (422, "stream_id_invalid")
    for path in ("", "a/frames", "../detect"):
        with pytest.raises(InvalidStatus) as refused, connect(url(streaming.port, path), proxy=None):
            pass
        assert refused.value.response.status_code in (403, 404)


# --- ends


@pytest.mark.parametrize("waiting", [0, 3, 12])
def test_a_client_that_leaves_while_its_pair_is_judged(world: World, waiting: int) -> None:
    gate = Gate()
    with live_server(lambda settings: DifferenceDetector(on_pair=gate.hold), max_concurrent=1) as server:
        try:
            with opened(server, "left", {"camera": camera(world)}) as socket:
                for k in range(2):
                    socket.send(frame_message(world, k, as_binary=True))
                assert answered(socket)["answer"]["begun"]
                assert gate.reached.wait(30)
                for k in range(waiting):  # also where they keep the service from reading on
                    socket.send(frame_message(world, 2 + k % 2, as_binary=True))
                socket.socket.shutdown(SHUT_RDWR)  # no goodbye
            wait_until(lambda: scraped(server)["viflow_websockets", ()] == 0)
        finally:
            gate.open()
        wait_until(lambda: scraped(server)["viflow_requests_in_flight", ()] == 0)
        # The call had not been answered: the stream is where it was, and takes it again.
        again = server.client.post("/streams/left/frames", json=call(world, 1)).json()
        assert (again["faults"], len(again["detections"])) == ([], 1)


def test_a_shutdown_answers_what_it_has_and_says_goodbye(world: World) -> None:
    with serving_process(delay_s=1.0) as serving, opened(serving, "bye", {"camera": camera(world)}) as socket:
        socket.send(frame_message(world, 0, as_binary=True))
        assert answered(socket)["answer"]["begun"]
        socket.send(frame_message(world, 1, as_binary=True))
        wait_until(lambda: _busy(serving), seconds=30)
        serving.process.send_signal(signal.SIGTERM)
        assert len(answered(socket)["answer"]["detections"]) == 1
        assert closing(socket) == (1001, "shutting_down")
        assert serving.process.wait(30) == 0


def _busy(serving: Any) -> bool:
    with serving.client() as client:
        return "viflow_workers_busy 1.0" in client.get("/metrics").text


def test_a_killed_service_breaks_the_connection(world: World) -> None:
    with serving_process() as serving, opened(serving, "dead", {"camera": camera(world)}) as socket:
        serving.process.kill()
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv(30)
        assert closed.value.rcvd is None


def test_a_fault_of_ours_closes_with_1011_and_says_nothing(world: World) -> None:
    def fail(pair: FramePair) -> None:
        raise ValueError("secret")

    with (
        live_server(lambda settings: DifferenceDetector(on_pair=fail)) as server,
        opened(server, "fault", {"camera": camera(world)}) as socket,
    ):
        for k in range(2):
            socket.send(frame_message(world, k, as_binary=True, message_id=k))
        assert answered(socket)["id"] == 0
        said = answered(socket)
        assert (said["id"], said["problem"]["code"]) == (1, "internal_error")
        assert "secret" not in json.dumps(said)
        assert closing(socket) == (1011, "internal_error")


def test_many_at_once(streaming: LiveServer, world: World) -> None:
    def follow(number: int) -> list[dict[str, Any]]:
        with opened(streaming, f"many-{number}", {"camera": camera(world)}) as socket:
            found = []
            for k in range(FRAMES):
                socket.send(frame_message(world, k, as_binary=bool(number % 2)))
                found += [untimed(one) for one in answered(socket)["answer"]["detections"]]
            return found

    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(follow, range(8)))
    assert answers == [expected_detections(world)] * 8


# --- keys and origins


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[LiveServer, dict[str, str], Path]]:
    path = tmp_path_factory.mktemp("keys") / "keys.txt"
    made = {"drone": new_key("drone", ["detect"]), "reader": new_key("reader", ["read"])}
    made["poor"] = new_key("poor", ["detect"])
    made["gone"] = new_key("gone", ["detect"])
    lines = [line + (" daily=1" if name == "poor" else "") for name, (_, line) in made.items()]
    path.write_text("\n".join(lines))
    options = {
        "key_file": path,
        "max_websockets": 2,
        "head_timeout_s": 20.0,
        "allowed_origins": ("https://ours.example",),
    }
    with live_server(lambda settings: DifferenceDetector(), **options) as running:
        yield running, {name: key for name, (key, _) in made.items()}, path


def test_a_key_in_the_handshake(keyed: tuple[LiveServer, dict[str, str], Path]) -> None:
    server, keys, _ = keyed
    with opened(server, "a", additional_headers={"Authorization": f"Bearer {keys['drone']}"}):
        pass
    with opened(server, "a", additional_headers={"X-API-Key": keys["drone"]}):
        pass
    subprotocols = [PROTOCOL, f"viflow.key.{keys['drone']}"]
    with opened(server, "a", subprotocols=subprotocols) as socket:
        assert socket.subprotocol == PROTOCOL
    for key, status, code in (("vfa_drone_x", 401, "key_invalid"), (keys["reader"], 403, "scope_missing")):
        assert refusal(server.port, "a", additional_headers={"X-API-Key": key}) == (status, code)
        assert refusal(server.port, "a", subprotocols=[PROTOCOL, f"viflow.key.{key}"]) == (status, code)


def test_a_key_in_the_first_message(keyed: tuple[LiveServer, dict[str, str], Path], world: World) -> None:
    server, keys, _ = keyed
    with opened(server, "b", {"key": keys["drone"]}, subprotocols=[PROTOCOL]) as socket:
        socket.send(frame_message(world, 0, as_binary=True))
        assert "answer" in answered(socket)
    for opening, code in (
        ({}, "key_missing"),
        ({"key": "vfa_drone_x"}, "key_invalid"),
        ({"key": keys["reader"]}, "scope_missing"),
    ):
        with connect(url(server.port, "b"), proxy=None) as socket:
            socket.send(json.dumps(opening))
            assert answered(socket)["problem"]["code"] == code
            assert closing(socket) == (1008, code)


def test_who_shows_no_key_keeps_nobody_out(keyed: tuple[LiveServer, dict[str, str], Path]) -> None:
    server, keys, _ = keyed
    with contextlib.ExitStack() as stack:
        for _ in range(2):
            stack.enter_context(connect(url(server.port, "c"), proxy=None))
        assert refusal(server.port, "c") == (503, "sockets_full")
        shown = {"additional_headers": {"X-API-Key": keys["drone"]}}
        for _ in range(2):
            stack.enter_context(opened(server, "c", **shown))
        assert refusal(server.port, "c", **shown) == (503, "sockets_full")
    wait_until(lambda: scraped(server)["viflow_websockets", ()] == 0)


def test_a_place_that_is_not_there_after_the_key(keyed: tuple[LiveServer, dict[str, str], Path]) -> None:
    server, keys, _ = keyed
    shown = {"additional_headers": {"X-API-Key": keys["drone"]}}
    with opened(server, "d", **shown), opened(server, "d", **shown), connect(url(server.port, "d"), proxy=None) as late:
        late.send(json.dumps({"key": keys["drone"]}))
        assert closing(late) == (1013, "sockets_full")
    wait_until(lambda: scraped(server)["viflow_websockets", ()] == 0)


def test_every_message_counts(keyed: tuple[LiveServer, dict[str, str], Path], world: World) -> None:
    server, keys, _ = keyed
    with opened(server, "e", additional_headers={"X-API-Key": keys["poor"]}) as socket:
        for k in range(3):
            socket.send(frame_message(world, k, as_binary=True, message_id=k))
        assert "answer" in answered(socket)
        for k in (1, 2):
            said = answered(socket)
            assert (said["id"], said["problem"]["code"]) == (k, "quota_exhausted")


def test_a_key_that_is_taken_away_ends_its_sockets(
    keyed: tuple[LiveServer, dict[str, str], Path], world: World
) -> None:
    server, keys, path = keyed
    with opened(server, "f", {"key": keys["gone"]}) as socket:
        socket.send(frame_message(world, 0, as_binary=True))
        assert "answer" in answered(socket)
        lines = [line for line in path.read_text().splitlines() if not line.startswith("gone ")]
        path.write_text("\n".join(lines))
        until = time.monotonic() + 30
        k, code = 1, None
        while code is None and time.monotonic() < until:  # the file is looked at once a second
            socket.send(frame_message(world, k, as_binary=True))
            code = answered(socket).get("problem", {}).get("code")
            time.sleep(0.1)
        assert code == "key_invalid"
        assert closing(socket) == (1008, "key_invalid")


def test_pages_of_other_sites_are_refused(keyed: tuple[LiveServer, dict[str, str], Path]) -> None:
    server, keys, _ = keyed
    shown = {"additional_headers": {"X-API-Key": keys["drone"]}}
    for origin in ("https://evil.example", "null", "https://ours.example.evil.example", "http://ours.example"):
        assert refusal(server.port, "g", origin=origin, **shown) == (403, "origin_refused")
        assert refusal(server.port, "g", origin=origin) == (403, "origin_refused")
    for origin in ("https://ours.example", "http://localhost:3000"):
        with opened(server, "g", origin=origin, **shown):
            pass


def test_origins_count_without_keys_too() -> None:
    with live_server(lambda settings: DifferenceDetector(), insecure_no_keys=True) as server:
        assert refusal(server.port, "g", origin="https://evil.example") == (403, "origin_refused")
        with opened(server, "g"):
            pass


def test_no_key_and_no_query_string_in_the_log(tmp_path: Path, world: World) -> None:
    key, line = new_key("drone", ["detect"])
    (tmp_path / "keys.txt").write_text(line)
    with serving_process(key_file=str(tmp_path / "keys.txt"), log_level="debug") as serving:
        target = f"{url(serving.port, 'log')}?token=hidden"
        subprotocols = [PROTOCOL, f"viflow.key.{key}"]
        with connect(target, proxy=None, subprotocols=subprotocols) as socket:  # type: ignore[arg-type]
            socket.send(json.dumps({"key": key}))
            assert "opened" in answered(socket)
            socket.send(frame_message(world, 0, as_binary=True))
            assert "answer" in answered(socket)
        with pytest.raises(InvalidStatus), connect(target, proxy=None, additional_headers={"X-API-Key": key + "x"}):
            pass
        wait_until(lambda: len(serving.events("websocket")) == 2)
        written = json.dumps(serving.log) + "".join(serving.other_lines)
    assert serving.events("websocket")[0]["key"] == "drone"
    assert not [record for record in serving.log if record["level"] == "error"]
    for secret in (key, "hidden"):
        assert secret not in written


# --- peers that would fill the memory


def raw_socket(port: int, *, receive_buffer: int | None = None) -> Any:
    """Behind the handshake, with nobody who reads."""
    peer = new_socket()
    if receive_buffer is not None:
        peer.setsockopt(SOL_SOCKET, SO_RCVBUF, receive_buffer)
    peer.settimeout(30)
    peer.connect(("127.0.0.1", port))
    lines = ["GET /streams/raw HTTP/1.1", "Host: 127.0.0.1", "Upgrade: websocket", "Connection: Upgrade"]
    lines += ["Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version: 13"]
    peer.sendall("\r\n".join([*lines, "", ""]).encode())
    assert b"101 Switching Protocols" in peer.recv(1024)
    return peer


def masked(opcode: int, payload: bytes = b"") -> bytes:
    return bytes([opcode, 0x80 | len(payload)]) + bytes(4) + payload


@pytest.mark.parametrize(
    ("first", "again", "most_bytes"),
    [
        (b"", masked(0x89, bytes(125)) * 512, 64 * 1024 * 1024),  # pings, whose pongs nobody reads
        (masked(0x01, b"{"), masked(0x00) * 1024, 4 * 1024 * 1024),  # a message of empty fragments
    ],
)
def test_a_peer_that_only_fills_memory_is_cut_off(
    streaming: LiveServer, first: bytes, again: bytes, most_bytes: int
) -> None:
    with contextlib.closing(raw_socket(streaming.port, receive_buffer=4096)) as peer:
        sent = 0
        with pytest.raises(OSError, match=r"reset|Broken pipe"):  # noqa: PT012 - at which of them nobody knows
            peer.sendall(first)
            while sent < most_bytes:
                peer.sendall(again)
                sent += len(again)
    assert streaming.client.get("/healthz").status_code == 200
