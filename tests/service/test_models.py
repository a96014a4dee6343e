"""Several models in one service: chosen by name, exchanged under load, refused without a trace."""

from __future__ import annotations

import gc
import json
import os
import shutil
import subprocess
import sys
import threading
import weakref
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest
from rule_detector import RuleDetector
from service_world import LiveServer, assert_problem, form_request, json_request, live_server, wait_until
from serving_process import serving_process
from test_service_metrics import scraped

from viflow_anomaly.checkpoint_record import bundled_checkpoint, bundled_evidence_head
from viflow_anomaly.detection import ModelInfo
from viflow_anomaly.errors import CheckpointError, ConfigError
from viflow_anomaly_service.detector_loading import load_bundled_or_configured
from viflow_anomaly_service.examples import example_form_request, example_image_png
from viflow_anomaly_service.models.named import NamedModel
from viflow_anomaly_service.settings import ServiceSettings, load_settings

CLIENTS = 16
NIGHT = NamedModel(checkpoint=Path("/somewhere/night.safetensors"))


class FileDetector(RuleDetector):
    """Its name is the checkpoint file's, its version and what it does are what the file says."""

    def __init__(self, settings: ServiceSettings | None = None, **options: Any) -> None:
        super().__init__(**options)
        if settings is not None and settings.checkpoint is not None:
            path = settings.checkpoint
            said = json.loads(path.read_text()) if path.exists() else {}
            self.model_info = ModelInfo(path.stem, said.get("version", "1"), said.get("sha256", "cd" * 32))

    def with_config(self, config: Any) -> FileDetector:
        other = FileDetector(config=config, may_go=self.may_go, error=self.error, calls=self.calls)
        other.model_info = self.model_info
        return other


def load(settings: ServiceSettings) -> FileDetector:
    """As the settings say; a file that holds ``error`` cannot be loaded."""
    path = settings.checkpoint
    said = json.loads(path.read_text()) if path is not None and path.exists() else {}
    if said.get("error") == "checkpoint":
        raise CheckpointError(f"{path}: truncated or altered", code="checkpoint_corrupt", field="checkpoint")
    if "error" in said:
        raise RuntimeError(f"{path}: our fault")
    return FileDetector(settings)


def write_model(folder: Path, name: str, **said: str) -> str:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(json.dumps(said))
    return name


@pytest.fixture
def server(tmp_path: Path) -> Iterator[LiveServer]:
    """A default model, one called ``night``, and a folder of others."""
    (tmp_path / "models").mkdir()
    with live_server(load, models={"night": NIGHT}, model_dir=tmp_path / "models", max_models=3) as running:
        yield running


def loaded(server: LiveServer) -> dict[str, dict[str, Any]]:
    return {one["name"]: one for one in server.client.get("/models").json()["loaded"]}


def detect(server: LiveServer, model: str | None = None, seed: int = 0) -> httpx.Response:
    return server.post_json(json_request(seed=seed, **({} if model is None else {"options": {"model": model}})))


def put_model(server: LiveServer, name: str, **body: Any) -> httpx.Response:
    return server.client.post(f"/models/{name}/load", json=body)


def frame_call(number: int, **setup: Any) -> dict[str, Any]:
    whole = json_request(seed=number)
    stamp = whole["source"]["timestamp_ns"] + number * 50_000_000
    frame = {**whole["source"], "timestamp_ns": stamp}
    return {"frame": frame, **({"imu": whole["imu"]} if number == 0 else {}), **setup}


# --- choosing


def test_a_request_chooses_by_name_and_version(server: LiveServer) -> None:
    assert detect(server).json()["model"]["name"] == "rule"
    for name in ("night", "night@1"):
        assert detect(server, name).json()["model"]["name"] == "night"
    request = (None, json.dumps({"options": {"model": "night"}}), "application/json")
    assert server.post_form(form_request(request=request)).json()["model"]["name"] == "night"
    answer = detect(server, "day")
    assert_problem(answer, 422, "model_unknown", "options.model")
    assert "default@1, night@1" in answer.json()["detail"]
    assert_problem(detect(server, "night@2"), 422, "model_unknown", "options.model")
    request = (None, json.dumps({"options": {"model": "day"}}), "application/json")
    assert_problem(server.post_form(form_request(request=request)), 422, "model_unknown", "request.options.model")
    values = scraped(server)
    assert values["viflow_detections_total", ("default", "ok")] == 1
    assert values["viflow_detections_total", ("night", "ok")] == 3


