"""Detections that stay, seen from outside: through a live service, through failures, and through a kill."""

from __future__ import annotations

import json
import os
import resource
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
from postgres_server import PostgresServer
from rule_detector import RuleDetector
from service_world import (
    INTERVAL_NS,
    T0,
    LiveServer,
    assert_problem,
    base64_text,
    gray_image,
    imu_part,
    json_request,
    live_server,
    png,
    wait_until,
)
from serving_process import ServingProcess, serving_process

from viflow_anomaly.errors import MissingDependencyError
from viflow_anomaly_service.app import create_app
from viflow_anomaly_service.paging import Page
from viflow_anomaly_service.settings import ServiceSettings
from viflow_anomaly_service.store import keeper as keeper_module
from viflow_anomaly_service.store.detection_store import DetectionStore
from viflow_anomaly_service.store.failures import store_error


@pytest.fixture
def storing(empty_store_url: str) -> Iterator[LiveServer]:
    with live_server(lambda settings: RuleDetector(), store_url=empty_store_url) as running:
        yield running


def listed(server: LiveServer, **parameters: Any) -> dict[str, Any]:
    answer = server.client.get("/detections", params=parameters)
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def test_an_answer_can_be_read_again(storing: LiveServer) -> None:
    answers = [storing.post_json(json_request(seed=seed)) for seed in range(5)]
    ids = [answer.headers["x-detection-id"] for answer in answers]
    page = listed(storing)
    assert [one["id"] for one in page["detections"]] == ids[::-1]
    assert page["next_cursor"] is None
    assert [one["detection"] for one in page["detections"]] == [answer.json() for answer in answers[::-1]]
    one = storing.client.get(f"/detections/{ids[2]}").json()
    assert one == page["detections"][2]
    assert (one["stream_id"], one["session_id"]) == (None, None)


def test_replicas_share_a_store(empty_store_url: str) -> None:
    with (
        live_server(lambda settings: RuleDetector(), store_url=empty_store_url) as one,
        live_server(lambda settings: RuleDetector(), store_url=empty_store_url) as other,
    ):
        ids = [server.post_json(json_request()).headers["x-detection-id"] for server in (one, other) * 3]
        for server in (one, other):
            assert {found["id"] for found in listed(server)["detections"]} == set(ids)


def test_pages_and_export_give_everything_once(storing: LiveServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("viflow_anomaly_service.store.endpoints.EXPORT_ROWS", 3)
    ids = [storing.post_json(json_request(seed=seed)).headers["x-detection-id"] for seed in range(7)]
    found, cursor = [], None
    while True:
        page = listed(storing, limit=3, **({"cursor": cursor} if cursor else {}))
        found += [one["id"] for one in page["detections"]]
        if (cursor := page["next_cursor"]) is None:
            break
    assert found == ids[::-1]
    export = storing.client.get("/detections.ndjson", params={"order": "asc"})
    assert export.headers["content-type"] == "application/x-ndjson"
    assert [json.loads(line)["id"] for line in export.text.splitlines()] == ids


def test_filters_choose_by_what_the_answers_say(storing: LiveServer) -> None:
    answers = [storing.post_json(json_request(seed=seed)) for seed in range(6)]
    tops = {
        answer.headers["x-detection-id"]: max((roi["score"] for roi in answer.json()["rois"]), default=-1.0)
        for answer in answers
    }
    middle = sorted(tops.values())[3]
    found = {one["id"] for one in listed(storing, min_score=middle)["detections"]}
    assert found == {one for one, score in tops.items() if score >= middle}
    assert 0 < len(found) < 6 or len(set(tops.values())) == 1
    assert len(listed(storing, from_ns=T0, to_ns=T0 + 1)["detections"]) == 6
    assert listed(storing, to_ns=T0)["detections"] == []
    assert listed(storing, stream="drone-7")["detections"] == []
    empty = storing.client.get("/detections.ndjson", params={"stream": "drone-7"})
    assert (empty.status_code, empty.text) == (200, "")


@pytest.mark.parametrize(
    ("query", "code", "field"),
    [
        ("limit=0", "parameter_invalid", "limit"),
        ("limit=1001", "parameter_invalid", "limit"),
        ("limit=ten", "parameter_invalid", "limit"),
        ("limit=5&limit=6", "parameter_invalid", "limit"),
        ("limit=%F0%9D%9F%97", "parameter_invalid", "limit"),
        ("from_ns=99999999999999999999", "parameter_invalid", "from_ns"),
        ("from_ns=5&to_ns=5", "parameter_invalid", "to_ns"),
        ("label=cat", "parameter_invalid", "label"),
        ("min_score=1.5", "parameter_invalid", "min_score"),
        ("min_score=nan", "parameter_invalid", "min_score"),
        ("stream=a/b", "parameter_invalid", "stream"),
        ("order=up", "parameter_invalid", "order"),
        ("colour=red", "parameter_unknown", "colour"),
        ("cursor=x", "cursor_invalid", "cursor"),
        ("cursor=W10", "cursor_invalid", "cursor"),
        ("cursor=" + "A" * 5000, "cursor_invalid", "cursor"),
        ("cursor=%00%FF", "cursor_invalid", "cursor"),
    ],
)
def test_wrong_parameters_are_named(no_store_needed: LiveServer, query: str, code: str, field: str) -> None:
    assert_problem(no_store_needed.client.get(f"/detections?{query}"), 422, code, field)


@pytest.fixture(scope="module")
def no_store_needed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveServer]:
    path = tmp_path_factory.mktemp("store") / "x.db"
    with live_server(lambda settings: RuleDetector(), store_url=str(path)) as running:
        yield running


