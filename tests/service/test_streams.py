"""Streams through a live service: the detections of the library's stream, in order, bounded, and never half-way."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from difference_detector import DifferenceDetector
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from rule_detector import RuleDetector
from service_world import LiveServer, assert_problem, base64_text, live_server, png, wait_until
from serving_process import ServingProcess, serving_process
from worlds import World, make_world

from viflow_anomaly.config import MotorSource
from viflow_anomaly.detection import to_json_dict
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples
from viflow_anomaly.stream import DetectionStream, StreamState
from viflow_anomaly_service.store.detection_store import DetectionStore
from viflow_anomaly_service.store.failures import store_error
from viflow_anomaly_service.streams import table

FRAMES = 6


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(frames=FRAMES, shift_px=0, square_px=24)


@pytest.fixture(scope="module")
def streaming() -> Iterator[LiveServer]:
    with live_server(lambda settings: DifferenceDetector()) as running:
        yield running


def camera(world: World) -> dict[str, Any]:
    one = world.camera
    return {name: getattr(one, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}


def frame(world: World, k: int) -> dict[str, Any]:
    stamp = int(world.frame_timestamps_ns[k])
    return {"timestamp_ns": stamp, "image_base64": base64_text(png(world.images[k]))}


def rows(world: World, after_ns: int, until_ns: int) -> slice:
    stamps = world.imu.timestamps_ns
    first, end = np.searchsorted(stamps, [after_ns, until_ns], side="right")
    return slice(int(first), int(end))


def imu(world: World, part: slice) -> dict[str, Any]:
    log = world.imu
    assert log.accel_m_s2 is not None
    return {
        "timestamps_ns": log.timestamps_ns[part].tolist(),
        "gyro_rad_s": log.gyro_rad_s[part].tolist(),
        "accel_m_s2": log.accel_m_s2[part].tolist(),
    }


def imu_until(world: World, k: int) -> dict[str, Any]:
    """The samples since the frame before ``k``; the first frame's reach back to the beginning."""
    stamps = world.frame_timestamps_ns
    return imu(world, rows(world, int(stamps[k - 1]) if k else -(2**60), int(stamps[k])))


def call(world: World, k: int) -> dict[str, Any]:
    return {"frame": frame(world, k), "imu": imu_until(world, k)}


def post(server: LiveServer, name: str, body: dict[str, Any]) -> httpx.Response:
    return server.client.post(f"/streams/{name}/frames", json=body)


def accepted(server: LiveServer, name: str, body: dict[str, Any]) -> dict[str, Any]:
    answer = post(server, name, body)
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def form_of(body: dict[str, Any], image: bytes) -> dict[str, Any]:
    """The same call in multipart/form-data."""
    samples = {"frame_timestamp_ns": body["frame"]["timestamp_ns"], **body["imu"]}
    rest = {name: body[name] for name in ("camera", "options") if name in body}
    return {
        "frame": ("frame.png", image, "image/png"),
        "imu": (None, json.dumps(samples), "application/json"),
        "request": (None, json.dumps(rest), "application/json"),
    }


def codes(answer: dict[str, Any]) -> list[str]:
    return [fault["code"] for fault in answer["faults"]]


def untimed(detection: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in detection.items() if name != "timings_ms"}


def expected_detections(world: World) -> list[dict[str, Any]]:
    """What the library's stream says of the same calls."""
    stream, state = DetectionStream(DifferenceDetector(), camera=world.camera), StreamState()
    found = []
    for k in range(FRAMES):
        samples = imu_until(world, k)
        given = ImuSamples(
            np.array(samples["timestamps_ns"]), np.array(samples["gyro_rad_s"]), np.array(samples["accel_m_s2"])
        )
        for step_of, value in (
            (stream.add_imu, given),
            (stream.add_frame, Frame(int(world.frame_timestamps_ns[k]), world.images[k])),
        ):
            step = step_of(state, value)  # type: ignore[operator]
            state = step.state
            assert not step.faults
            found += [untimed(json.loads(json.dumps(to_json_dict(one)))) for one in step.detections]
    return found


