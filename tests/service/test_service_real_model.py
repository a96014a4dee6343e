"""End to end with the bundled model: the service answers what the library answers, and refuses what it refuses."""

from __future__ import annotations

import json
import os
import pickle
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import httpx
import jsonschema
import numpy as np
import pytest
from service_world import INTERVAL_NS, T0, LiveServer, assert_problem, base64_text, imu_part, live_server, png

from viflow_anomaly.alarm_calibration import make_calibration, write_calibration
from viflow_anomaly.alarm_footage import JudgedPair, WatchedRecording, footage_of
from viflow_anomaly.batch_job import BatchOptions, run_batch
from viflow_anomaly.config import DetectorConfig
from viflow_anomaly.datasets.camera_json import camera_from_mapping
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.detection import load_detection_schema, to_json_dict
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples
from viflow_anomaly_service.detector_loading import load_bundled_or_configured
from viflow_anomaly_service.examples import example_json_request
from viflow_anomaly_service.settings import load_settings

ROOT = Path(__file__).parents[2]
WIDTH, HEIGHT = 240, 160
CAMERA = {"fx": 180.0, "fy": 180.0, "cx": 119.5, "cy": 79.5, "width": WIDTH, "height": HEIGHT}
MOUNTED = CAMERA | {"T_cam_imu": [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]}


@pytest.fixture(scope="module")
def server() -> Iterator[LiveServer]:
    with live_server(load_bundled_or_configured) as running:
        yield running


