from __future__ import annotations

from pathlib import Path

import pytest
from difference_detector import DifferenceDetector
from pair_world import Ask, PairFolder, answer_to, write_pair_folder

from viflow_anomaly.alarm_calibration import calibrated
from viflow_anomaly.settings import Settings


@pytest.fixture
def pair(tmp_path: Path) -> PairFolder:
    return write_pair_folder(tmp_path / "recording")


@pytest.fixture
def ask(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Ask:
    """Run a command line in this process with a detector that needs no network."""

    def load(settings: Settings) -> DifferenceDetector:
        return calibrated(DifferenceDetector(config=settings.detector), settings.calibration)

    for command in ("detect", "batch", "calibrate"):
        monkeypatch.setattr(f"viflow_anomaly.cli.{command}.load_detector", load)
    return lambda arguments: answer_to(arguments, capsys)
