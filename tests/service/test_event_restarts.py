"""Kills and restarts of the service, the broker and the receiver: no event is lost, none is there twice."""

from __future__ import annotations

import json
from collections import defaultdict
from typing import Any

import httpx
from event_stream import play, reading
from mosquitto_server import listening, mosquitto_server
from service_world import wait_until
from serving_process import ServingProcess, serving_process
from test_events import ONE_EVENT, QUICK
from webhook_receiver import webhook_receiver

SOON = """
from scripted_detector import ScriptedDetector as RuleDetector
from viflow_anomaly_service.events import abandoned, courier
abandoned.HOLD_SECONDS, abandoned.BEAT_SECONDS = 3.0, 0.5
courier.HOLD_SECONDS, courier.LOOK_SECONDS = 3.0, 0.1
courier.SEND_SECONDS, courier.RENEW_SECONDS = 2.0, 0.5
"""
"""A process is taken for dead soon, so that the test does not take for ever."""


def wait_ready(client: httpx.Client) -> None:
    wait_until(lambda: client.get("/readyz").status_code == 200, seconds=30)


def everything(client: httpx.Client) -> list[dict[str, Any]]:
    export = client.get("/events.ndjson", params={"order": "asc"})
    return [json.loads(line) for line in export.text.splitlines()]


def require_whole(events: list[dict[str, Any]]) -> None:
    """Every thing begins once and ends once, with nothing before and nothing behind."""
    by_thing = defaultdict(list)
    for one in events:
        by_thing[one["thing_id"]].append(one["kind"])
    for kinds in by_thing.values():
        assert (kinds[0], kinds[-1]) == ("start", "end"), kinds
        assert set(kinds[1:-1]) <= {"update"}, kinds
    keys = [(one["thing_id"], one["kind"], one["timestamp_ns"]) for one in events]
    assert len(set(keys)) == len(keys)


def kill(serving: ServingProcess) -> None:
    serving.process.kill()
    serving.process.wait(30)


def test_nothing_is_lost_and_nothing_comes_twice_over_kills_and_restarts(empty_store_url: str) -> None:
    with mosquitto_server() as broker, webhook_receiver() as receiver, listening(broker) as heard:
        settings: dict[str, Any] = {
            **QUICK,
            "setup": SOON,
            "store_url": empty_store_url,
            "webhook_urls": receiver.url,
            "webhook_secret": "s",
            "mqtt_url": broker.url,
        }
        for number, gone in enumerate([None, receiver, broker, None]):
            with serving_process(**settings) as serving, serving.client() as client:
                wait_ready(client)
                play(client, f"whole{number}", ONE_EVENT)
                if gone is not None:
                    gone.stop()
                play(client, f"late{number}", ONE_EVENT)
                play(client, f"open{number}", ONE_EVENT[:4])
                kill(serving)
            if gone is not None:
                gone.start()
        with serving_process(**settings) as serving, serving.client() as client:
            wait_ready(client)
            wait_until(lambda: len([one for one in everything(client) if one["kind"] == "end"]) == 12, seconds=60)
            pending = {"state": "pending"}
            wait_until(lambda: client.get("/events/deliveries", params=pending).json()["deliveries"] == [], seconds=60)
            events = everything(client)
            wait_until(lambda: all(heard.of(f"viflow/open{k}/motion")[-1:] == ["OFF"] for k in range(4)), seconds=30)
        wait_until(lambda: heard.retained["viflow/availability"] == "offline", seconds=30)
    require_whole(events)
    reasons = [one["reason"] for one in events if one["stream_id"].startswith("open") and one["kind"] == "end"]
    assert reasons == ["service_restarted"] * 4
    assert receiver.taken() == events
    for name in {one["stream_id"] for one in events}:
        told = [json.loads(payload) for payload in heard.of(f"viflow/{name}/events")]
        once = list({one["event_id"]: one for one in told}.values())
        assert once == [one for one in events if one["stream_id"] == name]


def test_a_live_reader_goes_on_behind_a_kill(empty_store_url: str) -> None:
    settings: dict[str, Any] = {**QUICK, "setup": SOON, "store_url": empty_store_url}
    with serving_process(**settings) as serving, serving.client() as client:
        wait_ready(client)
        with reading(f"http://127.0.0.1:{serving.port}") as first:
            play(client, "hall", ONE_EVENT[:4])
            wait_until(lambda: len(first.messages) == 1)
            kill(serving)
            assert first.ended.wait(10)
    with serving_process(**settings) as serving, serving.client() as client:
        wait_ready(client)
        play(client, "door", ONE_EVENT)
        with reading(f"http://127.0.0.1:{serving.port}", last_event_id=first.ids[-1]) as second:
            wait_until(lambda: len(second.messages) == 4, seconds=30)
            events = everything(client)
    assert [*first.ids, *second.ids] == [one["event_id"] for one in events]
    require_whole(events)
