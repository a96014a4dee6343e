"""KITTI scene flow as ground truth of ``evaluate flow``: pairs by drive, movers, motor inputs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from kitti_worlds import frame_stamps, write_raw_drive, write_sceneflow
from worlds import write_png

from viflow_anomaly.cli.main import run
from viflow_anomaly.datasets.ground_truth_png import write_flow_png
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.evaluation.sceneflow_truth import is_scene_flow, open_scene_flow

DRIVES = ("2011_09_26_drive_0005", "2011_09_26_drive_0011")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for drive in DRIVES:
        write_raw_drive(tmp_path / "raw_data", drive)
    lines = [
        f"2011_09_26 {drive}_sync {frame:010d}" for drive, frame in ((DRIVES[1], 2), (DRIVES[0], 3), (DRIVES[1], 4))
    ]
    return write_sceneflow(tmp_path / "data_scene_flow", lines)


def test_one_truth_for_each_drive(root: Path, tmp_path: Path) -> None:
    assert is_scene_flow(root)
    assert not is_scene_flow(tmp_path)
    first, second = open_scene_flow(root)
    assert [(truth.sequence, len(truth)) for truth in (first, second)] == [(DRIVES[0], 1), (DRIVES[1], 2)]
    stamps = frame_stamps(6)
    assert second.name(1) == (DRIVES[1], 1, stamps[4], stamps[5])
    assert second.pair(1).source.timestamp_ns == stamps[4]


def test_pixels_of_moving_cars_can_be_left_out(root: Path) -> None:
    everywhere = np.ones((64, 96), bool)
    write_flow_png(root / "training" / "flow_occ" / "000001_10.png", np.ones((64, 96, 2), np.float32), everywhere)
    with_movers, without = (open_scene_flow(root, movers=movers)[0].truth(0) for movers in (True, False))
    np.testing.assert_array_equal(with_movers.flow_px, without.flow_px)
    moving = with_movers.valid & ~without.valid
    assert 0 < moving.sum() < with_movers.valid.sum()


def test_the_command_takes_the_benchmark(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["evaluate", "flow", str(root), "--checkpoint", "none", "--methods", "identity", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["all"]["identity"]["pairs"] == 3
    assert list(report["sequences"]) == list(DRIVES)


@pytest.mark.parametrize(
    "more", [("--look-aheads", "2"), ("--ground-truth", "."), ("--test-part", "--set", "training.split.rule=blocks")]
)
def test_what_has_no_meaning_for_the_benchmark_is_refused(
    root: Path, more: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["evaluate", "flow", str(root), "--checkpoint", "none", "--methods", "identity", *more]) == 2
    assert "scene_flow_options" in capsys.readouterr().err


def test_a_displacement_needs_the_mounting(root: Path) -> None:
    truth = open_scene_flow(root)[0]
    np.testing.assert_allclose(truth.pair(0, "displacement").motor_command, np.zeros(3), atol=1e-6)  # it only turns
    command = truth.pair(0, "command").motor_command
    assert command is not None
    assert command.shape == (1,)
    for calibration in root.parent.rglob("calib_imu_to_velo.txt"):
        calibration.unlink()
    with pytest.raises(DatasetError) as caught:
        open_scene_flow(root)[0].pair(0, "displacement")
    assert (caught.value.code, caught.value.field) == ("trajectory_missing", "motor_command")


def test_a_map_of_objects_of_another_size_is_named(root: Path) -> None:
    write_png(root / "training" / "obj_map" / "000001_10.png", np.zeros((10, 10), np.uint8))
    with pytest.raises(DatasetError, match=r"shape \(64, 96\), found \(10, 10\)") as caught:
        open_scene_flow(root, movers=False)[0].truth(0)
    assert caught.value.code == "ground_truth_malformed"