@pytest.mark.parametrize("as_form", [False, True])
def test_a_stream_says_what_the_library_says(streaming: LiveServer, world: World, as_form: bool) -> None:
    name = f"same-{as_form}"
    found = []
    for k in range(FRAMES):
        body = call(world, k) | ({"camera": camera(world)} if k == 0 else {})
        if as_form:
            parts = form_of(body, png(world.images[k]))
            answer = streaming.client.post(f"/streams/{name}/frames", files=parts).json()
        else:
            answer = accepted(streaming, name, body)
        assert answer["faults"] == []
        assert answer["begun"] == (k == 0)
        assert answer["detection_ids"] is None
        assert len(answer["detections"]) == (k > 0)
        found += answer["detections"]
    assert [untimed(one) for one in found] == expected_detections(world)
    tracks = [roi["track_id"] for one in found for roi in one["rois"]]
    assert tracks
    assert None not in tracks
    status = streaming.client.get(f"/streams/{name}").json()
    assert (status["received_frames"], status["judged_pairs"], status["kept_frames"]) == (FRAMES, FRAMES - 1, 1)
    assert status["newest_frame_ns"] == int(world.frame_timestamps_ns[-1])
    assert status["state_bytes"] > world.images[0].nbytes
    assert name in [one["stream_id"] for one in streaming.client.get("/streams").json()["streams"]]


def test_samples_may_come_after_their_frame(streaming: LiveServer, world: World) -> None:
    first = accepted(streaming, "late-imu", {"frame": frame(world, 0), "imu": {"timestamps_ns": []}})
    assert (first["begun"], first["waiting_frames"], first["detections"]) == (True, 0, [])
    assert accepted(streaming, "late-imu", {"frame": frame(world, 1)})["waiting_frames"] == 1
    answer = accepted(streaming, "late-imu", {"imu": imu(world, slice(None))})
    assert (answer["waiting_frames"], len(answer["detections"]), answer["faults"]) == (0, 1, [])


def test_what_comes_late_twice_or_out_of_order_is_reported(streaming: LiveServer, world: World) -> None:
    for k in range(2):
        accepted(streaming, "faults", call(world, k))
    again = accepted(streaming, "faults", call(world, 1))
    assert codes(again) == ["imu_duplicate", "frame_duplicate"]
    assert again["detections"] == []
    assert codes(accepted(streaming, "faults", {"frame": frame(world, 0)})) == ["frame_out_of_order"]
    moved = imu_until(world, 1)
    moved["timestamps_ns"] = [stamp + 1 for stamp in moved["timestamps_ns"]]
    assert codes(accepted(streaming, "faults", {"imu": moved})) == ["imu_out_of_order"]
    bare = imu_until(world, 2)
    del bare["accel_m_s2"]
    assert codes(accepted(streaming, "faults", {"imu": bare})) == ["imu_accel_changed"]
    good = accepted(streaming, "faults", call(world, 2))
    assert (len(good["detections"]), good["faults"]) == (1, [])
    status = streaming.client.get("/streams/faults").json()
    assert status["faults"]["frame_duplicate"] == 1
    assert 'viflow_stream_faults_total{code="frame_duplicate"}' in streaming.client.get("/metrics").text


def test_a_pair_is_given_up_when_too_many_wait(streaming: LiveServer, world: World) -> None:
    answers = [
        accepted(streaming, "no-imu", {"frame": frame(world, 0) | {"timestamp_ns": 10**9 + k}}) for k in range(9)
    ]
    assert [answer["waiting_frames"] for answer in answers] == [0, 1, 2, 3, 4, 5, 6, 7, 7]
    assert codes(answers[-1]) == ["imu_late"]


def test_a_frame_of_another_size_is_a_fault_and_the_stream_goes_on(streaming: LiveServer, world: World) -> None:
    small = make_world(frames=1, width=64, height=48)
    accepted(streaming, "sizes", call(world, 0))
    other = {"timestamp_ns": int(world.frame_timestamps_ns[1]), "image_base64": base64_text(png(small.images[0]))}
    assert codes(accepted(streaming, "sizes", {"frame": other, "imu": imu_until(world, 1)})) == ["image_sizes_differ"]
    assert codes(accepted(streaming, "sizes", call(world, 2))) == ["image_sizes_differ"]
    assert len(accepted(streaming, "sizes", call(world, 3))["detections"]) == 1


def test_a_stream_keeps_its_camera_and_options(streaming: LiveServer, world: World) -> None:
    setup = {"camera": camera(world), "options": {"include_masks": True}}
    accepted(streaming, "setup", call(world, 0) | setup)
    answer = accepted(streaming, "setup", call(world, 1) | setup)
    assert all("mask_rle" in roi for roi in answer["detections"][0]["rois"])
    for name, other in (("camera", camera(world) | {"fx": 1.0}), ("options", {"include_masks": False})):
        assert_problem(post(streaming, "setup", call(world, 2) | {name: other}), 409, "stream_setup_changed", name)
    assert len(accepted(streaming, "setup", call(world, 2))["detections"]) == 1
    parts = form_of(call(world, 3) | {"camera": camera(world) | {"fx": 1.0}}, png(world.images[3]))
    refused = streaming.client.post("/streams/setup/frames", files=parts)
    assert_problem(refused, 409, "stream_setup_changed", "request.camera")


