"""Labels, rivals and the whole measurement on drawn worlds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from simulated_truth import add_ground_truth, add_movers
from worlds import make_world, textured_image, write_euroc

from viflow_anomaly.checkpoint import save_checkpoint
from viflow_anomaly.config import ModelConfig
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.datasets.simulated_ground_truth import SimulatedGroundTruth
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.evaluation.detection_quality import OURS, measure_detection
from viflow_anomaly.evaluation.labelled_pairs import TrueObject, labels_of
from viflow_anomaly.evaluation.rivals import RIVALS
from viflow_anomaly.model.builder import build_model
from viflow_anomaly.regions import BoundingBox
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples, Uint8Array

STAMPS = np.arange(0, 100_000_001, 5_000_000)
IMU = ImuSamples(STAMPS, np.zeros((len(STAMPS), 3)), np.tile((0.0, -9.81, 0.0), (len(STAMPS), 1)))


def pair(source: Uint8Array, target: Uint8Array) -> FramePair:
    return FramePair(Frame(20_000_000, source), Frame(70_000_000, target), IMU, None)


def moving_square() -> FramePair:
    """The camera pans by 3 px; a square of another texture goes 8 px the other way."""
    texture, square = textured_image(170, 120, seed=1), textured_image(30, 30, seed=2)
    source, target = texture[:, 3:163].copy(), texture[:, :160].copy()
    source[40:70, 60:90], target[40:70, 52:82] = square, square
    return pair(source, target)


@pytest.mark.parametrize("name", [name for name in RIVALS if name != "frame difference"])
def test_a_rival_sees_the_square_and_not_the_pan(name: str) -> None:
    evidence, inside = RIVALS[name](moving_square())
    assert evidence.shape == inside.shape == (120, 160)
    assert evidence.dtype == np.float32
    background = evidence[10:110, 100:150].mean()
    assert evidence[44:66, 64:86].mean() > 4 * background


def test_the_frame_difference_sees_both() -> None:
    evidence, inside = RIVALS["frame difference"](moving_square())
    assert inside.all()
    assert evidence[10:110, 100:150].mean() > 0.3 * evidence[44:66, 64:86].mean()


@pytest.mark.parametrize("name", RIVALS)
def test_rivals_take_pictures_without_anything_to_track(name: str) -> None:
    flat = np.full((64, 96), 90, np.uint8)
    evidence, _ = RIVALS[name](pair(flat, flat))
    assert np.isfinite(evidence).all()
    assert evidence.max() < 1.0


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> AnomalyDetector:
    config = ModelConfig(hypotheses=4)
    path = tmp_path_factory.mktemp("model") / "m.safetensors"
    return AnomalyDetector.from_checkpoint(save_checkpoint(path, build_model(config), config, name="m", version="0"))


def test_labels_come_from_the_ground_truth(tmp_path: Path) -> None:
    folder = add_movers(add_ground_truth(tmp_path / "drone_1", make_world(frames=3)))
    truth = SimulatedGroundTruth.find(folder)
    assert truth is not None
    labels = labels_of(truth, int(open_recording(folder).frame_timestamps_ns[0]))
    assert labels.objects == (
        TrueObject(BoundingBox(30, 10, 14, 10), 4.0, counted=True),
        TrueObject(BoundingBox(5, 30, 10, 10), 0.5, counted=False),
    )
    assert (labels.moving.sum(), labels.ignored.sum()) == (140, 100)
    assert labels.moving[10, 30]
    assert labels.ignored[39, 14]


def test_ours_and_all_rivals_are_measured_by_group(detector: AnomalyDetector, tmp_path: Path) -> None:
    folders = [
        add_movers(add_ground_truth(tmp_path / name, make_world(frames=3))) for name in ("drone_1", "drone_2", "car_1")
    ]
    steps: list[tuple[int, int]] = []
    table = measure_detection(detector, folders, on_progress=lambda done, total: steps.append((done, total)))
    assert list(table) == ["car", "drone"]
    assert set(table["drone"]) == {OURS, *RIVALS}
    assert {one["frames"] for one in table["drone"].values()} == {4}
    assert {one["frames"] for one in table["car"].values()} == {2}
    assert {one["movers"] for one in table["drone"].values()} == {4}
    assert steps == [(1, 3), (2, 3), (3, 3)]
    alone = measure_detection(detector, folders[:1], every=2, rivals=False)
    assert (list(alone["drone"]), alone["drone"][OURS]["frames"]) == ([OURS], 1)


def test_a_recording_without_ground_truth_is_refused(detector: AnomalyDetector, tmp_path: Path) -> None:
    alone = add_movers(add_ground_truth(tmp_path / "drone_1", make_world(frames=1)))
    for folder in (write_euroc(tmp_path / "V1_01"), alone):
        with pytest.raises(DatasetError) as caught:
            measure_detection(detector, [folder])
        assert caught.value.code == "ground_truth_missing"
