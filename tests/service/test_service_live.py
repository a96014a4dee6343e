"""Looking on over HTTP: recent pairs, their pictures, live events, tuning; bounds, scopes and every error."""

from __future__ import annotations

import asyncio
import gc
import json
import threading
import tomllib
import weakref
from collections.abc import AsyncGenerator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from looking_on import SAMPLE, feed, sample_calls, sample_pair
from rule_detector import RuleDetector
from service_world import LiveServer, assert_problem, form_request, live_server, wait_until
from test_service_metrics import scraped

from viflow_anomaly.alarm_calibration import make_calibration, write_calibration
from viflow_anomaly.alarm_footage import JudgedPair as AlarmFootage
from viflow_anomaly.alarm_footage import WatchedRecording, footage_of
from viflow_anomaly.detection import ModelInfo
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.settings import Settings, resolve_settings
from viflow_anomaly_service.api_keys import new_key
from viflow_anomaly_service.live import inspection_work
from viflow_anomaly_service.live.pair_memory import MAX_FOLLOWERS, UPLOADS
from viflow_anomaly_service.live.pair_stream import pair_events
from viflow_anomaly_service.live.pictures import PICTURES
from viflow_anomaly_service.live_response import LiveResponse
from viflow_anomaly_service.models.named import NamedModel


@pytest.fixture(scope="module")
def detector() -> AnomalyDetector:
    return AnomalyDetector.from_checkpoint()


@pytest.fixture(scope="module")
def real(detector: AnomalyDetector) -> Iterator[LiveServer]:
    """The bundled model; the stream drone7 has been played."""
    with live_server(lambda settings: detector) as running:
        feed(running.client)
        yield running


def pairs_of(server: LiveServer, stream_id: str = "drone7") -> list[dict[str, Any]]:
    answer = server.client.get(f"/streams/{stream_id}/pairs")
    assert answer.status_code == 200
    return list(answer.json()["pairs"])


def events_of(lines: Iterator[str], count: int) -> list[tuple[int, dict[str, Any]]]:
    """The first events of a stream of them: id and data."""
    found, number = [], 0
    for line in lines:
        if line.startswith("id: "):
            number = int(line[4:])
        if line.startswith("data: "):
            found.append((number, json.loads(line[6:])))
        if len(found) == count:
            break
    return found


def test_pairs_are_listed_newest_first_with_what_was_answered(real: LiveServer) -> None:
    pairs = pairs_of(real)
    assert len(pairs) == 9
    numbers = [pair["number"] for pair in pairs]
    assert numbers == sorted(numbers, reverse=True)
    assert all(pair["detection"]["schema_version"] == "1.0" for pair in pairs)
    assert pairs[0]["detection"]["rois"][0]["track_id"] is not None
    assert pairs[0]["signs"]["imu_rate_hz"] == pytest.approx(200.0)
    assert 0 < pairs[0]["signs"]["inlier_share"] <= 1
    assert pairs[0]["rig"]["pairs"] >= 1


def test_the_overview_counts_as_calibrate_counts(real: LiveServer) -> None:
    (stream,) = [one for one in real.client.get("/live").json()["streams"] if one["stream_id"] == "drone7"]
    alarms = sum(roi["label"] == "independent_motion" for pair in pairs_of(real) for roi in pair["detection"]["rois"])
    assert (stream["judged_pairs"], stream["alarms"], stream["active"]) == (9, alarms, True)
    assert stream["footage_s"] == pytest.approx(0.45)
    assert stream["alarms_per_hour"] == pytest.approx(alarms / 0.45 * 3600, abs=0.01)


@pytest.mark.parametrize("name", PICTURES)
@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_every_picture_has_the_size_of_the_frame(real: LiveServer, name: str, suffix: str) -> None:
    number = pairs_of(real)[0]["number"]
    answer = real.client.get(f"/streams/drone7/pairs/{number}/{name}.{suffix}")
    assert answer.status_code == 200
    assert answer.headers["content-type"] == {"png": "image/png", "jpg": "image/jpeg"}[suffix]
    picture = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    if name != "overlay":
        assert picture.shape[:2] == (256, 384)
    assert real.client.get(f"/streams/drone7/pairs/{number}/{name}.{suffix}").content == answer.content