def changed(body: dict[str, Any], **changes: Any) -> dict[str, Any]:
    return {name: value for name, value in (body | changes).items() if value is not None}


@pytest.mark.parametrize(
    ("changes", "status", "code", "field"),
    [
        ({"frame": None, "imu": None}, 422, "field_missing", "frame"),
        ({"colour": 1}, 422, "field_unknown", "colour"),
        ({"frame": {"timestamp_ns": 1, "image_base64": "data:x"}}, 422, "image_base64_invalid", "frame.image_base64"),
        ({"frame": {"timestamp_ns": 1, "image_base64": "AAAA"}}, 415, "image_unsupported_type", "frame.image_base64"),
        ({"frame": {"timestamp_ns": 1.5, "image_base64": ""}}, 422, "field_invalid", "frame.timestamp_ns"),
        ({"frame": None, "imu": {"timestamps_ns": []}}, 422, "field_missing", "frame"),
        ({"imu": {"timestamps_ns": [1]}}, 422, "imu_wrong_shape", "imu.gyro_rad_s"),
        ({"imu": {"timestamps_ns": [2, 1], "gyro_rad_s": [[0, 0, 0]] * 2}}, 422, "imu_unsorted", "imu.timestamps_ns"),
        ({"imu": {"timestamps_ns": [1], "gyro_rad_s": [[0, 0]]}}, 422, "imu_wrong_shape", "imu.gyro_rad_s.0"),
        ({"imu": {"timestamps_ns": [2**63 - 1], "gyro_rad_s": [[0, 0, 0]]}}, 422, "timestamp_out_of_range", None),
        ({"camera": {"fx": 1}}, 422, "camera_invalid", None),
        ({"options": {"regions": {"zoom": 1}}}, 422, "field_unknown", "options.regions.zoom"),
        ({"motor_command": [1.0]}, 422, "field_unknown", "motor_command"),
    ],
)
def test_a_wrong_call_is_named_and_begins_nothing(
    streaming: LiveServer, world: World, changes: dict[str, Any], status: int, code: str, field: str | None
) -> None:
    answer = post(streaming, "wrong", changed(call(world, 0), **changes))
    assert (answer.status_code, answer.json()["code"]) == (status, code), answer.text
    if field is not None:
        assert answer.json()["field"] == field
    assert_problem(streaming.client.get("/streams/wrong"), 404, "stream_not_found", None)


@pytest.mark.parametrize(
    ("change", "code", "field"),
    [
        ({"imu": None}, "field_missing", "imu.frame_timestamp_ns"),
        ({"frame": None}, "field_missing", "frame"),
        ({"source": ("s", b"1")}, "field_unknown", "source"),
        ({"request": (None, '{"zoom":1}')}, "field_unknown", "request.zoom"),
        ({"request": (None, '{"fx": 70.0, "cx": 47.5}')}, "field_unknown", "request"),
    ],
)
def test_a_wrong_form_is_named(
    streaming: LiveServer, world: World, change: dict[str, Any], code: str, field: str
) -> None:
    parts = changed(form_of(call(world, 0), png(world.images[0])), **change)
    assert_problem(streaming.client.post("/streams/wrong/frames", files=parts), 422, code, field)


@pytest.mark.parametrize("name", ["a b", "%C3%84", "a" * 65, "a%00", "%2e%2e"])
def test_a_name_has_few_letters(streaming: LiveServer, world: World, name: str) -> None:
    assert_problem(post(streaming, name, call(world, 0)), 422, "stream_id_invalid", "stream_id")
    assert_problem(streaming.client.get(f"/streams/{name}"), 404, "stream_not_found", None)


def test_a_deleted_stream_begins_anew(streaming: LiveServer, world: World) -> None:
    first = accepted(streaming, "gone", call(world, 0))
    assert streaming.client.delete("/streams/gone").status_code == 204
    assert_problem(streaming.client.delete("/streams/gone"), 404, "stream_not_found", None)
    again = accepted(streaming, "gone", call(world, 0))
    assert again["begun"]
    assert again["session_id"] != first["session_id"]


