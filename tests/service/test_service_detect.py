"""What a good request gets: the contract's answer, the same in both kinds, the same every time."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jsonschema
import numpy as np
import pytest
from rule_detector import RuleDetector
from service_world import (
    INTERVAL_NS,
    T0,
    LiveServer,
    camera_part,
    form_request,
    gray_image,
    imu_part,
    json_request,
    live_server,
)

from viflow_anomaly.config import DetectorConfig, RegionConfig
from viflow_anomaly.detection import load_detection_schema

CONFIG = DetectorConfig(regions=RegionConfig(max_regions=7))


@pytest.fixture(scope="module")
def detector() -> RuleDetector:
    return RuleDetector(config=CONFIG)


@pytest.fixture(scope="module")
def server(detector: RuleDetector) -> Iterator[LiveServer]:
    with live_server(lambda settings: detector) as running:
        yield running


def untimed(text: str) -> str:
    """The answer's bytes without ``timings_ms``, order of keys kept."""
    values = json.loads(text)
    assert set(values.pop("timings_ms")) == {"decode", "inference", "regions", "total"}
    return json.dumps(values)


def test_answer_is_the_contracts(server: LiveServer) -> None:
    response = server.post_json(json_request())
    assert response.status_code == 200
    assert response.headers["content-type"] == "application/json"
    answer = response.json()
    jsonschema.Draft202012Validator(load_detection_schema()).validate(answer)
    assert answer["source_timestamp_ns"] == T0
    assert answer["image"] == {"width": 96, "height": 64}
    assert answer["rois"]
    assert answer["timings_ms"]["decode"] > 0


def test_same_sample_same_bytes_in_both_kinds(server: LiveServer) -> None:
    options = {"options": {"include_masks": True}}
    form = form_request(request=(None, json.dumps(options)))
    texts = {untimed(server.post_json(json_request(**options)).text) for _ in range(3)}
    texts |= {untimed(server.post_form(form).text) for _ in range(3)}
    assert len(texts) == 1


def test_sixteen_clients_get_the_serial_answers(server: LiveServer) -> None:
    serial = [untimed(server.post_form(form_request(seed=seed)).text) for seed in range(16)]
    assert len(set(serial)) == 16
    with ThreadPoolExecutor(max_workers=16) as clients:
        for _ in range(2):
            together = list(clients.map(lambda seed: server.post_form(form_request(seed=seed)).text, range(16)))
            assert [untimed(text) for text in together] == serial


@pytest.mark.parametrize("kind", ["json", "form"])
def test_the_detector_gets_what_was_sent(server: LiveServer, detector: RuleDetector, kind: str) -> None:
    rest: dict[str, Any] = {"camera": camera_part() | {"time_offset_s": 0.01}}
    if kind == "json":
        assert server.post_json(json_request(**rest)).status_code == 200
    else:
        assert server.post_form(form_request(request=("r", json.dumps(rest)))).status_code == 200
    pair, config = detector.calls[-1]
    assert np.array_equal(pair.source.image, gray_image(seed=0))
    assert np.array_equal(pair.target.image, gray_image(seed=1))
    assert (pair.source.timestamp_ns, pair.target.timestamp_ns) == (T0, T0 + INTERVAL_NS)
    assert pair.imu.timestamps_ns.tolist() == imu_part()["timestamps_ns"]
    assert pair.imu.gyro_rad_s.tolist() == imu_part()["gyro_rad_s"]
    assert pair.imu.accel_m_s2 is not None
    assert pair.imu.accel_m_s2.tolist() == imu_part()["accel_m_s2"]
    assert pair.camera is not None
    assert (pair.camera.fx, pair.camera.time_offset_s) == (70.0, 0.01)
    assert config == CONFIG


def test_gyro_alone_reaches_the_detector(server: LiveServer, detector: RuleDetector) -> None:
    imu = imu_part()
    del imu["accel_m_s2"]
    assert server.post_json(json_request(imu=imu)).status_code == 200
    assert detector.calls[-1][0].imu.accel_m_s2 is None
    assert server.post_json(json_request(imu=imu | {"accel_m_s2": None})).status_code == 200


def test_null_members_mean_absent(server: LiveServer, detector: RuleDetector) -> None:
    response = server.post_json(json_request(camera=None, motor_command=None, options=None))
    assert response.status_code == 200
    assert detector.calls[-1][0].camera is None
    nothing = {"options": {"include_masks": None, "regions": None}}
    assert server.post_json(json_request(**nothing)).status_code == 200
    assert detector.calls[-1][1] == CONFIG


def test_options_hold_for_their_request_only(server: LiveServer, detector: RuleDetector) -> None:
    options = {"include_masks": True, "regions": {"threshold_mads": 9, "min_area_fraction": 0.001}}
    answer = server.post_json(json_request(options=options)).json()
    assert all("mask_rle" in roi for roi in answer["rois"])
    wanted = RegionConfig(max_regions=7, threshold_mads=9, min_area_fraction=0.001)
    assert detector.calls[-1][1] == DetectorConfig(regions=wanted, include_masks=True)
    answer = server.post_json(json_request()).json()
    assert not any("mask_rle" in roi for roi in answer["rois"])
    assert detector.calls[-1][1] == CONFIG


def test_options_change_the_answer(server: LiveServer) -> None:
    everything = server.post_json(json_request()).json()
    nothing = server.post_json(json_request(options={"regions": {"min_area_fraction": 1.0}})).json()
    assert everything["rois"]
    assert nothing["rois"] == []


def test_information(server: LiveServer) -> None:
    assert server.client.get("/healthz").json() == {"status": "ok"}
    assert server.client.get("/readyz").json() == {"status": "ready"}
    version = server.client.get("/version").json()
    assert version["schema_version"] == "1.0"
    assert version["model"] == {"name": "rule", "version": "1", "sha256": "ab" * 32}
    response = server.client.get("/schemas/detection-1.0.json")
    assert response.headers["content-type"] == "application/schema+json"
    assert response.json() == load_detection_schema()
