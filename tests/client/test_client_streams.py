"""Streams through the client: the library's detections, tried again without harm, and told where one was lost."""

from __future__ import annotations

import asyncio
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from test_client import made_up, problem, without_times

sys.path.append(str(Path(__file__).parents[1] / "service"))

from difference_detector import DifferenceDetector
from service_world import LiveServer, live_server, png
from test_streams import FRAMES, imu_until
from worlds import World, make_world

from viflow_anomaly.client import (
    AsyncClient,
    Client,
    EncodedFrame,
    RetryPolicy,
    ServiceFaultError,
    ServiceRefusedError,
    ServiceUnreachableError,
)
from viflow_anomaly.detection import Detection
from viflow_anomaly.sensor_data import Frame, ImuSamples
from viflow_anomaly.stream import DetectionStream, StreamState

QUICK = RetryPolicy(attempts=3, first_wait_s=0.01, longest_wait_s=2.0)
EMPTY = (
    b'{"stream_id":"a","session_id":"s","begun":true,"waiting_frames":0,"faults":[],"detection_ids":null,'
    b'"detections":[]}'
)


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(frames=FRAMES, shift_px=0, square_px=24)


@pytest.fixture(scope="module")
def service() -> Iterator[LiveServer]:
    with live_server(lambda settings: DifferenceDetector()) as running:
        yield running


def url(server: LiveServer) -> str:
    return f"http://127.0.0.1:{server.port}"


def samples(world: World, k: int) -> ImuSamples:
    said = imu_until(world, k)
    return ImuSamples(np.array(said["timestamps_ns"]), np.array(said["gyro_rad_s"]), np.array(said["accel_m_s2"]))


def frame(world: World, k: int) -> Frame:
    return Frame(int(world.frame_timestamps_ns[k]), world.images[k])


def expected(world: World) -> list[dict[str, Any]]:
    stream, state, found = DetectionStream(DifferenceDetector(), camera=world.camera), StreamState(), []
    for k in range(FRAMES):
        state, detections, _ = stream.add_imu(state, samples(world, k))
        found += [without_times(one) for one in detections]
        state, detections, _ = stream.add_frame(state, frame(world, k))
        found += [without_times(one) for one in detections]
    return found


def test_a_stream_says_what_the_library_says(service: LiveServer, world: World) -> None:
    found: list[Detection] = []
    with Client(url(service)) as client:
        with client.stream("same", camera=world.camera) as stream:
            for k in range(FRAMES):
                answer = stream.send(frame=frame(world, k), imu=samples(world, k))
                assert (answer.begun, answer.faults, answer.answer_lost) == (k == 0, (), False)
                assert len(answer) == (k > 0)
                found += answer
            assert service.client.get("/streams/same").json()["received_frames"] == FRAMES
        assert service.client.get("/streams/same").status_code == 404  # forgotten with the block
    assert [without_times(one) for one in found] == expected(world)


def test_the_asynchronous_one_too(service: LiveServer, world: World) -> None:
    async def follow(name: str) -> list[dict[str, Any]]:
        found = []
        async with AsyncClient(url(service)) as client, client.stream(name, camera=world.camera) as stream:
            for k in range(FRAMES):
                for detection in await stream.send(frame=frame(world, k), imu=samples(world, k)):
                    found.append(without_times(detection))
        return found

    async def both() -> list[list[dict[str, Any]]]:
        return list(await asyncio.gather(follow("a"), follow("b")))

    assert asyncio.run(both()) == [expected(world)] * 2


def test_samples_and_files_apart_and_a_stream_that_is_kept(service: LiveServer, world: World) -> None:
    with Client(url(service)) as client:
        with client.stream("apart", camera=world.camera, include_masks=True, keep=True) as stream:
            stream.send(imu=samples(world, 0))
            stream.send(frame=EncodedFrame(int(world.frame_timestamps_ns[0]), png(world.images[0])))
            waiting = stream.send(frame=frame(world, 1))
            assert (waiting.waiting_frames, len(waiting)) == (1, 0)
            (detection,) = stream.send(imu=samples(world, 1))
            assert detection.rois[0].mask_rle is not None
        assert service.client.get("/streams/apart").status_code == 200
        with client.stream("apart") as stream:
            assert not stream.send(frame=frame(world, 2)).begun
            assert stream.forget()
            assert not stream.forget()