def test_the_residual_is_bright_where_the_box_moves(real: LiveServer) -> None:
    pair = pairs_of(real)[0]
    answer = real.client.get(f"/streams/drone7/pairs/{pair['number']}/residual.png")
    heat = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert heat is not None
    box = pair["detection"]["rois"][0]["bbox"]
    inside = heat[box["y"] : box["y"] + box["height"], box["x"] : box["x"] + box["width"]]
    assert inside.mean() > 3 * heat.mean()


def test_events_resume_by_number(real: LiveServer) -> None:
    numbers = sorted(pair["number"] for pair in pairs_of(real))
    with real.client.stream("GET", f"/streams/drone7/live?after={numbers[3]}") as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        found = events_of(answer.iter_lines(), 5)
    assert [number for number, _ in found] == numbers[4:]
    assert all(data["number"] == number for number, data in found)
    with real.client.stream("GET", "/live/pairs", headers={"Last-Event-ID": str(numbers[-3])}) as answer:
        assert [number for number, _ in events_of(answer.iter_lines(), 2)] == numbers[-2:]
    later = numbers[-1] + 10**9  # of a process whose clock was ahead
    with real.client.stream("GET", f"/streams/drone7/live?after={later}") as answer:
        assert events_of(answer.iter_lines(), 1)[0][0] == numbers[0]


def test_a_follower_is_told_of_a_new_pair(real: LiveServer) -> None:
    with real.client.stream("GET", "/live/pairs") as answer:
        lines = answer.iter_lines()
        assert next(lines).startswith("retry:")
        with httpx.Client(base_url=str(real.client.base_url), timeout=60, trust_env=False) as other:
            feed(other, "second", calls=2)
        ((_, data),) = events_of(lines, 1)
    assert data["stream_id"] == "second"


def test_tuning_judges_the_pair_anew_and_says_the_configuration(real: LiveServer, tmp_path: Path) -> None:
    pair = pairs_of(real)[0]
    place = f"/streams/drone7/pairs/{pair['number']}/inspect"
    as_it_was = real.client.post(place, json={}).json()
    assert as_it_was["changed"] == []
    assert as_it_was["configuration"] == {"toml": "", "environment": ""}
    assert as_it_was["detection"]["rois"][0]["bbox"] == pair["detection"]["rois"][0]["bbox"]
    assert len(as_it_was["hypotheses"]["errors"]) == 8
    errors = as_it_was["hypotheses"]["errors"]
    assert errors[as_it_was["hypotheses"]["winner"]] == min(errors)
    assert len(as_it_was["flow_arrows"]) > 100
    regions = {"motion_score": 1.01, "shape_rule": "thickness", "min_area_fraction": 0.001}
    tuned = real.client.post(place, json={"options": {"regions": regions}, "view": False}).json()
    assert "hypotheses" not in tuned
    assert all(roi["label"] == "model_error" for roi in tuned["detection"]["rois"])
    assert {one["name"].removeprefix("detector.regions."): one["after"] for one in tuned["changed"]} == regions
    assert tomllib.loads(tuned["configuration"]["toml"]) == {"detector": {"regions": regions}}
    file = tmp_path / "tuned.toml"
    file.write_text(tuned["configuration"]["toml"], encoding="utf-8")
    assert_says(resolve_settings(config_file=file, environment={}), regions)
    lines = tuned["configuration"]["environment"].splitlines()
    assert_says(resolve_settings(environment=dict(line.split("=", 1) for line in lines)), regions)
    assert pairs_of(real)[0]["detection"] == pair["detection"]  # trying changes nothing


def assert_says(settings: Settings, regions: dict[str, Any]) -> None:
    assert {name: getattr(settings.detector.regions, name) for name in regions} == regions


@pytest.mark.parametrize(
    ("body", "code", "place"),
    [
        ({"options": {"regions": {"motion_score": 2}}}, "field_invalid", "options.regions.motion_score"),
        ({"options": {"regions": {"motion": 1}}}, "field_unknown", "options.regions.motion"),
        ({"options": {"model": "default"}}, "model_not_selectable", "options.model"),
        ({"detail": True}, "field_unknown", "detail"),
    ],
)
def test_wrong_options_are_named(real: LiveServer, body: dict[str, Any], code: str, place: str) -> None:
    number = pairs_of(real)[0]["number"]
    assert_problem(real.client.post(f"/streams/drone7/pairs/{number}/inspect", json=body), 422, code, place)


