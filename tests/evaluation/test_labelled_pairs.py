"""What is to be found in a frame, and what counts neither way."""

from __future__ import annotations

from pathlib import Path

import pytest
from simulated_truth import add_ground_truth, add_movers
from worlds import REAL_DATA, car_world, make_world, write_euroc, write_kitti_raw, write_lines

from viflow_anomaly.datasets.ground_truth_folder import GroundTruthFolder
from viflow_anomaly.datasets.kitti_labels import MOTION_COLUMNS, MOTION_FILE
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.evaluation.labelled_pairs import (
    KittiPairs,
    SimulatedPairs,
    TrueObject,
    every_nth,
    labels_of,
    open_labelled,
)
from viflow_anomaly.regions import BoundingBox


def test_labels_come_from_the_ground_truth(tmp_path: Path) -> None:
    folder = add_movers(add_ground_truth(tmp_path / "drone_1", make_world(frames=3)))
    truth = GroundTruthFolder.find(folder)
    assert truth is not None
    labels = labels_of(truth, int(open_recording(folder).frame_timestamps_ns[0]))
    assert labels.objects == (
        TrueObject(BoundingBox(30, 10, 14, 10), 4.0, counted=True),
        TrueObject(BoundingBox(5, 30, 10, 10), 0.5, counted=False),
    )
    assert labels.objects[0].box_area_px == 140
    assert labels.pixels is not None
    assert (labels.pixels.moving.sum(), labels.pixels.ignored.sum()) == (140, 100)
    assert labels.pixels.moving[10, 30]
    assert labels.pixels.ignored[39, 14]


def test_a_simulated_sequence(tmp_path: Path) -> None:
    folder = add_movers(add_ground_truth(tmp_path / "drone_1", make_world(frames=3)))
    pairs = open_labelled(folder)
    assert isinstance(pairs, SimulatedPairs)
    assert (pairs.sequence, pairs.group, len(pairs)) == ("drone_1", "drone", 2)
    assert SimulatedPairs(folder, group="drone 96x64").group == "drone 96x64"
    assert len(pairs.labels(1).objects) == 2
    stamps = open_recording(folder).frame_timestamps_ns.tolist()
    assert [pairs.pair(1).source.timestamp_ns, pairs.pair(1).target.timestamp_ns] == stamps[1:]
    assert every_nth([pairs, pairs], 2) == [(pairs, 0), (pairs, 0)]


def test_what_holds_no_movers_is_refused(tmp_path: Path) -> None:
    one = add_movers(add_ground_truth(tmp_path / "drone_1", make_world(frames=1)))
    static = add_ground_truth(tmp_path / "drone_2", make_world(frames=3))
    for folder in (write_euroc(tmp_path / "V1_01"), one, static):
        with pytest.raises(DatasetError) as caught:
            open_labelled(folder)
        assert caught.value.code == "ground_truth_missing"


def drive(tmp_path: Path, rows: list[str], labels: dict[int, list[str]] | None = None) -> Path:
    folder = write_kitti_raw(tmp_path, car_world(frames=5))
    path = folder.parent / "calib_cam_to_cam.txt"  # labels belong to a picture twice as large
    write_lines(path, path.read_text().replace("S_rect_02: 96 64", "S_rect_02: 192 128").splitlines())
    write_lines(folder / MOTION_FILE, [",".join(MOTION_COLUMNS), *rows])
    for frame, lines in (labels or {}).items():
        write_lines(folder / "label_2" / f"{frame:010d}.txt", lines)
    return folder


def row(frame: int, kind: str, box: tuple[float, ...], moving: str) -> str:
    return f"{frame},0,{kind},{','.join(map(str, box))},0.00,0,0,1.7,20.0,,{moving}"


