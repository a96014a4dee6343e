"""Webhooks and MQTT: signed, in order, again after failures, dead letters, and what Home Assistant reads."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import hmac
import json
import sqlite3
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from event_stream import play
from mosquitto_server import MosquittoServer, listening, mosquitto_server
from scripted_detector import ScriptedDetector
from service_world import LiveServer, assert_problem, live_server, wait_until
from test_events import KINDS, ONE_EVENT, QUICK
from webhook_receiver import WebhookReceiver, endless_receiver, webhook_receiver

from viflow_anomaly_service.events import courier, webhook
from viflow_anomaly_service.events.mqtt import Topics
from viflow_anomaly_service.events.mqtt_connection import MqttConnection

SECRET = "correct horse"  # noqa: S105 - of a test


@contextlib.contextmanager
def posting(receiver: WebhookReceiver, tmp_path: Path, **settings: Any) -> Iterator[LiveServer]:
    wanted = {"webhook_urls": receiver.url, "webhook_secret": SECRET, "store_url": str(tmp_path / "events.db")}
    with live_server(lambda settings: ScriptedDetector(), **{**QUICK, **wanted, **settings}) as running:
        yield running


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Attempts follow each other soon."""
    monkeypatch.setattr(courier, "FIRST_WAIT_SECONDS", 0.01)
    monkeypatch.setattr(courier, "LOOK_SECONDS", 0.05)


@pytest.fixture
def broker() -> Iterator[MosquittoServer]:
    with mosquitto_server() as running:
        yield running


def kinds(receiver: WebhookReceiver) -> list[str]:
    return [one["kind"] for one in receiver.taken()]


def deliveries(server: LiveServer, **parameters: Any) -> list[dict[str, Any]]:
    answer = server.client.get("/events/deliveries", params=parameters)
    assert answer.status_code == 200, answer.text
    return list(answer.json()["deliveries"])


def test_a_webhook_gets_every_event_signed_and_in_order(tmp_path: Path) -> None:
    with webhook_receiver() as receiver, posting(receiver, tmp_path) as server:
        play(server.client, "hall", ONE_EVENT)
        wait_until(lambda: len(receiver.received) == 3, seconds=30)
        listed = server.client.get("/events", params={"order": "asc"}).json()["events"]
        wait_until(lambda: [one["state"] for one in deliveries(server)] == ["delivered"] * 3)
    assert [one.event for one in receiver.received] == listed
    for one in receiver.received:
        stamp, _, digest = one.headers[webhook.SIGNATURE_HEADER].partition(",v1=")
        signed = stamp.removeprefix("t=").encode() + b"." + one.body
        assert digest == hmac.new(SECRET.encode(), signed, hashlib.sha256).hexdigest()
        assert abs(int(stamp.removeprefix("t=")) - time.time()) < 120
        assert one.headers[webhook.EVENT_ID_HEADER] == one.event["event_id"]
        assert one.headers["Content-Type"] == "application/json"


@pytest.mark.usefixtures("impatient")
def test_a_webhook_that_fails_is_tried_again_and_order_is_kept(tmp_path: Path) -> None:
    answers = iter([500, 302, 429, 404])
    with webhook_receiver(lambda event: next(answers, 200)) as receiver, posting(receiver, tmp_path) as server:
        play(server.client, "hall", ONE_EVENT)
        wait_until(lambda: len(receiver.taken()) == 3, seconds=30)
        wait_until(lambda: [one["attempts"] for one in deliveries(server)] == [5, 1, 1])
        text = server.client.get("/metrics").text
    assert kinds(receiver) == KINDS
    assert [one.answered for one in receiver.received] == [500, 302, 429, 404, 200, 200, 200]
    name = webhook.webhook_name(receiver.url)
    assert f'viflow_event_deliveries_total{{result="refused",sink="{name}"}} 4.0' in text
    assert f'viflow_event_deliveries_total{{result="delivered",sink="{name}"}} 3.0' in text


@pytest.mark.usefixtures("impatient")
def test_what_waits_for_a_clock_that_was_ahead_goes_on(tmp_path: Path) -> None:
    refusing = [True]
    with webhook_receiver(lambda event: 500 if refusing[0] else 200) as receiver:
        with posting(receiver, tmp_path) as server:
            play(server.client, "hall", ONE_EVENT)
            wait_until(lambda: deliveries(server)[0]["attempts"] > 0)
        refusing[0] = False
        with contextlib.closing(sqlite3.connect(tmp_path / "events.db")) as connection, connection:
            ahead_ns = time.time_ns() + 3600 * 10**9
            connection.execute("UPDATE event_deliveries SET next_attempt_ns = ?", (ahead_ns,))
            held = (webhook.webhook_name(receiver.url), "d" * 32, ahead_ns)
            connection.execute(
                "INSERT OR REPLACE INTO event_sinks (sink, holder, held_until_ns) VALUES (?, ?, ?)", held
            )
        with posting(receiver, tmp_path):
            wait_until(lambda: len(receiver.taken()) == 3, seconds=30)
    assert kinds(receiver) == KINDS


