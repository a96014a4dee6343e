"""The measurement: what is judged, what is added up, which thresholds a rival gets."""

from __future__ import annotations

import numpy as np
import pytest
from drawn_methods import ELSEWHERE, HIGH, LOW, MOVER, DrawnMethod, DrawnPairs
from simulated_truth import add_ground_truth, add_movers
from worlds import make_world

from viflow_anomaly.checkpoint import save_checkpoint
from viflow_anomaly.config import DetectorConfig, ModelConfig, RegionConfig
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.evaluation.detection_methods import (
    OURS,
    PLAIN_RESIDUAL,
    RIVAL_THRESHOLDS,
    DetectorMethod,
    RivalMethod,
    Thresholds,
    plain_residual,
    rival_methods,
)
from viflow_anomaly.evaluation.detection_quality import MethodScores, SequenceKey, measure_detection
from viflow_anomaly.evaluation.labelled_pairs import open_labelled
from viflow_anomaly.evaluation.rivals import RIVALS, Evidence
from viflow_anomaly.model.builder import build_model
from viflow_anomaly.sensor_data import FramePair

GOOD = DrawnMethod("good", {LOW: [(MOVER, 0.9)]})
# Under LOW the false alarm comes first, under HIGH there is none.
RIVAL = DrawnMethod("rival", {LOW: [(MOVER, 0.7), (ELSEWHERE, 0.8)], HIGH: [(MOVER, 0.6)]}, rival=True)


def test_groups_sequences_and_everything() -> None:
    sequences = [DrawnPairs("drone_1", "drone", 2), DrawnPairs("drone_2", "drone", 3), DrawnPairs("car_1", "car", 1)]
    steps: list[tuple[int, int]] = []
    run = measure_detection([GOOD, RIVAL], sequences, on_progress=lambda done, total: steps.append((done, total)))
    assert steps == [(k, 6) for k in range(1, 7)]
    assert list(run.sequences) == [SequenceKey("drone", "drone_1"), SequenceKey("drone", "drone_2"), ("car", "car_1")]
    frames = {name: by["good"].findings[LOW].boxes.frames for name, by in run.groups().items()}
    assert frames == {"car": 1, "drone": 5}
    total = run.total()["good"].findings[LOW].boxes.summary()
    assert (total["frames"], total["movers"], total["roi_ap"], total["seconds"]) == (6, 6, 1.0, 0.6)
    assert run.total()["good"].pixels.average_precision() == pytest.approx(1.0)
    assert run.total()["good"].findings[LOW].masks.iou() == 1.0


def test_a_rival_gets_the_thresholds_that_are_best_for_it() -> None:
    run = measure_detection([RIVAL], [DrawnPairs("drone_1", "drone")])
    scores = run.total()["rival"]
    assert scores.findings[LOW].boxes.average_precision() == 0.5
    assert scores.best() == HIGH
    assert measure_detection([RIVAL], [DrawnPairs("a_1", "a", movers=())]).total()["rival"].best() is None
    assert MethodScores().best() is None


def test_every_nth_pair() -> None:
    run = measure_detection([GOOD], [DrawnPairs("drone_1", "drone", 5), DrawnPairs("car_1", "car", 2)], every=2)
    assert run.total()["good"].findings[LOW].boxes.frames == 4


def test_boxes_alone_give_no_pixel_measure() -> None:
    scores = measure_detection([GOOD], [DrawnPairs("kitti_1", "kitti", masks=False)]).total()["good"]
    assert scores.findings[LOW].boxes.average_precision() == 1.0
    assert (scores.pixels.frames, scores.findings[LOW].masks.iou()) == (0, None)


def test_a_pair_that_cannot_be_used_counts_for_no_method() -> None:
    run = measure_detection([GOOD, RIVAL], [DrawnPairs("drone_1", "drone", 3, unusable=[1])])
    assert run.skipped == {"imu_not_covering": 1}
    assert {by.findings[LOW].boxes.frames for by in run.total().values()} == {2}
    with pytest.raises(DatasetError) as caught:
        measure_detection([GOOD], [DrawnPairs("drone_1", "drone", 2, unusable=[0, 1])])
    assert caught.value.code == "ground_truth_missing"


def test_a_method_without_an_answer_is_left_out_where_it_has_none() -> None:
    silent = DrawnMethod("silent", {LOW: []}, answers=lambda pair: False)
    run = measure_detection([GOOD, silent], [DrawnPairs("drone_1", "drone")])
    assert list(run.total()) == ["good"]
    assert list(run.rivals) == ["good", "silent"]