def test_the_list_is_what_it_was_and_more(server: LiveServer) -> None:
    answer = server.client.get("/models").json()
    assert [weights["name"] for weights in answer["models"]] == ["rule"]
    assert [(one["name"], one["default"]) for one in answer["loaded"]] == [("default", True), ("night", False)]
    assert answer["loaded"][0]["loaded_at_ns"] > 1_700_000_000 * 10**9
    assert answer["loaded"][1]["model"] == {"name": "night", "version": "1", "sha256": "cd" * 32}


def test_a_version_with_a_head_is_found_by_either_name(tmp_path: Path) -> None:
    write_model(tmp_path, "a.json", version="2+head.0123")
    with live_server(load, model_dir=tmp_path) as running:
        assert put_model(running, "a", checkpoint="a.json").status_code == 200
        for wanted in ("a", "a@2", "a@2+head.0123"):
            assert detect(running, wanted).status_code == 200
        assert_problem(detect(running, "a@2+head"), 422, "model_unknown", "options.model")


def test_a_stream_keeps_its_model(server: LiveServer, tmp_path: Path) -> None:
    write_model(tmp_path / "models", "other.json")
    options = {"options": {"model": "night"}}
    first = server.client.post("/streams/a/frames", json=frame_call(0, **options))
    assert first.json()["begun"], first.text
    assert server.client.get("/streams/a").json()["model"] == {"name": "night", "version": "1"}
    assert server.client.delete("/models/night").status_code == 204
    assert_problem(detect(server, "night"), 422, "model_unknown", "options.model")
    again = server.client.post("/streams/a/frames", json=frame_call(1, **options)).json()
    assert [one["model"]["name"] for one in again["detections"]] == ["night"]
    changed = server.client.post("/streams/a/frames", json=frame_call(2, options={"model": "default"}))
    assert_problem(changed, 409, "stream_setup_changed", "options")
    unknown = server.client.post("/streams/b/frames", json=frame_call(0, **options))
    assert_problem(unknown, 422, "model_unknown", "options.model")
    # The stream's model still counts; it goes with the stream.
    assert put_model(server, "x", checkpoint="other.json").status_code == 200
    assert_problem(put_model(server, "y", checkpoint="other.json"), 409, "models_full", None)
    assert server.client.delete("/streams/a").status_code == 204
    assert put_model(server, "y", checkpoint="other.json").status_code == 200


@pytest.mark.parametrize("unloaded_before_its_stream_ends", [False, True])
def test_who_looks_on_keeps_no_model_in_memory(tmp_path: Path, unloaded_before_its_stream_ends: bool) -> None:
    write_model(tmp_path, "a.json")
    weights: weakref.WeakSet[threading.Event] = weakref.WeakSet()

    def load_noted(settings: ServiceSettings) -> FileDetector:
        made = load(settings)
        made.may_go = threading.Event()  # which a detector shares with those of other configurations, as weights
        made.may_go.set()
        weights.add(made.may_go)
        return made

    with live_server(load_noted, model_dir=tmp_path, max_models=2) as running:
        for _ in range(5):
            answer = put_model(running, "x", checkpoint="a.json")
            assert answer.status_code == 200, answer.text
            running.client.post("/streams/a/frames", json=frame_call(0, options={"model": "x"}))
            running.client.post("/streams/a/frames", json=frame_call(1))
            if unloaded_before_its_stream_ends:
                assert remembered(running) == 1
                assert running.client.delete("/models/x").status_code == 204
                assert remembered(running) == 0
                running.client.post("/streams/a/frames", json=frame_call(2))
            assert remembered(running) == 1
            expire(running, "a")
            assert remembered(running) == (0 if unloaded_before_its_stream_ends else 1)
        gc.collect()
        assert len(weights) <= 2


def remembered(server: LiveServer) -> int:
    return sum(one["remembered_pairs"] for one in server.client.get("/live").json()["streams"])


def expire(server: LiveServer, stream_id: str) -> None:
    """As if it had been idle for too long."""
    streams, done = server.app.state.core.streams, threading.Event()

    def forget() -> None:
        streams.forget(streams.require(stream_id), "stream_expired")
        done.set()

    server.loop.call_soon_threadsafe(forget)
    assert done.wait(10)


# --- exchanging