def test_a_cursor_belongs_to_its_filters(no_store_needed: LiveServer) -> None:
    for seed in range(3):
        no_store_needed.post_json(json_request(seed=seed))
    cursor = listed(no_store_needed, limit=1)["next_cursor"]
    listed(no_store_needed, limit=2, cursor=cursor)
    answer = no_store_needed.client.get("/detections", params={"cursor": cursor, "order": "asc"})
    assert_problem(answer, 422, "cursor_invalid", "cursor")


@pytest.mark.parametrize("name", ["0" * 32, "17", "F" * 32, "%00", "a" * 300])
def test_an_id_that_is_not_stored(no_store_needed: LiveServer, name: str) -> None:
    assert_problem(no_store_needed.client.get(f"/detections/{name}"), 404, "detection_not_found", None)


def test_without_a_store_the_service_says_so(server: LiveServer) -> None:
    assert "x-detection-id" not in server.post_json(json_request()).headers
    for path in ("/detections", "/detections.ndjson", "/detections/" + "0" * 32):
        assert_problem(server.client.get(path), 501, "store_not_configured", None)


def test_without_the_packages_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("sqlalchemy", "viflow_anomaly_service.store.detection_store", "viflow_anomaly_service.store.keeper"):
        monkeypatch.setitem(sys.modules, name, None)
    create_app(ServiceSettings())
    with pytest.raises(MissingDependencyError, match=r"viflow-anomaly\[store\]"):
        create_app(ServiceSettings(store_url=str(tmp_path / "x.db")))


