"""The pictures of a whole run: which are made, of which methods."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from simulated_truth import add_ground_truth
from worlds import make_world

from viflow_anomaly.config import MotorSource
from viflow_anomaly.evaluation import flow_figures
from viflow_anomaly.evaluation.flow_figures import best_of_each_series, draw_flow_figures, flow_points, paper_points
from viflow_anomaly.evaluation.flow_methods import MethodAbout, NoEstimateError
from viflow_anomaly.evaluation.flow_run import measure_flow_methods
from viflow_anomaly.evaluation.flow_truth import PairName, RecordingTruth
from viflow_anomaly.evaluation.plots import FlowPoint
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.sensor_data import FramePair


class Wrong:
    """Wrong by ``error_px`` everywhere, or silent about the middle pair."""

    motor_source: MotorSource | None = None

    def __init__(self, about: MethodAbout, error_px: float, *, timed: bool = True, silent: bool = False) -> None:
        self.about, self.timed = about, timed
        self._error_px, self._silent = error_px, silent

    def flow(self, pair: FramePair, name: PairName) -> Float32Array:
        if self._silent and name == MIDDLE[0]:
            raise NoEstimateError("asleep")
        return np.full((*pair.source.image.shape, 2), (-2.0, self._error_px), np.float32)


MIDDLE: list[PairName] = []


def network(name: str, hypotheses: int) -> MethodAbout:
    return MethodAbout(name, "network", "paper", "imu", hypotheses)


@pytest.fixture
def truth(tmp_path: Path) -> RecordingTruth:
    made = RecordingTruth(add_ground_truth(tmp_path / "drone_1", make_world(frames=4)))
    MIDDLE[:] = [made.name(1)]
    return made


def test_what_is_drawn(truth: RecordingTruth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    methods = [
        Wrong(network("k1", 1), 4.0),
        Wrong(network("k8", 8), 1.0),
        Wrong(MethodAbout("identity", "baseline"), 0.5, timed=False),
        Wrong(MethodAbout("moody", "baseline"), 0.1, silent=True),
        Wrong(MethodAbout("dis", "baseline"), 2.0),
    ]
    drawn: list[tuple[str, list[str]]] = []
    wheel, correspondences = flow_figures.flow_wheel_picture, flow_figures.correspondence_picture
    monkeypatch.setattr(
        flow_figures,
        "flow_wheel_picture",
        lambda *a: (drawn.append(("flow", list(a[3]))), wheel(*a))[1],
    )
    monkeypatch.setattr(
        flow_figures,
        "correspondence_picture",
        lambda *a, label: (drawn.append(("correspondences", [label])), correspondences(*a, label=label))[1],
    )
    log = tmp_path / "metrics.jsonl"
    log.write_text(json.dumps({"step": 50, "wins": [1.0]}) + "\n")
    run = measure_flow_methods(methods, [truth])
    logs = {"k/1": log, "k8": tmp_path / "absent.jsonl"}
    pictures = draw_flow_figures(tmp_path / "out", run, methods, [truth], training_logs=logs)
    assert [one.png.stem for one in pictures] == [
        "flow-drone",
        "correspondences-drone",
        "epe-runtime-drone",
        "epe-hypotheses-drone",
        "wins-k_1",
    ]
    assert all(path.is_file() for one in pictures for path in one)
    assert drawn == [("flow", ["k8", "k1", "dis"]), ("correspondences", ["k8"])]


def test_only_what_has_a_runtime_and_hypotheses_is_charted(truth: RecordingTruth, tmp_path: Path) -> None:
    methods = [Wrong(MethodAbout("files", "results"), 1.0, timed=False)]
    pictures = draw_flow_figures(tmp_path / "out", measure_flow_methods(methods, [truth]), methods, [truth])
    assert [one.png.stem for one in pictures] == ["flow-drone", "correspondences-drone"]


def test_points_of_what_was_estimated(truth: RecordingTruth) -> None:
    methods = [Wrong(network("k1", 1), 4.0, timed=False), Wrong(MethodAbout("dis", "baseline"), 2.0, timed=False)]
    run = measure_flow_methods(methods, [truth])
    unseen = MethodAbout("unseen", "results")
    by_method = run.total() | {"unseen": type(run.total()["k1"])()}
    assert flow_points((*run.methods, unseen), by_method) == [
        FlowPoint("paper imu", "k1", 4.0, 1, None),
        FlowPoint("dis", "dis", 2.0, None, None),
    ]


def test_the_papers_points() -> None:
    points = paper_points("euroc")
    assert points[-1] == FlowPoint("VIFlow-IMU+SFFMS", "VIFlow-IMU+SFFMS K=8", 3.29, 8, 8.5)
    assert paper_points("kitti")[0] == FlowPoint("FlowNetC", "FlowNetC", 4.0, None, 88.7)


def test_a_chart_of_many_points_shows_the_best_of_each_series() -> None:
    many = [FlowPoint(f"series {k % 3}", f"point {k}", 20.0 - k, runtime_ms=1.0 + k) for k in range(15)]
    assert [point.label for point in best_of_each_series(many)] == ["point 12", "point 13", "point 14"]
    assert best_of_each_series(many[:14]) == many[:14]