def test_each_method_sees_the_motor_command_that_it_needs() -> None:
    plain, motor = DrawnMethod("plain", {LOW: []}), DrawnMethod("motor", {LOW: []}, motor_source="command")
    measure_detection([plain, motor], [DrawnPairs("drone_1", "drone", 1)])
    assert [pair.motor_command is None for pair in (*plain.seen, *motor.seen)] == [True, False]


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> AnomalyDetector:
    config = ModelConfig(hypotheses=4)
    path = tmp_path_factory.mktemp("model") / "m.safetensors"
    return AnomalyDetector.from_checkpoint(save_checkpoint(path, build_model(config), config, name="m", version="0"))


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> FramePair:
    folder = tmp_path_factory.mktemp("world") / "drone_1"
    return open_labelled(add_movers(add_ground_truth(folder, make_world(frames=3)))).pair(0)


def test_a_detector_is_measured_as_a_user_runs_it(detector: AnomalyDetector, two: FramePair) -> None:
    regions = RegionConfig(min_residual_gray=3.0, threshold_mads=2.0)
    configured = detector.with_config(DetectorConfig(regions=regions, evidence="residual"))
    method = DetectorMethod(OURS, configured)
    judgement = method.judge(two)
    detection = configured.detect(two)
    (finding,) = judgement.findings
    assert finding.thresholds == Thresholds(2.0, 3.0)
    assert len(finding.boxes) == len(detection.rois) > 0
    assert [box.score for box in finding.boxes] == [roi.score for roi in detection.rois]
    areas = [roi.area_px for roi in detection.rois if roi.label == "independent_motion"]
    assert np.count_nonzero(finding.motion) == sum(areas)
    assert not method.rival


def test_learned_evidence_is_cut_at_a_probability(two: FramePair) -> None:
    regions = RegionConfig(min_motion_probability=0.3)
    method = DetectorMethod(OURS, AnomalyDetector.from_checkpoint(config=DetectorConfig(regions=regions)))
    judgement = method.judge(two)
    (finding,) = judgement.findings
    assert finding.thresholds == Thresholds(min_motion_probability=0.3)
    assert 0 <= judgement.evidence.min() <= judgement.evidence.max() <= 1


def test_a_rival_is_cut_at_every_threshold_with_the_papers_rule(two: FramePair) -> None:
    evidence = np.zeros(two.source.image.shape, np.float32)
    evidence[5:25, 5:25] = 30.0
    inside = np.ones(evidence.shape, np.bool_)
    config = RegionConfig(shape_rule="none", smoothing_fraction=0, opening_fraction=0, closing_fraction=0)
    method = RivalMethod("drawn", lambda _: Evidence(evidence, inside), config)
    judgement = method.judge(two)
    assert judgement is not None
    assert tuple(finding.thresholds for finding in judgement.findings) == RIVAL_THRESHOLDS
    found = {finding.thresholds.min_residual_gray: len(finding.boxes) for finding in judgement.findings}
    assert found == {6.0: 1, 12.0: 1, 24.0: 1, 48.0: 0}
    assert np.count_nonzero(judgement.findings[0].motion) == 400
    assert RivalMethod("silent", lambda _: None, config).judge(two) is None


def test_the_plain_residual_is_the_papers_whatever_is_configured(detector: AnomalyDetector, two: FramePair) -> None:
    fancy = DetectorConfig(photometric_compensation=True, residual="minimum")
    judged = [plain_residual(detector.with_config(config)).judge(two) for config in (fancy, DetectorConfig())]
    off = DetectorConfig.model_validate(
        {
            "evidence": "residual",
            "photometric_compensation": False,
            "correction": {"enabled": False},
            "regions": {"texture_softening_gray": 0},
        }
    )
    paper = DetectorMethod("paper", detector.with_config(off)).judge(two)
    for judgement in judged:
        assert judgement is not None
        np.testing.assert_array_equal(judgement.evidence, paper.evidence)


def test_all_rivals_or_some(detector: AnomalyDetector) -> None:
    assert [method.name for method in rival_methods(detector)] == [PLAIN_RESIDUAL, *RIVALS]
    assert [method.name for method in rival_methods(detector, ["gyro difference"])] == ["gyro difference"]
