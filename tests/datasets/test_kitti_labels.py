"""KITTI's labels of objects and what is known of their motion."""

from __future__ import annotations

from pathlib import Path

import pytest
from worlds import write_lines

from viflow_anomaly.datasets.kitti_labels import (
    MOTION_COLUMNS,
    MOTION_FILE,
    Box,
    LabelledObject,
    label_scale,
    read_labelled_objects,
)
from viflow_anomaly.errors import DatasetError

HEAD = ",".join(MOTION_COLUMNS)
CAR, VAN, FAR = Box(10.0, 20.0, 30.0, 40.0), Box(50.5, 20.0, 70.0, 35.25), Box(80.0, 20.0, 84.0, 22.0)


def row(frame: str, kind: str, box: Box, moving: str) -> str:
    return f"{frame},0,{kind},{box.left},{box.top},{box.right},{box.bottom},0.00,0,0,1.7,20.0,,{moving}"


def label(kind: str, box: Box) -> str:
    return f"{kind} 0.00 0 -1.5 {box.left} {box.top} {box.right} {box.bottom} 1.5 1.6 4.0 0.0 1.7 20.0 -1.5"


def test_motion_and_labels_are_joined_by_their_boxes(tmp_path: Path) -> None:
    rows = [row("3", "Car", CAR, "1"), row("3", "Van", VAN, "0"), row("4", "Pedestrian", CAR, "?")]
    write_lines(tmp_path / MOTION_FILE, [HEAD, *rows, row("4", "Car", VAN, "")])
    write_lines(tmp_path / "label_2" / "0000000003.txt", [label("Car", CAR), label("DontCare", FAR)])
    write_lines(tmp_path / "label_2" / "0000000009.txt", [label("Cyclist", CAR)])
    assert read_labelled_objects(tmp_path) == {
        3: [
            LabelledObject("Car", CAR, "moving"),
            LabelledObject("Van", VAN, "resting"),
            LabelledObject("DontCare", FAR, "unknown"),
        ],
        4: [LabelledObject("Pedestrian", CAR, "unknown"), LabelledObject("Car", VAN, "unknown")],
        9: [LabelledObject("Cyclist", CAR, "unknown")],
    }


def test_a_drive_without_labels(tmp_path: Path) -> None:
    assert read_labelled_objects(tmp_path) == {}


@pytest.mark.parametrize(("frame", "moving"), [("x", "0"), ("1" * 11, "0"), ("0", "maybe")])
def test_malformed_motions_are_named(tmp_path: Path, frame: str, moving: str) -> None:
    write_lines(tmp_path / MOTION_FILE, [HEAD, row(frame, "Car", CAR, moving)])
    with pytest.raises(DatasetError, match="line 2") as raised:
        read_labelled_objects(tmp_path)
    assert raised.value.code == "labels_malformed"


@pytest.mark.parametrize("line", ["Car 1 2 3", label("Car", CAR) + " 1"])
def test_malformed_labels_are_named(tmp_path: Path, line: str) -> None:
    write_lines(tmp_path / "label_2" / "0000000000.txt", [line])
    with pytest.raises(DatasetError, match=r"0000000000\.txt, line 1") as raised:
        read_labelled_objects(tmp_path)
    assert raised.value.code == "labels_malformed"


def test_the_scale_of_pictures_that_were_stored_smaller(tmp_path: Path) -> None:
    drive = tmp_path / "day" / "drive"
    drive.mkdir(parents=True)
    assert label_scale(drive, 621, 125) == (0.5, pytest.approx(1 / 3))
    calibration = tmp_path / "day" / "calib_cam_to_cam.txt"
    write_lines(calibration, ["R_rect_00: 1 0 0 0 1 0 0 0 1"])  # some publications leave the sizes out
    assert label_scale(drive, 621, 125) == (0.5, pytest.approx(1 / 3))
    write_lines(calibration, ["S_rect_02: 100 50"])
    assert label_scale(drive, 200, 200) == (2.0, 4.0)