def test_a_switch_under_load_loses_nothing(server: LiveServer, tmp_path: Path) -> None:
    for number in range(4):
        write_model(tmp_path / "models", f"v{number}.json", version=str(number))
    stop, failures = threading.Event(), []
    seen: set[str] = set()

    def ask(number: int) -> int:
        count = 0
        while not stop.is_set():
            answer = detect(server, seed=number)
            ready = server.client.get("/readyz").status_code
            if answer.status_code != 200 or ready != 200:
                failures.append((answer.status_code, answer.text, ready))
                break
            seen.add(answer.json()["model"]["name"])
            count += 1
        return count

    with ThreadPoolExecutor(CLIENTS) as pool, ExitStack() as ending:
        ending.callback(stop.set)
        asking = [pool.submit(ask, number) for number in range(CLIENTS)]
        for number in range(4):
            answer = put_model(server, "day", checkpoint=f"v{number}.json")
            assert answer.status_code == 200, answer.text
            assert server.client.put("/models/default", json={"name": "day"}).status_code == 200
            wait_until(lambda number=number: f"v{number}" in seen or bool(failures), seconds=60)
        stop.set()
        counts = [one.result(60) for one in asking]
    assert not failures
    assert min(counts) > 0
    assert {f"v{number}" for number in range(4)} <= seen


def test_a_request_ends_on_the_model_it_began_with(tmp_path: Path) -> None:
    write_model(tmp_path, "new.json")
    may_go, calls = threading.Event(), []  # type: ignore[var-annotated]

    def load_slow(settings: ServiceSettings) -> FileDetector:
        waits = settings.checkpoint is None
        return FileDetector(settings, may_go=may_go if waits else None, calls=calls)

    # The workers meet to warm a model up, which waits for the slow pair: no warm-up, and more than one worker.
    with live_server(load_slow, model_dir=tmp_path) as running, ThreadPoolExecutor(1) as pool, ExitStack() as ending:
        ending.callback(may_go.set)
        slow = pool.submit(detect, running)
        wait_until(lambda: len(calls) == 1)
        assert put_model(running, "new", checkpoint="new.json").status_code == 200
        assert running.client.put("/models/default", json={"name": "new"}).json()["models"][0]["name"] == "rule"
        assert running.client.delete("/models/default").status_code == 204
        assert detect(running).json()["model"]["name"] == "new"
        may_go.set()
        assert slow.result(30).json()["model"]["name"] == "rule"
        assert running.client.get("/version").json()["model"]["name"] == "new"


def test_a_new_model_is_warm_in_every_worker(tmp_path: Path) -> None:
    write_model(tmp_path, "new.json")
    threads: dict[str, set[str]] = {}

    class Noting(FileDetector):
        def detect(self, pair: Any, *, decode_ms: float = 0.0) -> Any:
            threads.setdefault(self.model_info.name, set()).add(threading.current_thread().name)
            return super().detect(pair, decode_ms=decode_ms)

    with live_server(Noting, model_dir=tmp_path, max_concurrent=3, warm_up="96x64") as running:
        assert put_model(running, "new", checkpoint="new.json").status_code == 200
        assert threads["new"] == {"detect-0", "detect-1", "detect-2"}


@pytest.mark.parametrize(
    ("said", "status", "code", "place"),
    [
        ({"error": "checkpoint"}, 422, "checkpoint_corrupt", "checkpoint"),
        ({"error": "ours"}, 422, "model_load_failed", None),
        ({"sha256": "ef" * 32}, 409, "model_checksum_mismatch", "sha256"),
    ],
)
def test_a_failed_load_leaves_the_old_model(
    server: LiveServer, tmp_path: Path, said: dict[str, str], status: int, code: str, place: str | None
) -> None:
    write_model(tmp_path / "models", "bad.json", **said)
    before = server.client.get("/models").json()
    answer = put_model(server, "night", checkpoint="bad.json", sha256="cd" * 32)
    assert_problem(answer, status, code, place)
    assert str(tmp_path) not in answer.text
    assert server.client.get("/models").json() == before
    assert detect(server, "night").json()["model"]["name"] == "night"
    assert scraped(server)["viflow_requests_total", ("POST", "/models/{name}/load", str(status))] == 1


def test_the_right_checksum_is_taken_and_the_metrics_follow(server: LiveServer, tmp_path: Path) -> None:
    write_model(tmp_path / "models", "good.json", sha256="12" * 32, version="7")
    answer = put_model(server, "night", checkpoint="good.json", sha256="12" * 32)
    assert (answer.status_code, answer.json()["version"]) == (200, "7")
    infos = [labels for name, labels in scraped(server) if name == "viflow_model_info"]
    assert sorted(labels[2] for labels in infos) == ["default", "night"]
    assert server.client.delete("/models/night").status_code == 204
    infos = [labels for name, labels in scraped(server) if name == "viflow_model_info"]
    assert [labels[2] for labels in infos] == ["default"]


