"""The report of a measurement, its tables and its charts."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from drawn_methods import ELSEWHERE, HIGH, LOW, MOVER, DrawnMethod, DrawnPairs

from viflow_anomaly.detection import ModelInfo
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.evaluation.detection_methods import Thresholds
from viflow_anomaly.evaluation.detection_plots import (
    draw_detection_figures,
    precision_by_class,
    precision_recall,
    recall_by_alarms,
)
from viflow_anomaly.evaluation.detection_quality import measure_detection
from viflow_anomaly.evaluation.detection_report import CURVE_POINTS, detection_report
from viflow_anomaly.evaluation.detection_tables import class_tables, markdown, notes, report_tables, sequence_table
from viflow_anomaly.evaluation.labelled_pairs import TrueObject
from viflow_anomaly.regions import BoundingBox

MODEL = ModelInfo(name="drawn", version="1", sha256="ab" * 32)
OURS = DrawnMethod("ours", {LOW: [(MOVER, 0.9), (ELSEWHERE, 0.6)]})
RIVAL = DrawnMethod("rival|2", {LOW: [(MOVER, 0.7), (ELSEWHERE, 0.8)], HIGH: [(MOVER, 0.6)]}, rival=True)
LARGE = TrueObject(BoundingBox(20, 0, 60, 60), 9.0, counted=True)


def report_of(*sequences: DrawnPairs) -> dict[str, Any]:
    run = measure_detection([OURS, RIVAL], list(sequences))
    return detection_report(run, MODEL, {"include_masks": False}, options={"every": 1})


@pytest.fixture(scope="module")
def report() -> dict[str, Any]:
    movers = (TrueObject(MOVER, 4.0, counted=True), LARGE)
    return report_of(
        DrawnPairs("drone_1", "drone", 2, movers=movers),
        DrawnPairs("drone_2", "drone", 1, unusable=[0]),
        DrawnPairs("empty_1", "empty", 3, movers=()),
        DrawnPairs("kitti_1", "kitti 96x64", 1, masks=False),
    )


def test_the_report_is_json_and_says_what_it_means(report: dict[str, Any]) -> None:
    assert json.loads(json.dumps(report, allow_nan=False)) == report
    assert report["model"] == {"name": "drawn", "version": "1", "sha256": "ab" * 32}
    assert report["methods"] == {"ours": {"best_thresholds": False}, "rival|2": {"best_thresholds": True}}
    assert report["rules"]["size_classes_box_px"] == {"small": [0, 400], "medium": [400, 2500], "large": [2500, None]}
    assert report["skipped_pairs"] == {"imu_not_covering": 1}
    assert report["options"] == {"every": 1}


def test_figures_of_a_group(report: dict[str, Any]) -> None:
    ours = report["groups"]["drone"]["ours"]
    assert (ours["frames"], ours["movers"], ours["roi_ap"]) == (2, 4, 0.5)
    assert (ours["recall"], ours["precision"]) == (0.5, 0.5)
    assert (ours["false_alarms_per_frame"], ours["false_alarms_per_minute"]) == (1.0, 600.0)
    # 100 px of the small mover are found; LARGE covers 60 x 60, of which ELSEWHERE covers 100.
    assert ours["pixel_iou"] == pytest.approx(200 / 3700, abs=1e-4)
    assert {name: one["roi_ap"] for name, one in ours["by_size"].items()} == {
        "small": 0.5 * 2,
        "medium": None,
        "large": 0,
    }
    assert {name: one["movers"] for name, one in ours["by_speed"].items()} == {"slow": 0, "medium": 2, "fast": 2}
    assert ours["curve"]["recall"] == [0.0, 0.5, 0.5]
    assert ours["curve"]["false_alarms_per_frame"] == [0.0, 0.0, 1.0]


def test_boxes_alone_have_no_pixel_figures(report: dict[str, Any]) -> None:
    kitti = report["groups"]["kitti 96x64"]["ours"]
    assert [kitti[name] for name in ("pixel_ap", "pixel_iou_best", "pixel_iou")] == [None] * 3
    assert kitti["roi_ap"] == 1.0


def test_thresholds_are_the_best_of_the_scope_else_of_everything(report: dict[str, Any]) -> None:
    rivals = {name: one["rival|2"] for name, one in report["groups"].items()}
    assert rivals["drone"]["threshold_mads"] == HIGH.threshold_mads
    assert rivals["empty"]["threshold_mads"] == HIGH.threshold_mads
    assert rivals["empty"]["false_alarms_per_frame"] == 1.0  # of MOVER, which is none there
    assert report["sequences"]["empty_1"]["methods"]["rival|2"]["roi_ap"] is None
    nothing = report_of(DrawnPairs("empty_1", "empty", 3, movers=()))
    assert nothing["all"]["rival|2"]["threshold_mads"] == LOW.threshold_mads
    assert nothing["all"]["rival|2"]["curve"] is None


def test_the_thresholds_are_told_in_their_own_unit() -> None:
    learned = DrawnMethod("learned", {Thresholds(min_motion_probability=0.4): [(MOVER, 0.9)]})
    run = measure_detection([OURS, learned], [DrawnPairs("drone_1", "drone", 1)])
    told = {row[0]: row[-1] for row in report_tables(detection_report(run, MODEL, {}))[0].rows}
    assert told == {"ours": "3 MAD, 6", "learned": "p > 0.4"}


def test_a_long_curve_is_thinned() -> None:
    many = {LOW: [(ELSEWHERE, 0.5 + k / 1000) for k in range(300)]}
    run = measure_detection([DrawnMethod("many", many)], [DrawnPairs("drone_1", "drone", 1)])
    curve = detection_report(run, MODEL, {})["all"]["many"]["curve"]
    assert len(curve["recall"]) == CURVE_POINTS
    assert curve["false_alarms_per_frame"][-1] == 300


def test_sequences_of_one_name_stay_apart() -> None:
    report = report_of(DrawnPairs("drone_1", "a"), DrawnPairs("drone_1", "b"), DrawnPairs("drone_2", "b"))
    assert list(report["sequences"]) == ["a/drone_1", "b/drone_1", "drone_2"]


def test_tables(report: dict[str, Any]) -> None:
    titles = [table.title for table in report_tables(report)]
    assert titles == [
        "drone: 4 movers in 2 frames",
        "empty: 0 movers in 3 frames",
        "kitti 96x64: 1 mover in 1 frame",
        "all frames: 5 movers in 6 frames",
    ]
    drone, empty, kitti, _ = report_tables(report)
    assert drone.rows[0][:2] == ("ours", "0.500")
    assert drone.rows[1][-1] == "6 MAD, 12"
    assert "pixel AP" in drone.heads
    assert "pixel AP" not in kitti.heads
    assert "ROI AP" not in empty.heads
    assert [table.heads for table in class_tables(report)] == [
        ("method", "size small (2)", "size large (2)", "speed medium (2)", "speed fast (2)"),
        ("method", "size small (1)", "speed medium (1)"),
        ("method", "size small (3)", "size large (2)", "speed medium (3)", "speed fast (2)"),
    ]
    assert sequence_table(report).rows[1][:3] == ("empty_1", "empty", "0")
    assert {len(row) for row in sequence_table(report).rows} == {5}


def test_notes_and_markdown(report: dict[str, Any]) -> None:
    text = markdown(report)
    assert text.startswith("# Regions against ground truth\n")
    assert "| rival\\|2 |" in text
    assert "in favour of: rival|2." in text
    assert "small 0 to 400, medium 400 to 2500, large from 2500" in text
    assert "imu_not_covering 1" in text
    alone = measure_detection([OURS], [DrawnPairs("drone_1", "drone")])
    assert not any("in favour" in line for line in notes(detection_report(alone, MODEL, {})))


def test_charts_of_every_scope_with_movers(tmp_path: Path) -> None:
    report = report_of(DrawnPairs("drone_1", "drone 96x64"), DrawnPairs("empty_1", "empty", movers=()))
    pictures = draw_detection_figures(tmp_path / "new", report)
    kinds = ("precision-recall", "recall-alarms", "ap-classes", "reliability")
    assert [picture.png.stem for picture in pictures] == [
        f"{kind}-{scope}" for scope in ("drone_96x64", "all") for kind in kinds
    ]
    assert all(picture.png.read_bytes().startswith(b"\x89PNG") for picture in pictures)
    assert all(picture.pdf.read_bytes().startswith(b"%PDF") for picture in pictures)
    again = precision_by_class(report["all"], tmp_path / "again", title="all")
    assert again.png.read_bytes() == pictures[-2].png.read_bytes()


def test_charts_of_nothing_are_refused(report: dict[str, Any], tmp_path: Path) -> None:
    empty = report["groups"]["empty"]
    for draw in (precision_recall, recall_by_alarms, precision_by_class):
        with pytest.raises(InvalidInputError) as caught:
            draw(empty, tmp_path / "none")
        assert caught.value.code == "plot_empty"