def test_only_labelled_frames_of_a_kitti_drive_are_judged(tmp_path: Path) -> None:
    box = (20.0, 20.0, 40.0, 40.0)
    rows = [
        row(1, "Car", box, "1"),
        row(1, "Car", (60.0, 20.0, 80.0, 40.0), "0"),
        row(1, "Pedestrian", (100.0, 20.0, 110.0, 40.0), "?"),
        row(1, "Cyclist", (120.0, 20.0, 130.0, 40.0), ""),
        row(1, "Car", (150.0, 20.0, 152.0, 22.0), "1"),
        row(1, "Van", (180.0, 66.0, 300.0, 900.0), "1"),
        row(3, "Car", box, "0"),
        row(4, "Car", box, "1"),
    ]
    dont_care = "DontCare -1 -1 -10 0.0 0.0 19.0 19.0 -1 -1 -1 -1000 -1000 -1000 -10"
    folder = drive(tmp_path, rows, {1: [dont_care]})
    pairs = open_labelled(folder)
    assert isinstance(pairs, KittiPairs)
    assert (pairs.sequence, pairs.group) == ("2011_09_26_drive_0001_sync", "kitti 96x64")
    assert len(pairs) == 2  # frames 1 and 3; the last frame has no next one
    labels = pairs.labels(0)
    assert labels.pixels is None
    assert labels.objects == (
        TrueObject(BoundingBox(10, 10, 11, 11), None, counted=True),
        TrueObject(BoundingBox(50, 10, 6, 11), None, counted=False),
        TrueObject(BoundingBox(60, 10, 6, 11), None, counted=False),
        TrueObject(BoundingBox(75, 10, 2, 2), None, counted=False),  # too small to judge
        TrueObject(BoundingBox(90, 33, 6, 31), None, counted=True),  # cut at the picture's edges
        TrueObject(BoundingBox(0, 0, 10, 10), None, counted=False),
    )
    assert pairs.labels(1).objects == ()  # what rests is background
    stamps = open_recording(folder).frame_timestamps_ns.tolist()
    assert [pairs.pair(index).source.timestamp_ns for index in range(2)] == [stamps[1], stamps[3]]
    commands = {source: pairs.pair(0, source).motor_command for source in ("command", "displacement")}
    assert {source: None if one is None else one.size for source, one in commands.items()} == {
        "command": 1,
        "displacement": 3,
    }


def test_a_box_beside_the_picture_is_none(tmp_path: Path) -> None:
    pairs = KittiPairs(drive(tmp_path, [row(1, "Car", (300.0, 20.0, 340.0, 40.0), "1")]))
    assert pairs.labels(0).objects == ()


def test_a_kitti_drive_without_a_labelled_pair_is_refused(tmp_path: Path) -> None:
    folder = drive(tmp_path, [row(4, "Car", (20.0, 20.0, 40.0, 40.0), "1")])
    with pytest.raises(DatasetError, match="label_motion_derived") as caught:
        open_labelled(folder)
    assert caught.value.code == "ground_truth_missing"


@pytest.mark.parametrize(
    ("name", "frames", "movers", "group"),
    [
        ("0005", 10, 18, "kitti 400x120"),
        ("0011", 42, 29, "kitti 1242x375"),
        ("0027", 25, 34, "kitti 400x120"),
    ],
)
def test_real_drives(name: str, frames: int, movers: int, group: str) -> None:
    path = REAL_DATA / "kitti" / "2011_09_26" / f"2011_09_26_drive_{name}_sync"
    if not path.is_dir():
        pytest.skip(f"no real data at {path}; set VIFLOW_REAL_DATA to the folder that holds it")
    pairs = open_labelled(path)
    objects = [thing for index in range(len(pairs)) for thing in pairs.labels(index).objects]
    assert (len(pairs), sum(thing.counted for thing in objects), pairs.group) == (frames, movers, group)
    height, width = pairs.pair(0).source.image.shape
    assert all(0 <= one.bbox.x <= one.bbox.x + one.bbox.width <= width for one in objects)
    assert all(0 <= one.bbox.y <= one.bbox.y + one.bbox.height <= height for one in objects)