def test_one_load_at_a_time(tmp_path: Path) -> None:
    write_model(tmp_path, "a.json")
    may_load, loading = threading.Event(), threading.Event()

    def load_later(settings: ServiceSettings) -> FileDetector:
        if settings.checkpoint is not None:
            loading.set()
            assert may_load.wait(30)
        return load(settings)

    with live_server(load_later, model_dir=tmp_path) as running, ThreadPoolExecutor(1) as pool, ExitStack() as ending:
        ending.callback(may_load.set)
        first = pool.submit(put_model, running, "a", checkpoint="a.json")
        assert loading.wait(30)
        assert_problem(put_model(running, "b", checkpoint="a.json"), 409, "model_load_running", None)
        assert detect(running).status_code == 200
        assert running.client.get("/readyz").status_code == 200
        may_load.set()
        assert first.result(30).status_code == 200


def test_memory_is_bounded(server: LiveServer, tmp_path: Path) -> None:
    write_model(tmp_path / "models", "a.json")
    assert put_model(server, "c", checkpoint="a.json").status_code == 200
    assert_problem(put_model(server, "d", checkpoint="a.json"), 409, "models_full", None)
    for _ in range(3):  # in its own place there is room
        assert put_model(server, "c", checkpoint="a.json").status_code == 200
    assert sorted(loaded(server)) == ["c", "default", "night"]


# --- refusals


@pytest.mark.parametrize(
    "name",
    ["/etc/passwd", "../a.json", "a/../../b", "", ".", "link", "linked/a.json", "pipe", "a\\b", "a\0b", "x" * 600],
)
def test_no_way_out_of_the_folder(server: LiveServer, tmp_path: Path, name: str) -> None:
    (tmp_path / "outside").mkdir()
    write_model(tmp_path / "outside", "a.json")
    (tmp_path / "models" / "link").symlink_to(tmp_path / "outside" / "a.json")
    (tmp_path / "models" / "linked").symlink_to(tmp_path / "outside")
    os.mkfifo(tmp_path / "models" / "pipe")
    for place in ("checkpoint", "evidence_head", "calibration"):
        body = {"checkpoint": "a.json", place: name}
        answer = put_model(server, "x", **body)
        assert_problem(answer, 422, "model_path_invalid", place)
        assert str(tmp_path) not in answer.text


@pytest.mark.parametrize(
    ("body", "status", "code", "place"),
    [
        (b"{", 400, "json_invalid", None),
        (b"{}", 422, "field_missing", "checkpoint"),
        (b'{"checkpoint": "a", "path": "b"}', 422, "field_unknown", "path"),
        (b'{"checkpoint": "a", "sha256": "AB"}', 422, "field_invalid", "sha256"),
        (b'{"checkpoint": "a", "runtime": "tf"}', 422, "field_invalid", "runtime"),
        (b'{"checkpoint": 1}', 422, "field_invalid", "checkpoint"),
        (b" " * 20_000, 413, "body_too_large", None),
    ],
)
def test_a_wrong_body(server: LiveServer, body: bytes, status: int, code: str, place: str | None) -> None:
    headers = {"Content-Type": "application/json"}
    assert_problem(server.client.post("/models/x/load", content=body, headers=headers), status, code, place)
    assert_problem(server.client.post("/models/x/load", content=body), 415, "media_type_unsupported", "Content-Type")


def test_other_refusals(server: LiveServer) -> None:
    assert_problem(server.client.delete("/models/default"), 409, "model_is_default", None)
    assert_problem(server.client.delete("/models/day"), 404, "model_not_found", None)
    assert_problem(server.client.put("/models/default", json={"name": "day"}), 422, "model_unknown", "name")
    assert_problem(server.client.put("/models/default", json={}), 422, "field_missing", "name")
    assert_problem(put_model(server, ".x", checkpoint="a"), 422, "model_name_invalid", "name")


def test_without_a_folder_nothing_is_loaded() -> None:
    with live_server(load) as running:
        assert_problem(put_model(running, "x", checkpoint="a"), 501, "model_dir_missing", None)


def test_several_processes_have_the_models_of_the_configuration(tmp_path: Path) -> None:
    models = '{"night": {"checkpoint": "/somewhere/night.safetensors"}}'
    with (
        serving_process(workers=2, models=json.loads(models), model_dir=str(tmp_path), ready=False) as serving,
        serving.client() as client,
    ):
        wait_until(lambda: len(serving.events("model_loaded")) == 4, seconds=60)
        assert len(client.get("/models").json()["loaded"]) == 2
        for answer in (
            client.post("/models/x/load", json={"checkpoint": "a"}),
            client.put("/models/default", json={"name": "night"}),
            client.delete("/models/night"),
        ):
            assert_problem(answer, 501, "models_need_one_process", None)


