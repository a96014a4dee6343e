"""Small pictures beside stored detections: which there are, what they show, how long they stay."""

from __future__ import annotations

import asyncio
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import sqlalchemy as sa
from alembic import command
from alembic.config import Config
from rule_detector import RuleDetector
from service_world import INTERVAL_NS, T0, assert_problem, base64_text, imu_part, json_request, live_server, png

from viflow_anomaly.drawing import VERMILLION
from viflow_anomaly_service.store.detection_store import DetectionStore
from viflow_anomaly_service.store.engine import MIGRATIONS, make_engine, store_url
from viflow_anomaly_service.store.record import IdMaker, Record
from viflow_anomaly_service.store.tables import DETECTIONS


def moving_square(*, width: int = 800, height: int = 500, moves: bool = True) -> dict[str, Any]:
    """A pair in which a bright square moves, or nothing does."""
    images = [np.full((height, width), 90, dtype=np.uint8) for _ in range(2)]
    for number, image in enumerate(images):
        x = 200 + (100 * number if moves else 0)
        image[200:300, x : x + 100] = 250
    return {
        name: {"timestamp_ns": T0 + number * INTERVAL_NS, "image_base64": base64_text(png(images[number]))}
        for number, name in enumerate(("source", "target"))
    }


def test_a_detection_with_motion_has_a_picture_of_it(empty_store_url: str) -> None:
    with live_server(lambda settings: RuleDetector(), store_url=empty_store_url) as server:
        answer = server.post_json(json_request(**moving_square()))
        assert "independent_motion" in answer.text
        path = f"/detections/{answer.headers['x-detection-id']}/thumbnail"
        picture = server.client.get(path)
        assert picture.status_code == 200
        assert picture.headers["content-type"] == "image/jpeg"
        assert "immutable" in picture.headers["cache-control"]
        pixels = cv2.imdecode(np.frombuffer(picture.content, dtype=np.uint8), cv2.IMREAD_COLOR)
        assert pixels.shape == (200, 320, 3)
        assert (np.abs(pixels.astype(int) - VERMILLION).max(axis=2) < 60).any(), "no box is drawn"
        same = server.client.get(path, headers={"If-None-Match": picture.headers["etag"]})
        assert (same.status_code, same.content) == (304, b"")
        still = server.post_json(json_request(**moving_square(moves=False))).headers["x-detection-id"]
        assert_problem(server.client.get(f"/detections/{still}/thumbnail"), 404, "thumbnail_not_found", None)
        assert_problem(server.client.get("/detections/17/thumbnail"), 404, "detection_not_found", None)


def test_another_number_of_pictures_than_of_detections_is_a_fault_of_ours(tmp_path: Path) -> None:
    detector = RuleDetector()
    with live_server(lambda settings: detector, store_url=str(tmp_path / "x.db")) as server:
        server.post_json(json_request())
        pair, _ = detector.calls[0]
        kept = [(detector.detect(pair), "{}")]
        for thumbnails in ([None, None], [b"x", b"y", b"z"]):
            with pytest.raises(ValueError, match="zip"):
                asyncio.run(server.app.state.core.keeper.keep(kept, thumbnails=thumbnails))
        assert len(server.client.get("/detections").json()["detections"]) == 1


@pytest.mark.parametrize(("choice", "status"), [("none", 404), ("all", 200)])
def test_the_setting_decides(tmp_path: Any, choice: str, status: int) -> None:
    with live_server(lambda settings: RuleDetector(), store_url=str(tmp_path / "x.db"), thumbnails=choice) as server:
        kept = server.post_json(json_request(**moving_square(moves=choice == "none"))).headers["x-detection-id"]
        assert server.client.get(f"/detections/{kept}/thumbnail").status_code == status


def test_the_detections_of_a_stream_have_pictures_too(tmp_path: Any) -> None:
    with live_server(lambda settings: RuleDetector(), store_url=str(tmp_path / "x.db")) as server:
        frames = moving_square()
        first = server.client.post("/streams/a/frames", json={"frame": frames["source"], "imu": imu_part()})
        assert first.status_code == 200, first.text
        second = server.client.post("/streams/a/frames", json={"frame": frames["target"]}).json()
        (kept,) = second["detection_ids"]
        assert server.client.get(f"/detections/{kept}/thumbnail").status_code == 200


def test_without_a_store_there_is_none() -> None:
    with live_server(lambda settings: RuleDetector()) as server:
        answer = server.client.get(f"/detections/{'0' * 32}/thumbnail")
        assert_problem(answer, 501, "store_not_configured", None)


def test_the_oldest_pictures_go_first_and_their_detections_stay(empty_store_url: str) -> None:
    store, new_id = DetectionStore(empty_store_url), IdMaker()
    plain = Record(new_id(), 0, 1, "{}")
    records = [plain, *(replace(plain, id=new_id(), thumbnail=bytes(1000)) for _ in range(6))]
    store.add(records)
    assert store.prune(max_age_s=None, max_bytes=None, thumbnail_max_bytes=6000) == 0
    assert all(store.thumbnail(one.id) == bytes(1000) for one in records[1:])
    assert store.prune(max_age_s=None, max_bytes=None, thumbnail_max_bytes=3500) == 0
    assert [store.thumbnail(one.id) is not None for one in records] == [False] * 4 + [True] * 3
    assert all(store.get(one.id) is not None for one in records)
    time.sleep(0.01)
    assert store.prune(max_age_s=0.0, max_bytes=None, thumbnail_max_bytes=3500) == len(records)
    assert all(store.thumbnail(one.id) is None for one in records)
    store.close()


def test_a_store_of_the_first_version_is_brought_up_to_date(empty_store_url: str) -> None:
    engine = make_engine(store_url(empty_store_url))
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    config.set_main_option("path_separator", "os")
    old = {"id": "0" * 32, "source_timestamp_ns": 0, "target_timestamp_ns": 1, "size_bytes": 2, "body": "{}"}
    with engine.connect().execution_options(writes=True) as connection, connection.begin():
        config.attributes["connection"] = connection
        command.upgrade(config, "0001")
        connection.execute(sa.insert(DETECTIONS), [old])
    engine.dispose()
    store = DetectionStore(empty_store_url)
    store.add([Record(IdMaker()(), 0, 1, "{}", thumbnail=b"x")])
    assert store.get("0" * 32) is not None
    assert store.thumbnail("0" * 32) is None
    store.close()