def test_an_idle_stream_expires(world: World) -> None:
    with live_server(lambda settings: DifferenceDetector(), stream_idle_s=0.2) as server:
        accepted(server, "idle", call(world, 0))
        wait_until(lambda: server.client.get("/streams/idle").status_code == 404)
        assert server.client.get("/streams").json() == {"streams": []}
        assert accepted(server, "idle", call(world, 1))["begun"]


def test_streams_are_bounded_in_number_and_bytes(world: World) -> None:
    room = 3 * world.images[0].nbytes
    with live_server(lambda settings: DifferenceDetector(), max_streams=2, max_stream_bytes=room) as server:
        for name in "ab":
            accepted(server, name, {"frame": frame(world, 0)})
        refused = post(server, "c", {"frame": frame(world, 0)})
        assert_problem(refused, 503, "streams_full", None)
        assert int(refused.headers["retry-after"]) > 0
        accepted(server, "a", {"frame": frame(world, 1)})
        assert_problem(post(server, "b", {"frame": frame(world, 1)}), 503, "streams_full", None)
        assert server.client.get("/streams/b").json()["received_frames"] == 1
        server.client.delete("/streams/a")
        assert accepted(server, "b", {"frame": frame(world, 1)})["waiting_frames"] == 1


def test_calls_of_a_stream_are_judged_one_at_a_time_in_order(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "CALLS_AT_ONCE", 4)
    may_go, at_work, most = threading.Event(), [0], [0]
    order: list[int] = []

    def judge(pair: FramePair) -> None:
        at_work[0] += 1
        most[0] = max(most[0], at_work[0])
        may_go.wait(20)
        order.append(pair.source.timestamp_ns)
        at_work[0] -= 1

    detector = DifferenceDetector(on_pair=judge)
    with live_server(lambda settings: detector, max_concurrent=3) as server, ThreadPoolExecutor(4) as clients:
        accepted(server, "order", call(world, 0))
        (stream,) = server.app.state.core.streams.begun()
        running = []
        for k in range(1, 5):
            running.append(clients.submit(accepted, server, "order", call(world, k)))
            wait_until(lambda k=k: stream.calls == k)  # type: ignore[misc]
        assert_problem(post(server, "order", call(world, 5)), 503, "stream_busy", None)
        may_go.set()
        answers = [one.result() for one in running]
    assert order == world.frame_timestamps_ns[:4].tolist()
    assert [one["detections"][0]["source_timestamp_ns"] for one in answers] == order
    assert most == [1]


def test_a_client_that_leaves_while_its_pair_waits_changes_nothing(world: World) -> None:
    may_go, begun = threading.Event(), threading.Event()

    def judge(pair: FramePair) -> None:
        begun.set()
        may_go.wait(20)

    with live_server(lambda settings: DifferenceDetector(on_pair=judge)) as server:
        accepted(server, "left", call(world, 0))
        url = f"http://127.0.0.1:{server.port}/streams/left/frames"
        with pytest.raises(httpx.ReadTimeout):
            httpx.post(url, json=call(world, 1), timeout=httpx.Timeout(10, read=0.3), trust_env=False)
        assert begun.wait(10)
        (stream,) = server.app.state.core.streams.begun()
        wait_until(lambda: stream.calls == 0)
        may_go.set()
        again = accepted(server, "left", call(world, 1))
        assert (again["faults"], len(again["detections"])) == ([], 1)


def test_stored_detections_of_streams(world: World, tmp_path: Path) -> None:
    with live_server(lambda settings: DifferenceDetector(), store_url=str(tmp_path / "x.db")) as server:
        answers = [accepted(server, name, call(world, k)) for k in range(3) for name in ("a", "b")]
        ids = [one for answer in answers if answer["stream_id"] == "a" for one in answer["detection_ids"]]
        assert len(ids) == 2
        found = server.client.get("/detections", params={"stream": "a", "order": "asc"}).json()["detections"]
        assert [one["id"] for one in found] == ids
        assert {(one["stream_id"], one["session_id"]) for one in found} == {("a", answers[0]["session_id"])}
        assert [one["detection"] for one in found] == [
            one for answer in answers if answer["stream_id"] == "a" for one in answer["detections"]
        ]