def test_an_export_that_breaks_off_is_no_whole_answer(
    no_store_needed: LiveServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("viflow_anomaly_service.store.endpoints.EXPORT_ROWS", 1)
    for seed in range(3):
        no_store_needed.post_json(json_request(seed=seed))
    whole, read = DetectionStore.page, [0]

    def page(self: DetectionStore, request: Page[Any]) -> Any:
        read[0] += 1
        if read[0] == 2:
            raise store_error("store_unavailable")
        return whole(self, request)

    monkeypatch.setattr(DetectionStore, "page", page)
    with pytest.raises(httpx.RemoteProtocolError):
        no_store_needed.client.get("/detections.ndjson")
    assert no_store_needed.client.get("/detections.ndjson").status_code == 200


def test_metrics_count_what_is_stored(storing: LiveServer) -> None:
    storing.post_json(json_request())
    text = storing.client.get("/metrics").text
    assert "viflow_stored_detections_total 1.0" in text
    assert "viflow_store_usable_processes 1.0" in text


def test_retention_works_in_the_background(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keeper_module, "PRUNE_SECONDS", 0.05)
    with live_server(lambda settings: RuleDetector(), store_url=str(tmp_path / "x.db"), store_max_age_s=0.5) as server:
        assert server.post_json(json_request()).status_code == 200
        assert len(listed(server)["detections"]) == 1
        wait_until(lambda: listed(server)["detections"] == [])


def is_ready(client: httpx.Client) -> bool:
    return client.get("/readyz").status_code == 200


def test_a_database_that_goes_and_comes_back(postgres: PostgresServer) -> None:
    with live_server(lambda settings: RuleDetector(), store_url=postgres.new_database()) as server:
        kept = server.post_json(json_request()).headers["x-detection-id"]
        postgres.stop()
        try:
            assert_problem(server.post_json(json_request()), 503, "store_unavailable", None)
            refused = server.client.get("/readyz")
            assert_problem(refused, 503, "store_unavailable", None)
            assert int(refused.headers["retry-after"]) > 0
            assert_problem(server.client.get(f"/detections/{kept}"), 503, "store_unavailable", None)
            assert server.client.get("/healthz").status_code == 200
        finally:
            postgres.start()
        wait_until(lambda: is_ready(server.client), seconds=20)
        assert server.client.get(f"/detections/{kept}").status_code == 200
        assert server.post_json(json_request()).status_code == 200


def test_a_database_that_is_only_read_for_a_while(postgres: PostgresServer) -> None:
    def read_only(word: str) -> None:
        postgres.execute(f"ALTER SYSTEM SET default_transaction_read_only = {word}")
        postgres.execute("SELECT pg_reload_conf()")

    with live_server(lambda settings: RuleDetector(), store_url=postgres.new_database()) as server:
        kept = server.post_json(json_request()).headers["x-detection-id"]
        read_only("on")
        try:
            wait_until(lambda: server.post_json(json_request()).status_code == 503)
            assert_problem(server.client.get("/readyz"), 503, "store_read_only", None)
            assert server.client.get(f"/detections/{kept}").status_code == 200
        finally:
            read_only("off")
        wait_until(lambda: is_ready(server.client), seconds=20)
        assert server.post_json(json_request()).status_code == 200


def test_a_service_that_starts_before_its_database(tmp_path: Path) -> None:
    path = tmp_path / "later" / "x.db"
    with live_server(lambda settings: RuleDetector(), ready=False, store_url=str(path)) as server:
        wait_until(lambda: server.client.get("/readyz").json().get("code") == "store_unavailable")
        assert_problem(server.post_json(json_request()), 503, "store_unavailable", None)
        path.parent.mkdir()
        wait_until(lambda: is_ready(server.client), seconds=20)
        assert server.post_json(json_request()).status_code == 200


def test_a_full_disk_is_said_and_space_is_enough_to_go_on(tmp_path: Path) -> None:
    """A limit on the size of files stands for the disk; it is lifted while the service runs."""
    with serving_process(store_url=str(tmp_path / "x.db")) as serving, serving.client() as client:
        wait_until(lambda: is_ready(client))
        kept = client.post("/detect", json=json_request()).headers["x-detection-id"]
        pid = serving.process.pid
        unlimited = resource.prlimit(pid, resource.RLIMIT_FSIZE)
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (8192, unlimited[1]))
        answer = client.post("/detect", json=json_request())
        assert_problem(answer, 503, "store_full", None)
        assert_problem(client.get("/readyz"), 503, "store_full", None)
        assert client.get(f"/detections/{kept}").status_code == 200
        resource.prlimit(pid, resource.RLIMIT_FSIZE, unlimited)
        wait_until(lambda: is_ready(client), seconds=20)
        assert client.post("/detect", json=json_request()).status_code == 200
        assert len(client.get("/detections").json()["detections"]) == 2
        failed = serving.events("store_failed")
        assert failed
        assert failed[0]["code"] == "store_full"


def post_until_killed(serving: ServingProcess, acknowledged: dict[str, Any], enough: threading.Event) -> None:
    """Until there is no answer any more; notes every answer that came."""
    request = {
        "source": {"timestamp_ns": T0, "image_base64": base64_text(png(gray_image(seed=1)))},
        "target": {"timestamp_ns": T0 + INTERVAL_NS, "image_base64": base64_text(png(gray_image(seed=2)))},
        "imu": imu_part(),
    }
    with serving.client() as client:
        while True:
            try:
                answer = client.post("/detect", json=request)
            except httpx.TransportError:
                return
            if answer.status_code == 200:
                acknowledged[answer.headers["x-detection-id"]] = answer.json()
            if len(acknowledged) >= 40:
                enough.set()


@pytest.mark.parametrize("workers", [1, 2])
def test_a_kill_loses_nothing_that_was_answered(empty_store_url: str, workers: int) -> None:
    acknowledged: dict[str, Any] = {}
    enough = threading.Event()
    with (
        serving_process(store_url=empty_store_url, max_concurrent=2, workers=workers) as serving,
        ThreadPoolExecutor(4) as clients,
    ):
        with serving.client() as client:
            wait_until(lambda: is_ready(client), seconds=20)
        running = [clients.submit(post_until_killed, serving, acknowledged, enough) for _ in range(4)]
        assert enough.wait(60)
        for pid in [*(record["worker"] for record in serving.events("worker_started")), serving.process.pid]:
            os.kill(pid, 9)
        for one in running:
            one.result()
    assert len(acknowledged) >= 40
    with serving_process(store_url=empty_store_url) as again, again.client() as client:
        wait_until(lambda: is_ready(client), seconds=20)
        export = client.get("/detections.ndjson")
        stored = {one["id"]: one["detection"] for one in map(json.loads, export.text.splitlines())}
        assert acknowledged.items() <= stored.items()