@pytest.mark.usefixtures("impatient")
def test_what_is_never_taken_becomes_a_dead_letter_and_can_be_sent_again(tmp_path: Path) -> None:
    refusing = [True]
    with (
        webhook_receiver(lambda event: 500 if refusing[0] and event["kind"] == "start" else 200) as receiver,
        posting(receiver, tmp_path, event_delivery_attempts=3) as server,
    ):
        play(server.client, "hall", ONE_EVENT)
        wait_until(lambda: len(receiver.taken()) == 2, seconds=30)
        (dead,) = deliveries(server, state="dead")
        assert (dead["attempts"], dead["last_error"], dead["event"]["kind"]) == (3, "answered 500", "start")
        assert "token" not in json.dumps(dead)
        wait_until(lambda: f'_dead{{sink="{dead["sink"]}"}} 1.0' in server.client.get("/metrics").text)
        document = server.client.get("/openapi.json").json()
        check_schema(document, "Delivery", dead)
        refusing[0] = False
        again = server.client.post(f"/events/deliveries/{dead['id']}/retry")
        assert (again.status_code, again.json()["state"]) == (200, "pending")
        wait_until(lambda: len(receiver.taken()) == 3, seconds=30)
        wait_until(lambda: deliveries(server, state="dead") == [])
        answer = server.client.post(f"/events/deliveries/{dead['id']}/retry")
        assert_problem(answer, 409, "delivery_not_dead", None)
    assert kinds(receiver) == ["update", "end", "start"]


def check_schema(document: dict[str, Any], name: str, value: Any) -> None:
    import jsonschema  # noqa: PLC0415

    schema = {"$ref": f"#/components/schemas/{name}", "components": document["components"]}
    jsonschema.Draft202012Validator(schema).validate(value)


def test_an_unknown_delivery_is_not_found(tmp_path: Path) -> None:
    with webhook_receiver() as receiver, posting(receiver, tmp_path) as server:
        for name in ("17", f"{'0' * 32}.mqtt", f"{'0' * 32}.webhook-{'0' * 12}", f"{'0' * 32}.fax"):
            answer = server.client.post(f"/events/deliveries/{name}/retry")
            assert_problem(answer, 404, "delivery_not_found", None)


def test_deliveries_come_in_pages_of_whole_events(tmp_path: Path) -> None:
    with (
        webhook_receiver() as one,
        webhook_receiver() as other,
        posting(one, tmp_path, webhook_urls=f"{one.url},{other.url}") as server,
    ):
        play(server.client, "hall", ONE_EVENT)
        wait_until(lambda: len(one.taken()) == len(other.taken()) == 3, seconds=30)
        page = server.client.get("/events/deliveries", params={"limit": 2}).json()
        assert len(page["deliveries"]) == 4
        rest = server.client.get("/events/deliveries", params={"limit": 2, "cursor": page["next_cursor"]}).json()
        assert (len(rest["deliveries"]), rest["next_cursor"]) == (2, None)
    assert len({delivery["id"] for delivery in page["deliveries"] + rest["deliveries"]}) == 6


@pytest.mark.usefixtures("impatient")
def test_a_receiver_that_does_not_answer_is_given_up_in_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhook, "ATTEMPT_SECONDS", 0.2)
    waited = []

    def answer_late(event: dict[str, Any]) -> int:
        waited.append(event)
        if len(waited) == 1:
            time.sleep(1)
        return 204

    with webhook_receiver(answer_late) as receiver, posting(receiver, tmp_path) as server:
        play(server.client, "hall", ONE_EVENT)
        wait_until(lambda: len(deliveries(server, state="delivered")) == 3, seconds=30)
        assert deliveries(server)[0]["attempts"] > 1
    assert kinds(receiver) == KINDS


def test_an_attempt_is_shorter_than_the_lease() -> None:
    assert courier.ATTEMPT_SECONDS < courier.SEND_SECONDS < courier.HOLD_SECONDS - courier.RENEW_SECONDS


