"""What /metrics says after known requests."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from prometheus_client.parser import text_string_to_metric_families
from rule_detector import MODEL, RuleDetector
from service_world import LiveServer, form_request, imu_part, json_request, live_server, wait_until

from viflow_anomaly.detection import Detection, Reason
from viflow_anomaly.sensor_data import FramePair
from viflow_anomaly_service.metrics import ServiceMetrics, resident_bytes

Values = dict[tuple[str, tuple[str, ...]], float]


def scraped(server: LiveServer) -> Values:
    """Sample name and label values, in the order of the labels' names -> value."""
    response = server.client.get("/metrics")
    assert response.status_code == 200
    assert response.headers["content-type"].startswith("text/plain")
    return {
        (sample.name, tuple(sample.labels[name] for name in sorted(sample.labels))): sample.value
        for family in text_string_to_metric_families(response.text)
        for sample in family.samples
    }


class DoubtfulDetector(RuleDetector):
    """Every answer carries an IMU's fault and another doubt."""

    def detect(self, pair: FramePair, *, decode_ms: float = 0.0) -> Detection:
        found = super().detect(pair, decode_ms=decode_ms)
        reasons = (Reason("imu_gap", "a gap"), Reason("no_accelerometer", "none"), Reason("blur", "blurred"))
        return Detection(**{**vars(found), "reasons": reasons})


def test_requests_stages_detections_and_faults_are_counted() -> None:
    with live_server(lambda settings: DoubtfulDetector()) as server:
        answers = [server.post_json(json_request(seed=seed)) for seed in range(3)]
        answers.append(server.post_form(form_request()))
        unsorted = imu_part()
        unsorted["timestamps_ns"] = unsorted["timestamps_ns"][::-1]
        assert server.post_json(json_request(imu=unsorted)).json()["code"] == "imu_unsorted"
        server.client.get("/nowhere/1")
        server.client.request("BREW", "/nowhere/2")
        values = scraped(server)
    rois = [roi for answer in answers for roi in answer.json()["rois"]]
    assert rois
    for label in {roi["label"] for roi in rois}:
        assert values["viflow_regions_total", (label,)] == sum(roi["label"] == label for roi in rois)
    assert values["viflow_detections_total", ("default", "ok")] == 4
    assert values["viflow_requests_total", ("POST", "/detect", "200")] == 4
    assert values["viflow_requests_total", ("POST", "/detect", "422")] == 1
    assert values["viflow_requests_total", ("GET", "none", "404")] == 1
    assert values["viflow_requests_total", ("other", "none", "404")] == 1
    assert values["viflow_request_seconds_count", ("/detect",)] == 5
    stages = {
        stage: values["viflow_stage_seconds_count", (stage,)] for stage in ("upload", "queue", "decode", "detect")
    }
    assert stages == {"upload": 5, "queue": 5, "decode": 5, "detect": 4}
    assert values["viflow_stage_seconds_count", ("encode",)] == 4
    assert values["viflow_reasons_total", ("blur",)] == 4
    assert values["viflow_imu_faults_total", ("imu_gap",)] == 4
    assert values["viflow_imu_faults_total", ("no_accelerometer",)] == 4
    assert values["viflow_imu_faults_total", ("imu_unsorted",)] == 1
    assert ("viflow_imu_faults_total", ("blur",)) not in values
    assert values["viflow_problems_total", ("imu_unsorted",)] == 1
    assert values["viflow_model_info", (MODEL.name, "1.0", "default", MODEL.sha256, MODEL.version)] == 1
    assert values["viflow_ready_processes", ()] == 1
    assert values["viflow_resident_memory_bytes", ()] > 2**20
    assert values["process_open_fds", ()] > 0
    assert [
        values[name, ()] for name in ("viflow_queue_depth", "viflow_requests_in_flight", "viflow_workers_busy")
    ] == [
        0,
        0,
        0,
    ]


def test_the_line_and_the_refused_are_seen_while_it_lasts() -> None:
    may_go = threading.Event()
    detector = RuleDetector(may_go=may_go)
    with (
        live_server(lambda settings: detector, max_concurrent=1, max_queued=2, queue_timeout_s=0.5) as server,
        ThreadPoolExecutor(max_workers=3) as clients,
    ):
        try:
            first = clients.submit(server.post_json, json_request())
            wait_until(lambda: len(detector.calls) == 1)
            waiting = [clients.submit(server.post_json, json_request()) for _ in range(2)]
            wait_until(lambda: scraped(server)["viflow_queue_depth", ()] == 2)
            assert server.post_json(json_request()).status_code == 503
            values = scraped(server)
            assert values["viflow_requests_in_flight", ()] == 3
            assert values["viflow_workers_busy", ()] == values["viflow_workers", ()] == 1
            assert values["viflow_shed_requests_total", ("queue_full",)] == 1
            assert [late.result().status_code for late in waiting] == [503, 503]
            values = scraped(server)
            assert values["viflow_shed_requests_total", ("deadline",)] == 2
            assert values["viflow_queue_depth", ()] == 0
        finally:
            may_go.set()
        assert first.result().status_code == 200


def test_requests_before_the_model_is_there_are_counted() -> None:
    loaded = threading.Event()

    def slow_load(settings: object) -> RuleDetector:
        loaded.wait(20)
        return RuleDetector()

    with live_server(slow_load, ready=False) as server:
        server.post_json(json_request())
        values = scraped(server)
        loaded.set()
        assert values["viflow_shed_requests_total", ("not_ready",)] == 1
        assert values["viflow_ready_processes", ()] == 0


def test_openmetrics_where_the_client_accepts_it() -> None:
    content, media_type = ServiceMetrics().exposition("application/openmetrics-text; version=1.0.0")
    assert media_type.startswith("application/openmetrics-text")
    assert content.endswith(b"# EOF\n")


def test_memory_of_a_process_that_does_not_exist() -> None:
    assert resident_bytes(2**22 + 1) is None
    assert (resident_bytes() or 0) > 2**20


def test_a_system_without_proc_says_nothing_of_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("viflow_anomaly_service.metrics.resident_bytes", lambda: None)
    content, _ = ServiceMetrics().exposition("")
    assert b"\nviflow_resident_memory_bytes 0.0" in content
