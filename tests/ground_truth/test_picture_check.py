"""The check tells right ground truth from wrong: a textured world that moves by two pixels a frame."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from simulated_truth import add_ground_truth
from worlds import make_world

from viflow_anomaly.datasets.ground_truth_folder import GroundTruthFolder
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.ground_truth.picture_check import PictureCheck, check_pair


def check(folder: Path, shift_px: float) -> PictureCheck:
    add_ground_truth(folder, make_world(frames=2), shift_px=shift_px)
    found = check_pair(open_recording(folder), GroundTruthFolder(folder), 0)
    assert found is not None
    return found


def test_right_truth_agrees(tmp_path: Path) -> None:
    found = check(tmp_path, 2.0)
    assert found.flow_px == pytest.approx(2.0)
    assert found.distance_px < 0.1
    assert found.warped_gray < 0.01 * found.identity_gray


def test_reversed_truth_does_not(tmp_path: Path) -> None:
    found = check(tmp_path, -2.0)
    assert found.distance_px == pytest.approx(4.0, abs=0.2)
    assert found.warped_gray > found.identity_gray


def test_without_a_valid_pixel_there_is_nothing_to_say(tmp_path: Path) -> None:
    add_ground_truth(tmp_path, make_world(frames=2), valid=np.zeros((64, 96), np.bool_))
    assert check_pair(open_recording(tmp_path), GroundTruthFolder(tmp_path), 0) is None


SCRIPT = Path(__file__).parents[2] / "benchmarks" / "check_ground_truth.py"


def run_script(folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, SCRIPT, folder, folder], capture_output=True, text=True, check=False)


def test_the_script_prints_medians_or_says_what_is_missing(tmp_path: Path) -> None:
    add_ground_truth(tmp_path / "right", make_world(frames=3))
    printed = json.loads(run_script(tmp_path / "right").stdout)
    assert (printed["pairs"], printed["flow_px"]) == (2, 2.0)
    shutil.rmtree(tmp_path / "right" / "mav0" / "groundtruth0" / "static_flow")
    add_ground_truth(tmp_path / "unknown", make_world(frames=2), valid=np.zeros((64, 96), np.bool_))
    for name, words in (("right", "expected stored flow"), ("unknown", "expected flow at pixels with texture")):
        answer = run_script(tmp_path / name)
        assert (answer.returncode, answer.stdout) == (1, "")
        assert words in answer.stderr