def test_an_uploaded_pair_can_be_looked_at_like_any_other(real: LiveServer) -> None:
    found = real.client.post("/inspect", files=sample_pair())
    assert found.status_code == 200, found.text
    body = found.json()
    plain = real.client.post("/detect", files=sample_pair()).json()
    assert body["detection"]["rois"] == plain["rois"]
    assert body["stream_id"] == UPLOADS
    assert real.client.get(f"/streams/{UPLOADS}/pairs/{body['number']}/evidence.png").status_code == 200
    assert real.client.post("/inspect", files=form_request(imu=None)).json()["code"] == "field_missing"
    assert real.client.post("/inspect", content=b"x").status_code == 415
    refused = real.client.post(f"/streams/{UPLOADS}/frames", files=sample_pair())
    assert refused.json()["code"] == "stream_id_invalid"  # no stream can take the name


def test_the_stages_of_an_uploaded_pair_are_counted_and_logged(
    detector: AnomalyDetector, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    stages = ("upload", "queue", "decode", "detect")
    with live_server(lambda settings: detector) as server:
        assert server.client.post("/inspect", files=sample_pair()).status_code == 200
        values = scraped(server)
        assert [values["viflow_stage_seconds_count", (stage,)] for stage in stages] == [1] * 4
        wait_until(lambda: any(vars(record).get("path") == "/inspect" for record in caplog.records))
    (line,) = (vars(record) for record in caplog.records if vars(record).get("path") == "/inspect")
    assert all(line[f"{stage}_ms"] >= 0 for stage in stages)
    assert line["detection"] == "ok"


def test_an_uploaded_pair_keeps_no_model_that_was_unloaded_meanwhile(
    detector: AnomalyDetector, monkeypatch: pytest.MonkeyPatch
) -> None:
    inspected = inspection_work.inspect_pair
    night = {"night": NamedModel(checkpoint=Path("/somewhere/night.safetensors"))}
    with live_server(lambda settings: detector, models=night) as server:

        def unloaded_meanwhile(*args: Any, **options: Any) -> Any:
            with httpx.Client(base_url=server.client.base_url, timeout=60, trust_env=False) as other:
                assert other.delete("/models/night").status_code == 204
            return inspected(*args, **options)

        monkeypatch.setattr(inspection_work, "inspect_pair", unloaded_meanwhile)
        parts = sample_pair()
        said = json.loads(parts["request"][1]) | {"options": {"model": "night"}}
        answer = server.client.post("/inspect", files=parts | {"request": (None, json.dumps(said), "application/json")})
        assert answer.status_code == 200, answer.text
        assert server.client.get("/live").json()["streams"] == []


def test_what_is_not_there_is_404(real: LiveServer) -> None:
    number = pairs_of(real)[0]["number"]
    ask = real.client.get
    assert_problem(ask("/streams/nobody/pairs"), 404, "stream_not_found", None)
    for wrong in ("7", "x", "9" * 30, "-1"):
        assert_problem(ask(f"/streams/drone7/pairs/{wrong}/source.png"), 404, "pair_not_found", None)
    assert_problem(ask(f"/streams/other/pairs/{number}/source.png"), 404, "pair_not_found", None)
    for wrong in ("source.gif", "source", "secret.png", "..png"):
        assert_problem(ask(f"/streams/drone7/pairs/{number}/{wrong}"), 404, "picture_unknown", None)
    assert_problem(real.client.post("/streams/drone7/pairs/7/inspect", json={}), 404, "pair_not_found", None)


def test_parameters_of_events_are_checked(real: LiveServer) -> None:
    assert_problem(real.client.get("/live/pairs?since=1"), 422, "parameter_unknown", "since")
    for wrong in ("x", "-1", "9" * 30, "1.5"):
        assert_problem(real.client.get(f"/live/pairs?after={wrong}"), 422, "parameter_invalid", "after")
    answer = real.client.get("/live/pairs?after=1", headers={"Last-Event-ID": "x"})
    assert_problem(answer, 422, "parameter_invalid", "Last-Event-ID")
    assert answer.json()["detail"].startswith("Last-Event-ID: ")


def test_an_empty_last_event_id_is_none(real: LiveServer) -> None:
    numbers = sorted(pair["number"] for pair in pairs_of(real))
    with real.client.stream("GET", f"/live/pairs?after={numbers[0]}", headers={"Last-Event-ID": ""}) as answer:
        assert answer.status_code == 200
        assert events_of(answer.iter_lines(), 1)[0][0] == numbers[1]
    assert_problem(real.client.get("/live/pairs?after="), 422, "parameter_invalid", "after")


@pytest.mark.parametrize("name", ["a%20b", "..%00", "~other", "x" * 65, "%C3%A4"])
def test_nobody_follows_a_name_that_no_stream_can_have(real: LiveServer, name: str) -> None:
    assert_problem(real.client.get(f"/streams/{name}/live"), 422, "stream_id_invalid", "stream_id")


@pytest.mark.parametrize("name", ["not.begun-yet", UPLOADS])
def test_what_is_still_to_come_can_be_followed(real: LiveServer, name: str) -> None:
    with real.client.stream("GET", f"/streams/{name}/live") as answer:
        assert answer.status_code == 200
        assert next(answer.iter_lines()).startswith("retry:")


def test_the_detector_is_described(real: LiveServer) -> None:
    told = real.client.get("/detector").json()
    assert told["configuration"]["regions"]["shape_rule"] == "axis_aligned"
    assert told["region_settings"]["motion_score"]["minimum"] == 0.5
    assert told["calibration"] is None
    assert {card["name"] for card in told["cards"]} == {"viflow-calibrated", "viflow-evidence"}


def test_the_detector_is_described_with_what_its_calibration_promises(tmp_path: Path) -> None:
    calm = WatchedRecording("hall", None, (AlarmFootage(0.5, ()),) * 800, abstained=0, failed={})
    made = make_calibration(
        [calm],
        footage_of([calm]),
        model=ModelInfo("rule", "1", "ab" * 32),
        execution=RuleDetector().execution,
        detector=RuleDetector().config,
        budget_per_hour=30.0,
        confidence=0.95,
        block_s=10.0,
    )
    path = tmp_path / "hall.json"
    write_calibration(path, made)
    other = {"night": NamedModel(checkpoint=Path("/somewhere/night.safetensors"))}
    with live_server(lambda settings: RuleDetector(), calibration=path, models=other) as server:
        told = server.client.get("/detector").json()["calibration"]
        assert (told["budget_per_hour"], told["promised"], told["recordings"]) == (30.0, True, ["hall"])
        assert told["motion_score"] == made.motion_score
        assert server.client.put("/models/default", json={"name": "night"}).status_code == 200
        assert server.client.get("/detector").json()["calibration"] is None  # it is of the other model
        assert server.client.put("/models/default", json={"name": "default"}).status_code == 200
        assert server.client.get("/detector").json()["calibration"] == told
        path.unlink()
        assert server.client.get("/detector").json()["calibration"] is None


def test_the_recording_that_the_page_plays_is_the_bundled_sample() -> None:
    frames = sorted((SAMPLE.parents[2] / "samples" / "drone" / "mav0" / "cam0" / "data").glob("*.png"))
    told = json.loads((SAMPLE / "recording.json").read_text(encoding="utf-8"))
    assert told["frames_ns"] == [int(frame.stem) - int(frames[0].stem) for frame in frames]
    for number, frame in enumerate(frames):
        ours, theirs = (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in (SAMPLE / f"{number}.jpg", frame))
        assert ours is not None
        assert theirs is not None
        assert np.abs(ours.astype(np.float32) - theirs).mean() < 4


def test_memory_is_bounded_in_pairs_and_bytes(detector: AnomalyDetector) -> None:
    with live_server(lambda settings: detector, live_pairs=3) as server:
        feed(server.client)
        assert len(pairs_of(server)) == 3
        assert server.client.get("/live").json()["streams"][0]["judged_pairs"] == 9
    two_pairs = 2 * (2 * 384 * 256 + 16_384)
    with live_server(lambda settings: detector, live_bytes=two_pairs) as server:
        feed(server.client, "first", calls=3)
        feed(server.client, "second", calls=3)
        assert [one["stream_id"] for one in server.client.get("/live").json()["streams"]] == ["second"]
        assert len(pairs_of(server, "second")) == 2


def test_all_imu_samples_count(real: LiveServer) -> None:
    (one, *_) = real.app.state.core.live.newest_first("drone7")
    pair = one.judged.pair
    assert pair.imu.accel_m_s2 is not None
    without = replace(one.judged, pair=replace(pair, imu=replace(pair.imu, accel_m_s2=None)))
    assert replace(one, judged=without).size_bytes == one.size_bytes - pair.imu.accel_m_s2.nbytes


def test_a_follower_who_reads_nothing_holds_no_pairs() -> None:
    with live_server(lambda settings: RuleDetector()) as server:
        feed(server.client, calls=5)
        core = server.app.state.core

        async def held() -> int:
            events = pair_events(core.live, core.gate, after=0, stream_id=None)
            assert (await anext(events)).startswith(b"retry:")
            assert b"event: pair" in await anext(events)  # which the client has not taken yet
            alive = weakref.WeakSet(core.live.newest_first("drone7"))
            core.live.forget("drone7")
            gc.collect()
            held = len(alive)
            await events.aclose()
            return held

        assert asyncio.run_coroutine_threadsafe(held(), server.loop).result(20) == 0


def test_a_deleted_stream_is_not_shown_any_more() -> None:
    with live_server(lambda settings: RuleDetector()) as server:
        feed(server.client, calls=3)
        assert server.client.delete("/streams/drone7").status_code == 204
        assert server.client.get("/live").json()["streams"] == []


def test_pictures_and_inspections_leave_half_of_the_places_to_detections() -> None:
    may_go, calls = threading.Event(), []  # type: ignore[var-annotated]
    may_go.set()
    detector = RuleDetector(may_go=may_go, calls=calls)
    with (
        live_server(lambda settings: detector, max_concurrent=2, max_queued=2) as server,
        ThreadPoolExecutor(4) as pool,
        ExitStack() as ending,
    ):
        ending.callback(may_go.set)
        feed(server.client, calls=3)
        place = f"/streams/drone7/pairs/{pairs_of(server)[0]['number']}"
        may_go.clear()
        gate = server.app.state.core.gate
        asked = [pool.submit(server.post_form, form_request()) for _ in range(2)]
        wait_until(lambda: gate.present == 2)
        assert_problem(server.client.get(f"{place}/source.png"), 503, "overloaded", None)
        assert_problem(server.client.post(f"{place}/inspect", json={}), 503, "overloaded", None)
        assert_problem(server.client.post("/inspect", files=form_request()), 503, "overloaded", None)
        asked += [pool.submit(server.post_form, form_request()) for _ in range(2)]
        wait_until(lambda: gate.present == 4)
        may_go.set()
        assert [one.result(30).status_code for one in asked] == [200] * 4
        wait_until(lambda: gate.present == 0)
        assert server.client.get(f"{place}/source.png").status_code == 200


def test_a_stream_that_is_deleted_during_a_call_does_not_come_back() -> None:
    may_go, calls = threading.Event(), []  # type: ignore[var-annotated]
    detector = RuleDetector(may_go=may_go, calls=calls)
    with live_server(lambda settings: detector) as server, ThreadPoolExecutor(1) as pool, ExitStack() as ending:
        ending.callback(may_go.set)
        first, second, *_ = sample_calls()
        assert server.client.post("/streams/drone7/frames", files=first).status_code == 200
        at_work = pool.submit(server.client.post, "/streams/drone7/frames", files=second)
        wait_until(lambda: len(calls) == 1)
        assert server.client.delete("/streams/drone7").status_code == 204
        may_go.set()
        assert len(at_work.result(30).json()["detections"]) == 1
        assert server.client.get("/live").json()["streams"] == []


def test_a_detector_without_maps_still_shows_its_frames() -> None:
    with live_server(lambda settings: RuleDetector()) as server:
        feed(server.client, calls=3)
        number = pairs_of(server)[0]["number"]
        place = f"/streams/drone7/pairs/{number}"
        assert server.client.get(f"{place}/source.jpg").status_code == 200
        assert_problem(server.client.get(f"{place}/residual.jpg"), 501, "maps_unavailable", None)
        assert_problem(server.client.post(f"{place}/inspect", json={}), 501, "maps_unavailable", None)
        assert server.client.get("/detector").json()["cards"] == []


@pytest.mark.parametrize(
    ("settings", "code"), [({"live_pairs": 0}, "live_off"), ({"workers": 2}, "streams_need_one_process")]
)
def test_without_memory_there_is_nothing_to_look_at(settings: dict[str, Any], code: str) -> None:
    with live_server(lambda settings: RuleDetector(), **settings) as server:
        for path in ("/live", "/live/pairs", "/streams/a/live", "/streams/a/pairs", "/streams/a/pairs/1/source.png"):
            assert_problem(server.client.get(path), 501, code, None)
        assert_problem(server.client.post("/inspect", files=form_request()), 501, code, None)
        if code == "live_off":
            feed(server.client, calls=2)


def test_followers_are_bounded() -> None:
    with live_server(lambda settings: RuleDetector()) as server:
        memory = server.app.state.core.live
        with ExitStack() as following:
            clients = following.enter_context(
                httpx.Client(base_url=server.client.base_url, timeout=60, trust_env=False)
            )
            for _ in range(MAX_FOLLOWERS):
                answer = following.enter_context(clients.stream("GET", "/live/pairs"))
                assert answer.status_code == 200
            answer = server.client.get("/live/pairs")
            assert_problem(answer, 503, "live_full", None)
            assert "retry-after" in answer.headers
        wait_until(lambda: memory.followers == 0)
        with server.client.stream("GET", "/live/pairs") as answer:
            assert answer.status_code == 200


def test_a_place_is_free_at_once_when_sending_is_cancelled() -> None:
    left: list[bool] = []

    async def parts() -> AsyncGenerator[bytes, None]:
        try:
            yield b": one\n\n"
        finally:
            left.append(False)

    async def cancelled_in_send() -> None:
        sending = asyncio.Event()

        async def receive() -> Any:
            await asyncio.Event().wait()

        async def send(message: Any) -> None:
            if message["type"] == "http.response.body":
                sending.set()
                await asyncio.Event().wait()

        response = LiveResponse(parts(), leave=lambda: left.append(True))
        task = asyncio.ensure_future(response({"type": "http", "asgi": {}}, receive, send))
        await sending.wait()
        task.cancel()
        await asyncio.wait({task})
        assert left == [False, True]  # the generator ends first, nobody waits for garbage to be collected

    asyncio.run(cancelled_in_send())


def test_scopes(tmp_path: Path) -> None:
    keys = {}
    lines = []
    for scope in ("read", "detect"):
        keys[scope], line = new_key(scope, [scope])  # type: ignore[list-item]
        lines.append(line)
    file = tmp_path / "keys.txt"
    file.write_text("\n".join(lines), encoding="utf-8")
    with live_server(lambda settings: RuleDetector(), key_file=file) as server:
        server.client.headers["X-API-Key"] = keys["detect"]
        feed(server.client, calls=3)

        def status(method: str, path: str, scope: str | None) -> int:
            headers = {"X-API-Key": keys[scope] if scope else ""}
            return server.client.request(method, path, headers=headers).status_code

        number = server.client.get("/live", headers={"X-API-Key": keys["read"]}).json()["newest_number"]
        pair = f"/streams/drone7/pairs/{number}"
        for path in ("/live", "/streams/drone7/pairs", f"{pair}/source.png", "/detector"):
            assert [status("GET", path, scope) for scope in ("read", "detect", None)] == [200, 403, 401], path
        for path in ("/live/pairs", "/streams/drone7/live"):
            assert [status("GET", path, scope) for scope in ("detect", None)] == [403, 401], path
        for path in (f"{pair}/inspect", "/inspect"):
            assert [status("POST", path, scope) for scope in ("read", None)] == [403, 401], path
            assert status("POST", path, "detect") not in (401, 403)
        assert status("GET", "/streams/drone7", "read") == 403
        assert [status("GET", path, None) for path in ("/", "/dashboard/app.js")] == [200, 200]
        assert status("POST", "/dashboard/app.js", None) == 405


def test_the_page_says_what_it_may_load(server: LiveServer) -> None:
    page = server.client.get("/")
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    policy = page.headers["content-security-policy"]
    assert "default-src 'none'; script-src 'self'; style-src 'self'" in policy
    assert "unsafe" not in policy
    assert page.headers["cache-control"] == "no-cache"
    again = server.client.get("/", headers={"If-None-Match": page.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    script = server.client.get("/dashboard/app.js")
    assert script.headers["content-type"].startswith("text/javascript")
    assert_problem(server.client.get("/dashboard/secret.js"), 404, "not_found", None)
    for text in (page.text, script.text):
        assert "https://" not in text


def test_the_page_can_be_switched_off() -> None:
    with live_server(lambda settings: RuleDetector(), dashboard=False) as server:
        assert [server.client.get(path).status_code for path in ("/", "/dashboard/app.js")] == [404, 404]
        assert server.client.get("/live").status_code == 200