def test_a_call_that_could_not_be_stored_can_be_sent_again(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with live_server(lambda settings: DifferenceDetector(), store_url=str(tmp_path / "x.db")) as server:
        accepted(server, "again", call(world, 0))

        def fail(self: DetectionStore, *given: object) -> None:
            raise store_error("store_full")

        with monkeypatch.context() as failing:
            failing.setattr(DetectionStore, "add", fail)
            assert_problem(post(server, "again", call(world, 1)), 503, "store_full", None)
        wait_until(lambda: server.client.get("/readyz").status_code == 200)
        again = accepted(server, "again", call(world, 1))
        assert (again["faults"], len(again["detections"])) == ([], 1)
        assert len(server.client.get("/detections").json()["detections"]) == 1


def test_several_processes_refuse_streams(world: World) -> None:
    with live_server(lambda settings: DifferenceDetector(), workers=2) as server:
        assert_problem(post(server, "a", call(world, 0)), 501, "streams_need_one_process", None)
        for ask in (server.client.get, server.client.delete):
            assert_problem(ask("/streams/a"), 501, "streams_need_one_process", None)
        assert_problem(server.client.get("/streams"), 501, "streams_need_one_process", None)


def test_a_model_that_wants_commands_refuses_streams(world: World) -> None:
    source: MotorSource = "command"
    with live_server(lambda settings: DifferenceDetector(motor_source=source)) as server:
        assert_problem(post(server, "a", call(world, 0)), 501, "streams_motor_unsupported", None)


def test_a_detector_that_only_detects_serves_streams(world: World) -> None:
    with live_server(lambda settings: RuleDetector()) as server:
        accepted(server, "plain", call(world, 0))
        assert len(accepted(server, "plain", call(world, 1))["detections"]) == 1


STAMPS = st.integers(-(2**63), 2**63 - 1) | st.integers(-5, 5).map(lambda k: k * 10_000_000)
CALLS = st.fixed_dictionaries(
    {},
    optional={
        "frame": st.none() | STAMPS,
        "imu": st.lists(STAMPS, max_size=6),
        "sort": st.booleans(),
    },
)


@hypothesis_settings(max_examples=40, deadline=None)
@given(calls=st.lists(CALLS, min_size=1, max_size=6))
def test_no_stamps_break_a_stream(streaming: LiveServer, world: World, calls: list[dict[str, Any]]) -> None:
    image = base64_text(png(world.images[0]))
    for one in calls:
        body: dict[str, Any] = {}
        if one.get("frame") is not None:
            body["frame"] = {"timestamp_ns": one["frame"], "image_base64": image}
        if "imu" in one:
            stamps = sorted(set(one["imu"])) if one.get("sort") else one["imu"]
            body["imu"] = {"timestamps_ns": stamps, "gyro_rad_s": [[0.0, 0.0, 0.1]] * len(stamps)}
        answer = post(streaming, "fuzz", body)
        assert answer.status_code in (200, 422), answer.text
    streaming.client.delete("/streams/fuzz")


def test_a_kill_loses_no_detection_of_a_stream_that_was_answered(empty_store_url: str, world: World) -> None:
    acknowledged: dict[str, Any] = {}
    enough = threading.Event()

    def fly(serving: ServingProcess, name: str) -> None:
        step_ns = int(world.frame_timestamps_ns[1] - world.frame_timestamps_ns[0])
        with serving.client() as client:
            for k in range(10_000):
                stamp = k * step_ns
                stamps = list(range(stamp - 9 * step_ns // 10, stamp + 1, step_ns // 10))
                image = base64_text(png(world.images[k % FRAMES]))
                samples = {"timestamps_ns": stamps, "gyro_rad_s": [[0.0, 0.0, 0.1]] * len(stamps)}
                body = {"frame": {"timestamp_ns": stamp, "image_base64": image}, "imu": samples}
                try:
                    answer = client.post(f"/streams/{name}/frames", json=body)
                except httpx.TransportError:
                    return
                assert answer.status_code == 200, answer.text
                found = answer.json()
                acknowledged.update(zip(found["detection_ids"], found["detections"], strict=True))
                if len(acknowledged) >= 30:
                    enough.set()

    with serving_process(store_url=empty_store_url) as serving, ThreadPoolExecutor(3) as clients:
        with serving.client() as client:
            wait_until(lambda: client.get("/readyz").status_code == 200, seconds=20)
        running = [clients.submit(fly, serving, name) for name in "abc"]
        assert enough.wait(60)
        serving.process.kill()
        for one in running:
            one.result()
    with serving_process(store_url=empty_store_url) as again, again.client() as client:
        wait_until(lambda: client.get("/readyz").status_code == 200, seconds=20)
        lines = client.get("/detections.ndjson").text.splitlines()
        stored = {one["id"]: one for one in map(json.loads, lines)}
        assert acknowledged.items() <= {name: one["detection"] for name, one in stored.items()}.items()
        assert {one["stream_id"] for one in stored.values()} == {"a", "b", "c"}
        assert client.get("/streams").json() == {"streams": []}
