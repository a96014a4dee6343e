"""The loader's warm-up: readiness waits for it, and a model that takes no such pair is ready all the same."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from rule_detector import RuleDetector
from service_world import live_server

from viflow_anomaly.detection import Detection
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.sensor_data import FramePair
from viflow_anomaly_service.detector_loading import example_pair, warm_up
from viflow_anomaly_service.settings import WarmUpCamera


def test_the_made_up_pair_moves_by_a_pixel() -> None:
    pair = example_pair(WarmUpCamera(101, 67, None))
    assert pair.source.image.shape == pair.target.image.shape == (67, 101)
    assert np.array_equal(pair.source.image[:, 1:], pair.target.image[:, :-1])
    assert pair.imu.timestamps_ns[0] < pair.source.timestamp_ns < pair.target.timestamp_ns < pair.imu.timestamps_ns[-1]


def test_warm_up_judges_a_pair_of_the_size(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    detector = RuleDetector()
    warm_up(detector, WarmUpCamera(96, 64, 70.5))
    assert [pair.source.image.shape for pair, _ in detector.calls] == [(64, 96)]
    camera = detector.calls[0][0].camera
    assert camera is not None
    assert (camera.fx, camera.cx, camera.width) == (70.5, 47.5, 96)
    assert "warmed_up" in caplog.messages


def test_a_model_that_does_not_take_the_pair_stays_cold(caplog: pytest.LogCaptureFixture) -> None:
    refusing = RuleDetector(error=InvalidInputError("expected a command", code="motor_command_missing", field="motor"))
    warm_up(refusing, WarmUpCamera(96, 64, None))
    assert "not_warmed_up" in caplog.messages
    with pytest.raises(ValueError, match="our fault"):
        warm_up(RuleDetector(error=ValueError("our fault")), WarmUpCamera(96, 64, None))


def test_every_worker_is_warm_before_the_service_is_ready() -> None:
    threads: set[str] = set()

    class Noting(RuleDetector):
        def detect(self, pair: FramePair, *, decode_ms: float = 0.0) -> Detection:
            threads.add(threading.current_thread().name)
            return super().detect(pair, decode_ms=decode_ms)

    detector = Noting()
    with live_server(lambda settings: detector, max_concurrent=3, warm_up="96x64,64x48@50"):
        assert threads == {"detect-0", "detect-1", "detect-2"}
        assert len(detector.calls) == 3 * 2