@pytest.mark.usefixtures("impatient")
def test_an_event_that_takes_many_answers_is_given_up_in_time(
    broker: MosquittoServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first attempt hangs between two messages, though each of them would be in time."""
    published, publish = [], MqttConnection.publish

    async def publish_slowly(connection: MqttConnection, topic: str, payload: str, *, retain: bool) -> None:
        published.append(topic)
        if published.count("viflow/hall/events") == 1:
            await asyncio.sleep(0.2)
        await publish(connection, topic, payload, retain=retain)

    monkeypatch.setattr(courier, "SEND_SECONDS", 0.3)
    monkeypatch.setattr(MqttConnection, "publish", publish_slowly)
    address = {"store_url": str(tmp_path / "events.db"), "mqtt_url": broker.url}
    with live_server(lambda settings: ScriptedDetector(), **QUICK, **address, event_delivery_attempts=100) as server:
        play(server.client, "hall", ONE_EVENT)
        wait_until(lambda: len(deliveries(server, state="delivered")) == 3, seconds=30)
        found = deliveries(server)[0]
    assert found["attempts"] > 1
    assert found["last_error"] is None
    assert published.count("viflow/hall/events") > 3


@pytest.mark.usefixtures("impatient")
def test_replicas_deliver_once(empty_store_url: str) -> None:
    with webhook_receiver() as receiver:
        shared = {"webhook_urls": receiver.url, "webhook_secret": SECRET, "store_url": empty_store_url}
        with (
            live_server(lambda settings: ScriptedDetector(), **QUICK, **shared) as one,
            live_server(lambda settings: ScriptedDetector(), **QUICK, **shared) as other,
        ):
            for server, name in ((one, "hall"), (other, "door"), (one, "yard")):
                play(server.client, name, ONE_EVENT)
            wait_until(lambda: len(receiver.received) >= 9, seconds=30)
            wait_until(lambda: len(deliveries(one, state="delivered")) == 9)
            listed = other.client.get("/events", params={"order": "asc"}).json()["events"]
    assert [received.event for received in receiver.received] == listed


@pytest.mark.usefixtures("impatient")
def test_another_process_takes_over_when_one_stops(empty_store_url: str) -> None:
    with webhook_receiver() as receiver:
        shared = {"webhook_urls": receiver.url, "webhook_secret": SECRET, "store_url": empty_store_url}
        with live_server(lambda settings: ScriptedDetector(), **QUICK, **shared) as other:
            with live_server(lambda settings: ScriptedDetector(), **QUICK, **shared) as one:
                play(one.client, "hall", ONE_EVENT)
                wait_until(lambda: len(receiver.received) == 3, seconds=30)
            play(other.client, "door", ONE_EVENT)
            wait_until(lambda: len(receiver.received) == 6, seconds=30)


@pytest.mark.parametrize("user", ["", "tester:secret@"])
def test_mqtt_tells_events_and_states(broker: MosquittoServer, tmp_path: Path, user: str) -> None:
    address = f"mqtt://{user}127.0.0.1:{broker.port}"
    store = str(tmp_path / "events.db")
    with listening(broker) as heard:
        with live_server(lambda settings: ScriptedDetector(), **QUICK, store_url=store, mqtt_url=address) as server:
            wait_until(lambda: heard.retained.get("viflow/availability") == "online", seconds=30)
            play(server.client, "hall", ONE_EVENT)
            wait_until(lambda: heard.of("viflow/hall/motion") == ["ON", "OFF"], seconds=30)
            listed = server.client.get("/events", params={"order": "asc"}).json()["events"]
            assert [json.loads(one) for one in heard.of("viflow/hall/events")] == listed
        wait_until(lambda: heard.retained["viflow/availability"] == "offline")
    with listening(broker, name="newcomer") as late:  # what Home Assistant is told when it starts
        wait_until(lambda: len(late.retained) == 3, seconds=30)
        assert late.messages == []
    topic, config = Topics("viflow", "homeassistant", "").sensor("hall")
    found = json.loads(late.retained[topic])
    assert found | {"origin": config["origin"]} == config
    assert (late.retained["viflow/hall/motion"], late.retained["viflow/availability"]) == ("OFF", "offline")


def test_names_of_sensors_are_safe_and_never_the_same() -> None:
    streams = ["a.b", "a_b", "a-b", "a_2eb", "A.b"]
    topics = [Topics("viflow", "homeassistant", "1").sensor(stream)[0] for stream in streams]
    assert len(set(topics)) == len(streams)
    for topic in topics:
        assert topic.split("/")[2].replace("_", "").replace("-", "").isalnum()


@pytest.mark.usefixtures("impatient")
def test_a_broker_that_forgot_everything_is_told_again(broker: MosquittoServer, tmp_path: Path) -> None:
    store = str(tmp_path / "events.db")
    with live_server(lambda settings: ScriptedDetector(), **QUICK, store_url=store, mqtt_url=broker.url) as server:
        play(server.client, "hall", ONE_EVENT[:4])
        wait_until(lambda: len(deliveries(server, state="delivered")) == 1, seconds=30)
        broker.stop()
        for kept in broker.folder.glob("*.db"):
            kept.unlink()
        play(server.client, "door", ONE_EVENT)  # nobody is there to be told
        broker.start()
        with listening(broker) as heard:
            wait_until(lambda: heard.retained.get("viflow/door/motion") == "OFF", seconds=30)
            wait_until(lambda: len(deliveries(server, state="delivered")) == 4, seconds=30)
            assert heard.retained["viflow/hall/motion"] == "ON"
            assert heard.retained["viflow/availability"] == "online"


@pytest.mark.usefixtures("impatient")
def test_what_the_broker_refuses_is_not_delivered(tmp_path: Path) -> None:
    acl = "topic write viflow/availability\ntopic write viflow/+/motion\ntopic read #\n"
    store = str(tmp_path / "events.db")
    with (
        mosquitto_server(acl=acl) as broker,
        live_server(
            lambda settings: ScriptedDetector(),
            **QUICK,
            store_url=store,
            mqtt_url=f"mqtt://127.0.0.1:{broker.port}",
            event_delivery_attempts=2,
        ) as server,
    ):
        play(server.client, "hall", ONE_EVENT)
        wait_until(lambda: len(deliveries(server, state="dead")) == 3, seconds=30)
        assert "Not authorized" in deliveries(server)[0]["last_error"]


@pytest.mark.usefixtures("impatient")
def test_an_event_at_which_the_broker_hangs_up_does_not_hold_up_the_others_for_ever(tmp_path: Path) -> None:
    with (
        mosquitto_server(options=("max_packet_size 400",)) as broker,
        live_server(
            lambda settings: ScriptedDetector(),
            **QUICK,
            store_url=str(tmp_path / "events.db"),
            mqtt_url=f"mqtt://127.0.0.1:{broker.port}",
            event_delivery_attempts=2,
        ) as server,
    ):
        play(server.client, "hall", ONE_EVENT)
        wait_until(lambda: len(deliveries(server, state="dead")) == 3, seconds=60)


@pytest.mark.usefixtures("impatient")
def test_home_assistant_may_be_refused(tmp_path: Path) -> None:
    store = str(tmp_path / "events.db")
    with mosquitto_server(acl="topic write viflow/+/events\ntopic read #\n") as broker:
        address = {"store_url": store, "mqtt_url": f"mqtt://127.0.0.1:{broker.port}"}
        with live_server(lambda settings: ScriptedDetector(), **QUICK, **address) as server:
            play(server.client, "hall", ONE_EVENT)
            wait_until(lambda: len(deliveries(server, state="delivered")) == 3, seconds=30)


@pytest.mark.usefixtures("impatient")
def test_a_broker_that_is_not_there_costs_no_attempt(tmp_path: Path) -> None:
    store = str(tmp_path / "events.db")
    address = {"store_url": store, "mqtt_url": "mqtt://127.0.0.1:1"}
    with live_server(lambda settings: ScriptedDetector(), **QUICK, **address, event_delivery_attempts=1) as server:
        play(server.client, "hall", ONE_EVENT)
        text = 'viflow_event_deliveries_total{result="unreachable",sink="mqtt"}'
        wait_until(lambda: text in server.client.get("/metrics").text, seconds=30)
        assert [(one["state"], one["attempts"]) for one in deliveries(server)] == [("pending", 0)] * 3


def test_a_service_that_stops_tells_of_the_end(broker: MosquittoServer, tmp_path: Path) -> None:
    with webhook_receiver() as receiver, listening(broker) as heard:
        with posting(receiver, tmp_path, mqtt_url=broker.url) as server:
            play(server.client, "hall", ONE_EVENT[:4])
            wait_until(lambda: len(receiver.taken()) == 1 and heard.of("viflow/hall/motion")[-1:] == ["ON"], seconds=30)
        assert [one["reason"] for one in receiver.taken()] == [None, "service_stopped"]
        wait_until(lambda: heard.retained["viflow/availability"] == "offline")
        assert heard.of("viflow/hall/motion")[-2:] == ["ON", "OFF"]


@pytest.mark.usefixtures("impatient")
def test_a_long_answer_is_not_read_to_its_end(tmp_path: Path) -> None:
    """A receiver that answers without end has taken the event all the same."""
    with (
        endless_receiver() as address,
        live_server(
            lambda settings: ScriptedDetector(),
            **QUICK,
            store_url=str(tmp_path / "events.db"),
            webhook_urls=address,
            webhook_secret=SECRET,
        ) as server,
    ):
        play(server.client, "hall", ONE_EVENT)
        wait_until(lambda: len(deliveries(server, state="delivered")) == 3, seconds=30)
