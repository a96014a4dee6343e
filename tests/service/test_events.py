"""Events through a live service: what is told, in which order, to whom who reads live or asks later."""

from __future__ import annotations

import json
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from event_stream import play, reading
from scripted_detector import ScriptedDetector, scripted_call
from service_world import LiveServer, assert_problem, live_server, wait_until
from serving_process import serving_process

from viflow_anomaly.errors import ConfigError, MissingDependencyError
from viflow_anomaly_service.app import create_app
from viflow_anomaly_service.events import live
from viflow_anomaly_service.events.event_record import EventRecord
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.store.failures import store_error
from viflow_anomaly_service.store.record import IdMaker

QUICK: dict[str, Any] = {
    "event_start_pairs": 2,
    "event_end_s": 0.1,
    "event_update_s": 0.1,
    "event_cooldown_s": 0.0,
}
ONE_EVENT = [0.9, 0.9, 0.9, 0.9, 0.9, 0.0, 0.0, 0.0, 0.0]
"""With QUICK: a start, an update and an end, in pairs of 50 ms."""
KINDS = ["start", "update", "end"]


@pytest.fixture(params=["memory", "sqlite"])
def telling(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[LiveServer]:
    store = {} if request.param == "memory" else {"store_url": str(tmp_path / "events.db")}
    with live_server(lambda settings: ScriptedDetector(), **QUICK, **store) as running:
        yield running


@pytest.fixture
def storing(tmp_path: Path) -> Iterator[LiveServer]:
    with live_server(lambda settings: ScriptedDetector(), **QUICK, store_url=str(tmp_path / "events.db")) as running:
        yield running


def url(server: LiveServer) -> str:
    return f"http://127.0.0.1:{server.port}"


def listed(server: LiveServer, **parameters: Any) -> dict[str, Any]:
    answer = server.client.get("/events", params=parameters)
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def test_a_reader_is_told_of_start_update_and_end(telling: LiveServer) -> None:
    with reading(url(telling)) as stream:
        ids = play(telling.client, "hall", ONE_EVENT)
        wait_until(lambda: len(stream.messages) >= 3)
    assert [kind for _, kind, _ in stream.messages] == KINDS
    assert stream.ids == sorted(stream.ids, key=str)
    events = [event for _, _, event in stream.messages]
    assert [event["event_id"] for event in events] == stream.ids
    assert len({(event["thing_id"], event["session_id"]) for event in events}) == 1
    assert [event["reason"] for event in events] == [None, None, "left"]
    assert {event["started_at_ns"] for event in events} < {event["timestamp_ns"] for event in events} | {
        events[0]["started_at_ns"]
    }
    if ids:
        assert all(event["detection_id"] in ids for event in events)
    else:
        assert [event["detection_id"] for event in events] == [None] * 3


def test_a_reader_whose_last_event_is_deleted_is_told(storing: LiveServer) -> None:
    play(storing.client, "hall", ONE_EVENT)
    first, *rest = listed(storing, order="asc")["events"]
    with reading(url(storing), last_event_id=first["event_id"]) as stream:
        wait_until(lambda: len(stream.messages) == 2)
    assert stream.ids == [event["event_id"] for event in rest]
    with reading(url(storing), last_event_id="0" * 31 + "1") as stream:
        wait_until(lambda: len(stream.messages) == 4)
    assert [kind for _, kind, _ in stream.messages] == ["gap", *KINDS]


def test_events_are_counted_once_though_they_come_twice(storing: LiveServer) -> None:
    play(storing.client, "hall", ONE_EVENT[:4])
    core = storing.app.state.core
    (thing_id,) = {event["thing_id"] for event in listed(storing)["events"]}
    last = listed(storing)["events"][0]
    end = EventRecord(
        IdMaker()(), thing_id, "end", "hall", last["timestamp_ns"] + 1, json.dumps(last | {"kind": "end"})
    )
    core.events.stored.events.add([end])  # by another process, which has taken this one for dead
    assert storing.client.delete("/streams/hall").status_code == 204
    wait_until(lambda: not core.events.desk._ends)
    play(storing.client, "door", ONE_EVENT)
    assert 'viflow_events_total{kind="end"} 1.0' in storing.client.get("/metrics").text
    assert len(listed(storing, kind="end")["events"]) == 2


def test_no_proxy_holds_events_back(telling: LiveServer) -> None:
    with telling.client.stream("GET", "/events/live") as answer:
        assert answer.headers["X-Accel-Buffering"] == "no"


def test_events_are_what_the_document_says(storing: LiveServer) -> None:
    play(storing.client, "hall", ONE_EVENT)
    document = storing.client.get("/openapi.json").json()
    schema = {"$ref": "#/components/schemas/EventPage", "components": document["components"]}
    page = listed(storing)
    assert len(page["events"]) == 3
    jsonschema.Draft202012Validator(schema).validate(page)
    answer = storing.client.get("/detections/" + page["events"][2]["detection_id"]).json()
    (roi,) = answer["detection"]["rois"]
    start = page["events"][2]
    assert (roi["track_id"], roi["score"], roi["bbox"]) == (start["track_id"], start["score"], start["bbox"])


def test_the_last_id_resumes_without_gap_or_repetition(telling: LiveServer) -> None:
    with reading(url(telling)) as first:
        play(telling.client, "hall", ONE_EVENT)
        wait_until(lambda: len(first.messages) == 3)
    play(telling.client, "door", ONE_EVENT)
    with reading(url(telling), last_event_id=first.ids[0]) as second:
        wait_until(lambda: len(second.messages) == 5)
        play(telling.client, "yard", ONE_EVENT)
        wait_until(lambda: len(second.messages) == 8)
    assert second.ids[:2] == first.ids[1:]
    assert len(set(second.ids)) == 8
    assert [event["stream_id"] for _, _, event in second.messages] == ["hall"] * 2 + ["door"] * 3 + ["yard"] * 3


def test_a_reader_of_one_stream_hears_of_no_other(telling: LiveServer) -> None:
    with reading(url(telling), stream_id="door") as stream:
        play(telling.client, "hall", ONE_EVENT)
        play(telling.client, "door", ONE_EVENT)
        wait_until(lambda: len(stream.messages) == 3)
    assert {event["stream_id"] for _, _, event in stream.messages} == {"door"}


def test_a_ring_that_has_lost_events_says_so() -> None:
    with live_server(lambda settings: ScriptedDetector(), **QUICK, event_ring=2) as server:
        with reading(url(server)) as first:
            play(server.client, "hall", ONE_EVENT)
            wait_until(lambda: len(first.messages) == 3)
        with reading(url(server), last_event_id=first.ids[0]) as second:
            wait_until(lambda: len(second.messages) == 3)
        assert [kind for _, kind, _ in second.messages] == ["gap", "update", "end"]
        assert second.ids[0] is None


def test_signs_of_life_keep_a_quiet_connection(telling: LiveServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "HEARTBEAT_SECONDS", 0.05)
    with reading(url(telling)) as stream:
        wait_until(lambda: stream.comments >= 3)


def test_readers_are_bounded(tmp_path: Path) -> None:
    with live_server(lambda settings: ScriptedDetector(), max_event_readers=1) as server:
        with reading(url(server)):
            assert_problem(server.client.get("/events/live"), 503, "event_readers_full", None)
            assert "viflow_event_readers 1.0" in server.client.get("/metrics").text
        wait_until(lambda: server.app.state.core.events.readers.present == 0)
        with reading(url(server)):
            pass


def test_a_reader_that_takes_nothing_is_closed(tmp_path: Path) -> None:
    store = str(tmp_path / "events.db")
    with live_server(lambda settings: ScriptedDetector(), store_url=store, request_timeout_s=0.5) as server:
        new_id, text = IdMaker(), json.dumps({"padding": "." * 20_000})
        many = [EventRecord(new_id(), f"t-{k}", "start", "hall", k, text) for k in range(1000)]
        server.app.state.core.events.stored.events.add(many)
        readers = server.app.state.core.events.readers
        with socket.socket() as slow:
            slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            slow.connect(("127.0.0.1", server.port))
            head = f"GET /events/live HTTP/1.1\r\nHost: 127.0.0.1\r\nLast-Event-ID: {'0' * 32}\r\n\r\n"
            slow.sendall(head.encode())
            wait_until(lambda: readers.present == 1)
            wait_until(lambda: readers.present == 0, seconds=30)


def test_readers_end_at_once_when_the_service_stops() -> None:
    with serving_process(shutdown_timeout_s=20) as serving, reading(f"http://127.0.0.1:{serving.port}") as stream:
        serving.process.terminate()
        assert serving.process.wait(15) == 0
        assert stream.ended.wait(10)


@pytest.mark.parametrize("reason", ["stream_deleted", "stream_expired"])
def test_the_end_of_a_stream_ends_its_events(reason: str, tmp_path: Path) -> None:
    idle = 0.3 if reason == "stream_expired" else 60.0
    store = str(tmp_path / "events.db")
    with live_server(lambda settings: ScriptedDetector(), **QUICK, store_url=store, stream_idle_s=idle) as server:
        play(server.client, "hall", ONE_EVENT[:4])
        if reason == "stream_deleted":
            assert server.client.delete("/streams/hall").status_code == 204
        wait_until(lambda: len(listed(server)["events"]) == 2)
        end, start = listed(server)["events"]
        assert (end["kind"], end["reason"], end["thing_id"]) == ("end", reason, start["thing_id"])
        assert end["detection_id"] is None


def test_a_service_that_stops_ends_what_is_open(tmp_path: Path) -> None:
    store = str(tmp_path / "events.db")
    with live_server(lambda settings: ScriptedDetector(), **QUICK, store_url=store) as server:
        play(server.client, "hall", ONE_EVENT[:4])
    with live_server(lambda settings: ScriptedDetector(), **QUICK, store_url=store) as server:
        assert [(one["kind"], one["reason"]) for one in listed(server)["events"]] == [
            ("end", "service_stopped"),
            ("start", None),
        ]


def fail_once_behind_the_commit(server: LiveServer, monkeypatch: pytest.MonkeyPatch) -> None:
    store = server.app.state.core.keeper.store
    add: Callable[..., None] = store.add

    def add_and_fail(*given: Any) -> None:
        add(*given)
        monkeypatch.setattr(store, "add", add)
        raise store_error("store_unavailable")

    monkeypatch.setattr(store, "add", add_and_fail)


def test_a_call_that_is_sent_again_makes_no_event_twice(storing: LiveServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """The commit worked, but nobody was told: the client gets 503 and sends the frame again."""
    play(storing.client, "hall", ONE_EVENT[:2])
    fail_once_behind_the_commit(storing, monkeypatch)
    call = scripted_call(2, 0.9)
    assert storing.client.post("/streams/hall/frames", json=call).status_code == 503
    wait_until(lambda: storing.client.post("/streams/hall/frames", json=call).status_code == 200)
    play(storing.client, "hall", ONE_EVENT[3:], first=3)
    assert [one["kind"] for one in listed(storing, order="asc")["events"]] == KINDS


def test_a_start_that_nobody_came_to_know_of_is_ended_too(storing: LiveServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """The commit worked, nobody was told, and the client gave up."""
    play(storing.client, "hall", ONE_EVENT[:2])
    fail_once_behind_the_commit(storing, monkeypatch)
    assert storing.client.post("/streams/hall/frames", json=scripted_call(2, 0.9)).status_code == 503
    assert storing.client.delete("/streams/hall").status_code == 204
    wait_until(lambda: [one["kind"] for one in listed(storing)["events"]] == ["end", "start"])
    assert listed(storing)["events"][0]["reason"] == "stream_deleted"


def test_pages_filters_and_export_give_everything_once(storing: LiveServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("viflow_anomaly_service.events.endpoints.EXPORT_ROWS", 2)
    for name in ("hall", "door"):
        play(storing.client, name, ONE_EVENT)
    everything = listed(storing, order="asc")["events"]
    assert [one["kind"] for one in everything] == KINDS * 2
    for order, expected in (("asc", everything), ("desc", everything[::-1])):
        found, cursor = [], None
        while True:
            page = listed(storing, order=order, limit=4, **({"cursor": cursor} if cursor else {}))
            found += page["events"]
            if (cursor := page["next_cursor"]) is None:
                break
        assert found == expected
        export = storing.client.get("/events.ndjson", params={"order": order})
        assert [json.loads(line) for line in export.text.splitlines()] == expected
    assert listed(storing, stream="door", order="asc")["events"] == everything[3:]
    assert [one["kind"] for one in listed(storing, kind="end")["events"]] == ["end"] * 2
    middle = everything[1]["timestamp_ns"]
    later = [one for one in everything if one["timestamp_ns"] >= middle]
    assert listed(storing, from_ns=middle, order="asc")["events"] == later
    assert len(listed(storing, to_ns=middle)["events"]) == 6 - len(later)


@pytest.mark.parametrize(
    ("path", "code", "field"),
    [
        ("/events?kind=stop", "parameter_invalid", "kind"),
        ("/events?stream=a/b", "parameter_invalid", "stream"),
        ("/events?stream_id=a", "parameter_unknown", "stream_id"),
        ("/events?order=up", "parameter_invalid", "order"),
        ("/events?limit=0", "parameter_invalid", "limit"),
        ("/events?from_ns=5&to_ns=5", "parameter_invalid", "to_ns"),
        ("/events?cursor=x", "cursor_invalid", "cursor"),
        ("/events.ndjson?limit=5", "parameter_unknown", "limit"),
        ("/events/live?stream=", "parameter_invalid", "stream"),
        ("/events/live?kind=end", "parameter_unknown", "kind"),
        ("/events/deliveries?state=lost", "parameter_invalid", "state"),
        ("/events/deliveries?limit=1001", "parameter_invalid", "limit"),
    ],
)
def test_wrong_parameters_are_named(storing: LiveServer, path: str, code: str, field: str) -> None:
    assert_problem(storing.client.get(path), 422, code, field)


@pytest.mark.parametrize("text", ["17", "x" * 5000, "G" * 32])
def test_a_wrong_last_id_is_refused(storing: LiveServer, text: str) -> None:
    answer = storing.client.get("/events/live", headers={"Last-Event-ID": text})
    assert_problem(answer, 422, "parameter_invalid", "Last-Event-ID")


def test_an_empty_last_id_is_none(telling: LiveServer) -> None:
    play(telling.client, "before", ONE_EVENT)
    with reading(url(telling), last_event_id="") as stream:
        play(telling.client, "behind", ONE_EVENT)
        wait_until(lambda: len(stream.messages) == 3)
    assert {event["stream_id"] for _, _, event in stream.messages} == {"behind"}


def test_a_cursor_of_other_filters_is_refused(storing: LiveServer) -> None:
    play(storing.client, "hall", ONE_EVENT)
    cursor = listed(storing, limit=1)["next_cursor"]
    answer = storing.client.get("/events", params={"kind": "end", "cursor": cursor})
    assert_problem(answer, 422, "cursor_invalid", "cursor")


def test_without_a_store_only_live_reading_works(server: LiveServer) -> None:
    for method, path in (
        ("GET", "/events"),
        ("GET", "/events.ndjson"),
        ("GET", "/events/deliveries"),
        ("POST", f"/events/deliveries/{'0' * 32}.mqtt/retry"),
    ):
        assert_problem(server.client.request(method, path), 501, "store_not_configured", None)


def test_several_processes_without_a_store_have_no_events() -> None:
    with live_server(lambda settings: ScriptedDetector(), workers=2) as server:
        assert_problem(server.client.get("/events/live"), 501, "streams_need_one_process", None)


def test_a_store_that_is_not_open_yet_is_said(storing: LiveServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storing.app.state.core.keeper, "_failure", store_error("store_opening"))
    assert_problem(storing.client.get("/events/live"), 503, "store_opening", None)


def test_metrics_count_events(storing: LiveServer) -> None:
    play(storing.client, "hall", ONE_EVENT)
    text = storing.client.get("/metrics").text
    for kind in KINDS:
        assert f'viflow_events_total{{kind="{kind}"}} 1.0' in text


@pytest.mark.parametrize(
    ("settings", "code", "field"),
    [
        ({"webhook_urls": "http://a.example/x", "webhook_secret": "s"}, "event_store_missing", "store_url"),
        ({"mqtt_url": "mqtt://a.example"}, "event_store_missing", "store_url"),
        ({"webhook_urls": "http://a.example/x", "store_url": "x.db"}, "webhook_secret_missing", "webhook_secret"),
        (
            {"webhook_urls": "http://a.example/x", "store_url": "x.db", "webhook_secret": ""},
            "webhook_secret_missing",
            "webhook_secret",
        ),
        (
            {"webhook_urls": "http://a.example,ftp://tok@a", "store_url": "x.db", "webhook_secret": "s"},
            "webhook_url_invalid",
            "webhook_urls",
        ),
        (
            {"webhook_urls": "http:///tok", "store_url": "x.db", "webhook_secret": "s"},
            "webhook_url_invalid",
            "webhook_urls",
        ),
        ({"mqtt_url": "http://tok@a.example", "store_url": "x.db"}, "mqtt_url_invalid", "mqtt_url"),
        ({"mqtt_url": "mqtt://tok@a:99999", "store_url": "x.db"}, "mqtt_url_invalid", "mqtt_url"),
        ({"mqtt_url": "mqtt://tok@a/topic", "store_url": "x.db"}, "mqtt_url_invalid", "mqtt_url"),
        ({"mqtt_url": "mqtt://tok@a?x=1", "store_url": "x.db"}, "mqtt_url_invalid", "mqtt_url"),
        ({"mqtt_url": "tok", "store_url": "x.db"}, "mqtt_url_invalid", "mqtt_url"),
        (
            {"mqtt_url": "mqtts://a", "mqtt_ca_file": "/nowhere/ca.pem", "store_url": "x.db"},
            "mqtt_ca_invalid",
            "mqtt_ca_file",
        ),
        ({"event_start_score": 0.2, "event_end_score": 0.3}, "event_rules_invalid", "event_end_score"),
    ],
)
def test_settings_that_cannot_work_are_named(settings: dict[str, Any], code: str, field: str) -> None:
    with pytest.raises(ConfigError) as caught:
        create_app(ServiceSettings(**settings))
    assert (caught.value.code, caught.value.field) == (code, field)
    assert "tok" not in str(caught.value)


@pytest.mark.parametrize(
    ("settings", "module", "code"),
    [
        ({"webhook_urls": "http://a.example", "webhook_secret": "s"}, "webhook", "webhook_missing"),
        ({"mqtt_url": "mqtt://a.example"}, "mqtt", "mqtt_missing"),
    ],
)
def test_a_missing_extra_is_named(
    settings: dict[str, Any], module: str, code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, f"viflow_anomaly_service.events.{module}", None)
    with pytest.raises(MissingDependencyError, match=rf"pip install 'viflow-anomaly\[{module}\]'") as caught:
        create_app(ServiceSettings(store_url="x.db", **settings))
    assert caught.value.code == code