# --- real files


def copied(source: Path, target: Path) -> Path:
    for suffix in (".safetensors", ".json", ".onnx"):
        shutil.copy(source.with_suffix(suffix), target.with_suffix(suffix))
    return target.with_suffix(".safetensors")


def detect_example(server: LiveServer, model: str) -> httpx.Response:
    parts = example_form_request()
    return server.post_form(
        {
            "source": ("source.png", example_image_png(), "image/png"),
            "target": ("target.png", example_image_png(1), "image/png"),
            "imu": ("imu.json", json.dumps(parts["imu"]), "application/json"),
            "request": ("request.json", json.dumps({"options": {"model": model}}), "application/json"),
        }
    )


def test_real_weights_are_loaded_switched_and_refused(tmp_path: Path) -> None:
    good = copied(bundled_checkpoint(), tmp_path / "good")
    bad = copied(bundled_checkpoint(), tmp_path / "bad")
    copied(bundled_evidence_head(), tmp_path / "head")
    bad.write_bytes(bad.read_bytes()[:-100])
    sha256 = json.loads(good.with_suffix(".json").read_text())["sha256"]
    with live_server(load_bundled_or_configured, model_dir=tmp_path, max_concurrent=1) as running:
        answer = put_model(running, "day", checkpoint="good.safetensors", sha256=sha256)
        assert answer.status_code == 200, answer.text
        assert running.client.put("/models/default", json={"name": "day"}).status_code == 200
        assert detect_example(running, "day").json()["model"]["sha256"] == sha256
        for checkpoint, head, code in (
            ("bad.safetensors", None, "checkpoint_corrupt"),
            ("none.safetensors", None, "checkpoint_missing"),
            ("head.safetensors", None, "checkpoint_of_other_kind"),
            ("good.safetensors", "good.safetensors", "checkpoint_of_other_kind"),
        ):
            more = {} if head is None else {"evidence_head": head}
            refused = put_model(running, "day", checkpoint=checkpoint, **more)
            assert (refused.status_code, refused.json()["code"]) == (422, code), refused.text
            assert str(tmp_path) not in refused.text
        assert detect_example(running, "day").status_code == 200


def test_a_corrupt_model_of_the_configuration_ends_the_start(tmp_path: Path) -> None:
    bad = copied(bundled_checkpoint(), tmp_path / "bad")
    bad.write_bytes(bad.read_bytes()[:-100])
    settings = {"PORT": "0", "WARM_UP": "", "MODELS__NIGHT__CHECKPOINT": str(bad)}
    ended = subprocess.run(
        [sys.executable, "-m", "viflow_anomaly_service"],
        env=os.environ | {f"VIFLOW_{name}": value for name, value in settings.items()},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ended.returncode == 2
    assert "truncated or altered" in ended.stderr.splitlines()[-1]


# --- settings


def test_settings_of_models(monkeypatch: pytest.MonkeyPatch) -> None:
    table = {"models": {"night": {"checkpoint": "n.safetensors", "runtime": "torch"}, "day": {"precision": "f32"}}}
    settings = load_settings(table)
    night = settings.models["night"].applied_to(settings.model_copy(update={"calibration": Path("c.json")}))
    assert (night.checkpoint, night.runtime, night.calibration) == (Path("n.safetensors"), "torch", None)
    monkeypatch.setenv("VIFLOW_MODELS__NIGHT__CHECKPOINT", "e.safetensors")
    settings = load_settings(table)
    assert settings.models["night"] == NamedModel(checkpoint=Path("e.safetensors"), runtime="torch")
    assert settings.models["day"].precision == "f32"
    assert load_settings().models["night"].checkpoint == Path("e.safetensors")
    monkeypatch.setenv("VIFLOW_MODELS", '{"dusk": {"checkpoint": "d.safetensors"}}')
    assert set(load_settings(table).models) == {"dusk", "night"}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("VIFLOW_MODELS__NIGHT__COLOUR", "1"),
        ("VIFLOW_MODELS__DEFAULT__CHECKPOINT", "a"),
        ("VIFLOW_MODELS", '{".x": {}}'),
        ("VIFLOW_MODELS", '{"a": {}, "b": {}, "c": {}, "d": {}}'),
        ("VIFLOW_MODELS", "{"),
    ],
)
def test_wrong_settings_of_models(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(ConfigError) as caught:
        load_settings()
    assert caught.value.code == "config_invalid"


def test_every_model_setting_is_one_of_the_services() -> None:
    assert set(NamedModel.model_fields) < set(ServiceSettings.model_fields)
