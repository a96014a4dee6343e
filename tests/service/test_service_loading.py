"""The loader's warm-up: readiness waits for it, and a model that takes no such pair is ready all the same."""

from __future__ import annotations

import numpy as np
import pytest
from rule_detector import RuleDetector

from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly_service.detector_loading import example_pair, warm_up


def test_the_made_up_pair_moves_by_a_pixel() -> None:
    pair = example_pair(width=101, height=67)
    assert pair.source.image.shape == pair.target.image.shape == (67, 101)
    assert np.array_equal(pair.source.image[:, 1:], pair.target.image[:, :-1])
    assert pair.imu.timestamps_ns[0] < pair.source.timestamp_ns < pair.target.timestamp_ns < pair.imu.timestamps_ns[-1]


def test_warm_up_judges_a_pair_of_the_size(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    detector = RuleDetector()
    warm_up(detector, width=96, height=64)
    assert [pair.source.image.shape for pair, _ in detector.calls] == [(64, 96)]
    assert "warmed_up" in caplog.messages


def test_a_model_that_does_not_take_the_pair_stays_cold(caplog: pytest.LogCaptureFixture) -> None:
    refusing = RuleDetector(error=InvalidInputError("expected a command", code="motor_command_missing", field="motor"))
    warm_up(refusing, width=96, height=64)
    assert "not_warmed_up" in caplog.messages
    with pytest.raises(ValueError, match="our fault"):
        warm_up(RuleDetector(error=ValueError("our fault")), width=96, height=64)