def test_what_is_wrong_is_told(service: LiveServer, world: World) -> None:
    with Client(url(service)) as client, client.stream("wrong", model="none") as stream:
        with pytest.raises(ServiceRefusedError) as caught:
            stream.send(frame=frame(world, 0), imu=samples(world, 0))
        assert (caught.value.code, caught.value.field) == ("model_unknown", "request.options.model")
        with pytest.raises(ServiceRefusedError) as caught:
            stream.send()
        assert caught.value.code == "field_missing"
    with Client(url(service)) as client, client.stream("../detect") as stream, pytest.raises(ServiceRefusedError):
        stream.send(frame=frame(world, 0))


@contextmanager
def losing_proxy(target: str, loses: Callable[[int], str]) -> Iterator[str]:
    """Passes requests on; ``loses(n)`` says of the n-th: ``request`` or ``answer`` goes missing, or ``nothing``."""
    count, lock = [0], threading.Lock()

    class Handler(BaseHTTPRequestHandler):
        def pass_on(self) -> None:
            body = self.rfile.read(int(self.headers.get("content-length", 0)))
            with lock:
                number, count[0] = count[0], count[0] + 1
            lost = loses(number)
            self.close_connection = lost != "nothing"
            if lost == "request":
                return
            headers = {"Content-Type": self.headers.get("content-type", "")}
            answer = httpx.request(self.command, target + self.path, content=body, headers=headers, trust_env=False)
            if lost == "answer":
                return
            self.send_response(answer.status_code)
            self.send_header("Content-Length", str(len(answer.content)))
            self.send_header("Content-Type", answer.headers.get("content-type", ""))
            self.end_headers()
            self.wfile.write(answer.content)

        do_POST = do_DELETE = pass_on  # noqa: N815

        def log_message(self, *arguments: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_a_lost_request_is_sent_again(service: LiveServer, world: World) -> None:
    with (
        losing_proxy(url(service), lambda number: "nothing" if number % 2 else "request") as between,
        Client(between, retries=QUICK) as client,
        client.stream("lost-request", camera=world.camera, keep=True) as stream,
    ):
        answers = [stream.send(frame=frame(world, k), imu=samples(world, k)) for k in range(FRAMES)]
    assert not any(answer.answer_lost or answer.faults for answer in answers)
    assert [without_times(one) for answer in answers for one in answer] == expected(world)


def test_a_lost_answer_is_told_and_changes_nothing(service: LiveServer, world: World) -> None:
    # The call of the third frame is taken, its answer is lost, and it is sent again.
    with (
        losing_proxy(url(service), lambda number: "answer" if number == 2 else "nothing") as between,
        Client(between, retries=QUICK) as client,
        client.stream("lost-answer", camera=world.camera, keep=True) as stream,
    ):
        answers = [stream.send(frame=frame(world, k), imu=samples(world, k)) for k in range(FRAMES)]
    assert [answer.answer_lost for answer in answers] == [k == 2 for k in range(FRAMES)]
    assert sorted({fault.code for fault in answers[2].faults}) == ["frame_duplicate", "imu_duplicate"]
    found = [without_times(one) for answer in answers for one in answer]
    assert found == [one for k, one in enumerate(expected(world), start=1) if k != 2]


def test_a_duplicate_of_the_callers_own_is_no_lost_answer(service: LiveServer, world: World) -> None:
    with Client(url(service)) as client, client.stream("twice", camera=world.camera) as stream:
        stream.send(frame=frame(world, 0), imu=samples(world, 0))
        again = stream.send(frame=frame(world, 0))
    assert ([fault.code for fault in again.faults], again.answer_lost) == (["frame_duplicate"], False)


def test_what_may_pass_is_tried_again_and_what_is_no_answer_is_told() -> None:
    good = (200, {"Content-Type": "application/json"}, EMPTY)
    for busy in (problem(503, "stream_busy"), problem(503, "streams_full"), problem(429, "rate_limited")):
        with made_up(busy, busy, good) as server, Client(server.url, retries=QUICK) as client:
            stream = client.stream("a b/c")
            assert stream.send().session_id == "s"
            assert len(server.requests) == 3
            assert server.requests[0][1] == "/streams/a%20b%2Fc/frames"
    for wrong in (b"{}", b"[]", b"{", EMPTY.replace(b'"detections":[]', b'"detections":[{}]')):
        with made_up((200, {}, wrong)) as server, Client(server.url) as client:
            with pytest.raises(ServiceFaultError) as caught:
                client.stream("a").send()
            assert caught.value.code == "service_answer_unreadable"


def test_leaving_a_service_that_has_gone_is_no_error(world: World) -> None:
    with made_up((200, {"Content-Type": "application/json"}, EMPTY)) as server:
        address = server.url
    with Client(address, retries=QUICK) as client, pytest.raises(ServiceUnreachableError), client.stream("a") as stream:
        stream.send()
