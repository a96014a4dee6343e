"""What a prediction says of itself agrees with what the detector did with it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from viflow_anomaly.config import CorrectionConfig, DetectorConfig
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.inspection import ARROWS_ACROSS, flow_arrows, pair_signs, view_hypotheses
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples, PinholeCamera

SAMPLE = Path(__file__).parents[1] / "samples" / "drone"


@pytest.fixture(scope="module")
def pair() -> FramePair:
    imu = json.loads((SAMPLE / "imu.json").read_text(encoding="utf-8"))
    frames = []
    for name in ("source", "target"):
        image = cv2.imread(str(SAMPLE / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        frames.append(Frame(imu[f"{name}_timestamp_ns"], np.asarray(image, np.uint8)))
    samples = ImuSamples(*(np.array(imu[name]) for name in ("timestamps_ns", "gyro_rad_s", "accel_m_s2")))
    camera = PinholeCamera(**json.loads((SAMPLE / "camera.json").read_text(encoding="utf-8")))
    return FramePair(frames[0], frames[1], samples, camera)


@pytest.fixture(scope="module")
def detector() -> AnomalyDetector:
    return AnomalyDetector.from_checkpoint()


def test_the_winner_has_the_smallest_error_and_the_correction_a_smaller_one(
    detector: AnomalyDetector, pair: FramePair
) -> None:
    analysis = detector.analyze(pair)
    view = view_hypotheses(analysis.predicted, analysis.model_input)
    assert len(view.errors) == 8
    errors = [error for error in view.errors if error is not None]
    assert view.winner == analysis.predicted.hypothesis == int(np.argmin(errors))
    assert view.corrected_error is not None
    assert view.corrected_error < min(errors)


def test_numbers_that_are_none_are_left_out(detector: AnomalyDetector, pair: FramePair) -> None:
    analysis = detector.analyze(pair)
    damaged = analysis.predicted._replace(hypotheses_px=np.full_like(analysis.predicted.hypotheses_px, np.nan))
    assert view_hypotheses(damaged, analysis.model_input).errors[0] is not None  # what leaves the picture costs nothing
    correction = analysis.predicted.correction
    assert correction is not None
    unknown = analysis.predicted._replace(correction=correction._replace(turned_rad=np.nan))
    assert pair_signs(pair, unknown).turn_error_rad_s is None


def test_without_a_correction_there_is_nothing_to_say_of_it(detector: AnomalyDetector, pair: FramePair) -> None:
    plain = detector.with_config(DetectorConfig(correction=CorrectionConfig(enabled=False)))
    analysis = plain.analyze(pair)
    assert view_hypotheses(analysis.predicted, analysis.model_input).corrected_error is None
    signs = pair_signs(pair, analysis.predicted)
    assert (signs.inlier_share, signs.turn_error_rad_s) == (None, None)
    assert signs.imu_rate_hz == pytest.approx(200)
    assert pair_signs(pair, None) == signs


def test_signs_tell_a_gap_and_how_far_the_turn_was_off(detector: AnomalyDetector, pair: FramePair) -> None:
    predicted = detector.analyze(pair).predicted
    assert predicted.correction is not None
    signs = pair_signs(pair, predicted)
    assert signs.imu_largest_gap_ms == pytest.approx(5)
    assert signs.turn_error_rad_s == pytest.approx(predicted.correction.turned_rad / 0.05, abs=1e-4)
    kept = np.delete(np.arange(len(pair.imu.timestamps_ns)), [3, 4])
    imu = ImuSamples(pair.imu.timestamps_ns[kept], pair.imu.gyro_rad_s[kept])
    assert pair_signs(FramePair(pair.source, pair.target, imu), None).imu_largest_gap_ms == pytest.approx(15)
    lone = ImuSamples(pair.imu.timestamps_ns[:1], pair.imu.gyro_rad_s[:1])
    assert pair_signs(FramePair(pair.source, pair.target, lone), None) == (None, None, None, None)


def test_arrows_lie_on_a_grid_and_only_where_the_flow_is_known() -> None:
    flow = np.full((96, 144, 2), (1.5, -2.0), np.float32)
    flow[:48, :, 0] = np.nan
    inside = np.ones((96, 144), np.bool_)
    inside[:, :72] = False
    arrows = flow_arrows(flow, inside)
    assert len(arrows) == (ARROWS_ACROSS // 2) * 8
    assert all(arrow.x >= 72 and arrow.y >= 48 and (arrow.du, arrow.dv) == (1.5, -2.0) for arrow in arrows)
    assert flow_arrows(np.zeros((8, 8, 2), np.float32), np.zeros((8, 8), np.bool_)) == []