def frames(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """[H, W] uint8 twice: a textured scene that stands still and a square that jumps."""
    noise = np.random.default_rng(seed).standard_normal((HEIGHT, WIDTH)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 3.0)
    scene = np.clip(128 + 300 * smooth, 0, 255).astype(np.uint8)
    source, target = scene.copy(), scene.copy()
    source[60:100, 80:120] = 250
    target[60:100, 92:132] = 250
    return source, target


def resting_imu(**changes: Any) -> dict[str, Any]:
    imu = imu_part()
    count = len(imu["timestamps_ns"])
    return imu | {"gyro_rad_s": [[0.0] * 3] * count, "accel_m_s2": [[0.0, 0.0, 9.81]] * count} | changes


def request_of(seed: int = 0, **changes: Any) -> dict[str, Any]:
    source, target = frames(seed)
    return {
        "source": {"timestamp_ns": T0, "image_base64": base64_text(png(source))},
        "target": {"timestamp_ns": T0 + INTERVAL_NS, "image_base64": base64_text(png(target))},
        "imu": resting_imu(),
        "camera": MOUNTED,
        "options": {"include_masks": True},
    } | changes


def untimed(response: httpx.Response) -> str:
    assert response.status_code == 200, response.text
    answer = response.json()
    del answer["timings_ms"]
    return json.dumps(answer)


def test_the_service_answers_what_the_library_answers(server: LiveServer) -> None:
    source, target = frames()
    imu = resting_imu()
    pair = FramePair(
        Frame(T0, source),
        Frame(T0 + INTERVAL_NS, target),
        ImuSamples(**{name: np.asarray(rows) for name, rows in imu.items()}),
        camera_from_mapping(MOUNTED),
    )
    detector = AnomalyDetector.from_checkpoint()
    wanted = to_json_dict(detector.with_config(detector.config.model_copy(update={"include_masks": True})).detect(pair))
    jsonschema.Draft202012Validator(load_detection_schema()).validate(wanted)
    del wanted["timings_ms"]
    assert untimed(server.post_json(request_of())) == json.dumps(wanted)
    assert wanted["rois"], "a square that jumps by twelve pixels over a scene at rest is found"
    version = server.client.get("/version").json()
    assert version["model"] == wanted["model"]


def test_both_kinds_and_many_clients_get_the_same_bytes(server: LiveServer) -> None:
    serial = [untimed(server.post_json(request_of(seed))) for seed in range(4)]

    def as_form(seed: int) -> str:
        request = request_of(seed)
        source, target = frames(seed)
        stamps = {"source_timestamp_ns": T0, "target_timestamp_ns": T0 + INTERVAL_NS}
        rest = {name: request[name] for name in ("camera", "options")}
        files = {
            "source": ("s.png", png(source), "image/png"),
            "target": ("t.png", png(target), "image/png"),
            "imu": (None, json.dumps(request["imu"] | stamps)),
            "request": (None, json.dumps(rest)),
        }
        return untimed(server.client.post("/detect", files=files))

    with ThreadPoolExecutor(max_workers=16) as clients:
        assert list(clients.map(as_form, [seed % 4 for seed in range(16)])) == serial * 4


def test_the_documented_example_works(server: LiveServer) -> None:
    answer = server.post_json(example_json_request())
    assert answer.status_code == 200, answer.text
    jsonschema.Draft202012Validator(load_detection_schema()).validate(answer.json())


LATE = [T0 + 20_000_000 + 5_000_000 * index for index in range(51)]

BAD_FOR_THE_MODEL = [
    pytest.param(
        {"imu": resting_imu(timestamps_ns=LATE[: len(imu_part()["timestamps_ns"])])},
        "imu_not_covering",
        "imu.timestamps_ns",
        id="IMU begins after the source frame",
    ),
    pytest.param(
        {"imu": {"timestamps_ns": [T0], "gyro_rad_s": [[0, 0, 0]], "accel_m_s2": [[0, 0, 9.81]]}},
        "imu_not_covering",
        "imu.timestamps_ns",
        id="one IMU sample",
    ),
    pytest.param(
        {"imu": resting_imu(accel_m_s2=[[0.0, 0.0, 1.0]] * 50)}, "imu_accel_in_g", "imu.accel_m_s2", id="in g"
    ),
    pytest.param(
        {"imu": resting_imu(gyro_rad_s=[[0.0, 0.0, 90.0]] * 50)}, "imu_gyro_in_deg_s", "imu.gyro_rad_s", id="in deg/s"
    ),
    pytest.param(
        {"camera": MOUNTED | {"distortion_model": "radtan", "distortion_coeffs": [-1, 0, 0, 0]}},
        "camera_invalid",
        "camera.distortion_coeffs",
        id="distortion that folds the image",
    ),
]


@pytest.mark.parametrize(("changes", "code", "place"), BAD_FOR_THE_MODEL)
def test_what_the_model_cannot_use(server: LiveServer, changes: dict[str, Any], code: str, place: str) -> None:
    assert_problem(server.post_json(request_of(**changes)), 422, code, place)


EXTREME_CAMERAS = [
    {"fx": 1.0, "fy": 1.0},
    {"fx": 1e6, "fy": 1.0},
    {"cx": -1e6, "cy": 1e6},
    {"distortion_model": "radtan", "distortion_coeffs": [-50, 20, 0, 0, 0]},
    {"distortion_model": "radtan", "distortion_coeffs": [1e6, 1e6, 1e6, 1e6]},
    {"distortion_model": "equidistant", "distortion_coeffs": [-1e6, 1e6, 1, 1]},
    {"T_cam_imu": [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
    {"time_offset_s": 3600},
]


@pytest.mark.parametrize("camera", EXTREME_CAMERAS)
def test_no_camera_is_a_fault_of_ours(server: LiveServer, camera: dict[str, Any]) -> None:
    response = server.post_json(request_of(camera=MOUNTED | camera))
    assert response.status_code in (200, 422), response.text


EXTREME_STAMPS = [
    (0, 1, [0, 1]),
    (0, 2**63 - 1, [0, 2**63 - 1]),
    (2**63 - 2, 2**63 - 1, [-(2**63), 0, 2**63 - 1]),
    (T0, T0 + INTERVAL_NS, [-(2**63), T0, T0 + INTERVAL_NS, 2**63 - 1]),
]


@pytest.mark.parametrize(("source_ns", "target_ns", "stamps"), EXTREME_STAMPS)
def test_no_stamp_is_a_fault_of_ours(server: LiveServer, source_ns: int, target_ns: int, stamps: list[int]) -> None:
    request = request_of()
    request["source"]["timestamp_ns"], request["target"]["timestamp_ns"] = source_ns, target_ns
    rows = len(stamps)
    request["imu"] = {"timestamps_ns": stamps, "gyro_rad_s": [[0, 0, 0]] * rows, "accel_m_s2": [[0, 0, 9.81]] * rows}
    response = server.post_json(request)
    assert response.status_code in (200, 422), response.text


@pytest.mark.parametrize("size", [(32, 32), (33, 47), (2000, 32)])
def test_odd_sizes(server: LiveServer, size: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 256, size[::-1], dtype=np.uint8)
    text = base64_text(png(image))
    request = request_of(camera=None)
    request["source"]["image_base64"] = request["target"]["image_base64"] = text
    answer = server.post_json(request)
    assert answer.status_code == 200, answer.text
    assert answer.json()["image"] == {"width": size[0], "height": size[1]}


@pytest.mark.parametrize("content", [b"", b"not a model", pickle.dumps({"weights": [1, 2]})])
def test_a_checkpoint_that_cannot_be_used_ends_the_process(tmp_path: Path, content: bytes) -> None:
    checkpoint = tmp_path / "model.safetensors"
    checkpoint.write_bytes(content)
    ended = subprocess.run(
        [sys.executable, "-m", "viflow_anomaly_service"],
        env=os.environ | {"VIFLOW_CHECKPOINT": str(checkpoint), "VIFLOW_PORT": "0"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ended.returncode == 2, ended.stderr
    assert str(checkpoint) in ended.stderr.splitlines()[-1]


def test_a_calibration_decides_what_is_labelled_as_motion(tmp_path: Path) -> None:
    detector = AnomalyDetector.from_checkpoint()
    loud = JudgedPair(0.05, (0.9999,))
    watched = [WatchedRecording("hall", None, (loud,), abstained=0, failed={})]
    calibration = make_calibration(
        watched,
        footage_of(watched),
        model=detector.model_info,
        execution=detector.execution,
        detector=detector.config,
        budget_per_hour=1.0,
        confidence=0.9,
        block_s=10.0,
    )
    write_calibration(tmp_path / "hall.json", calibration)
    loaded = load_bundled_or_configured(load_settings(calibration=tmp_path / "hall.json"))
    assert loaded.config.regions.motion_score == calibration.motion_score == 1.0
    other = load_settings(calibration=tmp_path / "hall.json", detector={"min_overlap": 0.2})
    with pytest.raises(ConfigError, match=r"detector.min_overlap 0.05, found 0.2") as caught:
        load_bundled_or_configured(other)
    assert caught.value.code == "calibration_stale"


def test_the_printed_curl_lines_work(server: LiveServer) -> None:
    if shutil.which("curl") is None:
        pytest.skip("curl is not installed; the documented command lines cannot be run")
    blocks = re.findall(r"```bash\n(.*?)```", (ROOT / "docs" / "service.md").read_text(encoding="utf-8"), re.DOTALL)
    answers = []
    for block in blocks:
        if "/detect" in block:
            command = block.replace("127.0.0.1:8000", f"127.0.0.1:{server.port}")
            done = subprocess.run(["bash", "-c", command], cwd=ROOT, capture_output=True, text=True, check=True)
            answer = json.loads(done.stdout)
            jsonschema.Draft202012Validator(load_detection_schema()).validate(answer)
            del answer["timings_ms"]
            answers.append(answer)
    assert len(answers) == 2
    assert answers[0] == answers[1]


def test_models_names_network_and_head_as_they_are_on_disk(server: LiveServer) -> None:
    found = server.client.get("/models").json()["models"]
    assert [model["role"] for model in found] == ["network", "evidence_head"]
    for model, name in zip(found, ("viflow-calibrated", "viflow-evidence"), strict=True):
        record = json.loads((ROOT / "viflow_anomaly" / "weights" / f"{name}.json").read_text())
        assert {key: model[key] for key in ("name", "version", "sha256")} == {
            key: record[key] for key in ("name", "version", "sha256")
        }
    assert [model["preset"] for model in found] == ["calibrated", None]
    assert all(model["runtime"] in ("openvino", "onnxruntime", "torch") and model["device"] for model in found)


def test_models_fit_their_schema(server: LiveServer) -> None:
    document = server.client.get("/openapi.json").json()
    schema = {"$ref": "#/components/schemas/ModelList", "components": document["components"]}
    jsonschema.validate(server.client.get("/models").json(), schema)
    without_head = live_server(
        load_bundled_or_configured, detector=DetectorConfig.model_validate({"evidence": "residual"})
    )
    with without_head as other:
        assert [model["role"] for model in other.client.get("/models").json()["models"]] == ["network"]


def test_a_stream_says_what_a_batch_of_the_recording_says(server: LiveServer, tmp_path: Path) -> None:
    recording = open_recording(ROOT / "samples" / "drone")
    run_batch(recording, load_bundled_or_configured(load_settings()), BatchOptions(out_dir=tmp_path, overwrite=True))
    lines = [json.loads(line) for line in (tmp_path / "detections.jsonl").read_text(encoding="utf-8").splitlines()]
    request = json.loads((ROOT / "samples" / "drone" / "request.json").read_text(encoding="utf-8"))
    log = recording.imu
    assert log.accel_m_s2 is not None
    found: list[dict[str, Any]] = []
    sent = 0
    for k, stamp_ns in enumerate(recording.frame_timestamps_ns.tolist()):
        until = int(np.searchsorted(log.timestamps_ns, stamp_ns)) + 1
        samples = {
            "timestamps_ns": log.timestamps_ns[sent:until].tolist(),
            "gyro_rad_s": log.gyro_rad_s[sent:until].tolist(),
            "accel_m_s2": log.accel_m_s2[sent:until].tolist(),
        }
        sent = until
        frame = {"timestamp_ns": stamp_ns, "image_base64": base64_text(png(recording.frame(k).image))}
        body = {"frame": frame, "imu": samples} | ({"camera": request["camera"]} if k == 0 else {})
        answer = server.client.post("/streams/drone/frames", json=body)
        assert answer.status_code == 200, answer.text
        assert answer.json()["faults"] == []
        found += answer.json()["detections"]
    untimed = [{name: value for name, value in one.items() if name != "timings_ms"} for one in found]
    assert untimed == [{name: value for name, value in one.items() if name != "timings_ms"} for one in lines]
    assert any(roi["track_id"] is not None for one in found for roi in one["rois"])
