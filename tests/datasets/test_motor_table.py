"""Motor commands in the layouts: which row a frame gets, names, and tables that contradict themselves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds import WRITERS, make_world, write_euroc, write_kitti_odometry, write_lines, write_plain

from viflow_anomaly.datasets.motor_table import MAX_AGE_NS, read_motor
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.errors import DatasetError

HEADER = "#timestamp [ns],throttle,speed_m_s"
STAMPS = make_world().frame_timestamps_ns


def euroc(tmp_path: Path, rows: list[str], header: str = HEADER) -> Path:
    folder = write_euroc(tmp_path)
    write_lines(folder / "mav0" / "motor0" / "data.csv", [header, *rows])
    return folder


def expect(folder: Path, code: str, where: str) -> None:
    with pytest.raises(DatasetError) as caught:
        open_recording(folder)
    assert caught.value.code == code
    assert where in caught.value.message


def test_a_frame_gets_the_latest_row_at_or_before_it(tmp_path: Path) -> None:
    offsets = (-30_000_000, 0, 49_999_999, 50_000_001, 170_000_000)
    recording = open_recording(euroc(tmp_path, [f"{STAMPS[0] + k},{i},-{i}" for i, k in enumerate(offsets)]))
    assert recording.motor_names == ("throttle", "speed_m_s")
    found = [recording.motor_command(k) for k in range(6)]  # every 50 ms
    assert [command.tolist() for command in found if command is not None] == [
        [1, -1], [2, -2], [3, -3], [3, -3], [4, -4], [4, -4],
    ]  # fmt: skip
    command = RecordingPairs(recording)[2].motor_command
    assert command is not None
    assert command.tolist() == [3, -3]


@given(st.lists(st.integers(0, 400), min_size=1, max_size=20, unique=True))
def test_any_rows_agree_with_a_search_one_by_one(tmp_path_factory: pytest.TempPathFactory, offsets: list[int]) -> None:
    path = tmp_path_factory.mktemp("motor") / "data.csv"
    rows = sorted({0, *offsets})
    write_lines(path, ["#timestamp [ns],x", *(f"{row},{row}" for row in rows)])
    frames = np.arange(0, 500, 7, dtype=np.int64)
    names, commands = read_motor(path, frames)
    assert names == ("x",)
    assert commands is not None
    assert commands[:, 0].tolist() == [max(row for row in rows if row <= frame) for frame in frames]


def test_the_table_is_in_the_imus_clock(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path, make_world(time_offset_s=0.02))
    write_lines(folder / "mav0/motor0/data.csv", [HEADER, *(f"{STAMPS[0] + k * 10_000_000},{k},0" for k in range(40))])
    assert open_recording(folder).motor_command(0).tolist() == [2, 0]  # type: ignore[union-attr]


def test_no_table_no_names(tmp_path: Path) -> None:
    for name, writer in WRITERS.items():
        recording = open_recording(writer(tmp_path / name))
        command = recording.motor_command(0)
        assert len(recording.motor_names) == (0 if command is None else command.size)
        assert recording.motor_names == (("forward_speed_m_s",) if name.startswith("kitti_raw") else ())


def test_odometry_names_its_speed(tmp_path: Path) -> None:
    folder = write_kitti_odometry(tmp_path)
    write_lines(folder / "oxts_first6.txt", [" ".join(["0.5"] * 30)] * 6)
    assert open_recording(folder).motor_names == ("forward_speed_m_s",)


@pytest.mark.parametrize("first_ns", [1, -MAX_AGE_NS - 1])
def test_a_frame_without_a_row_in_the_second_before_it(first_ns: int, tmp_path: Path) -> None:
    folder = euroc(tmp_path, [f"{STAMPS[0] + first_ns},1,2", f"{STAMPS[1]},1,2"])
    expect(folder, "motor_not_covering", f"before frame 0 ({STAMPS[0]})")


def test_a_row_of_a_second_ago_still_holds(tmp_path: Path) -> None:
    folder = euroc(tmp_path, [f"{STAMPS[0] - MAX_AGE_NS},1,2", f"{STAMPS[1]},3,4"])
    assert open_recording(folder).motor_command(0).tolist() == [1, 2]  # type: ignore[union-attr]


def test_a_table_that_ends_in_the_middle(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path, make_world(frames=30))
    write_lines(folder / "mav0/motor0/data.csv", [HEADER, f"{STAMPS[0]},1,2"])
    expect(folder, "motor_not_covering", "before frame 21 ")


@pytest.mark.parametrize(
    ("rows", "code", "where"),
    [
        ([f"{STAMPS[0]},1"], "csv_malformed", "line 2: expected 3 cells (timestamp, throttle, speed_m_s)"),
        ([f"{STAMPS[0]},1,nan"], "csv_malformed", "line 2: expected a finite number"),
        (["0.5,1,2"], "csv_malformed", "line 2: expected a timestamp"),
        ([], "csv_malformed", "expected rows of timestamp, throttle, speed_m_s"),
        ([f"{STAMPS[0]},1,2"] * 2, "timestamps_not_increasing", "line 3: expected stamps that increase"),
    ],
)
def test_rows_malformed(rows: list[str], code: str, where: str, tmp_path: Path) -> None:
    expect(euroc(tmp_path, rows), code, f"motor0/data.csv{',' if 'line' in where else ''}")
    expect(euroc(tmp_path, rows), code, where)


@pytest.mark.parametrize(
    "header", ["timestamp,x", "#time,x", "#timestamp [ns]", "#timestamp [ns],", "#timestamp [ns],x,x", ""]
)
def test_header_malformed(header: str, tmp_path: Path) -> None:
    folder = euroc(tmp_path, [f"{STAMPS[0]},1,2"], header)
    expect(folder, "csv_malformed", "expected #timestamp [ns] and the names of the columns")


def test_an_empty_table(tmp_path: Path) -> None:
    folder = euroc(tmp_path, [])
    (folder / "mav0/motor0/data.csv").write_text("")
    expect(folder, "csv_malformed", "found an empty file")


# -- plain layout


def plain(tmp_path: Path, header: str, cells: str = ",0.5,-2") -> Path:
    folder = write_plain(tmp_path)
    lines = (folder / "frames.csv").read_text().splitlines()
    write_lines(folder / "frames.csv", [f"{lines[0]}{header}", *(line + cells for line in lines[1:])])
    return folder


def test_columns_of_the_frames_table(tmp_path: Path) -> None:
    recording = open_recording(plain(tmp_path, ",motor_throttle,Motor_Steering_rad"))
    assert recording.motor_names == ("throttle", "steering_rad")
    command = recording.motor_command(3)
    assert command is not None
    assert command.tolist() == [0.5, -2.0]


@pytest.mark.parametrize("header", [",throttle,motor_x", ",motor_x,motor_x", ",motor_,motor_x", ",motor_x,"])
def test_columns_that_are_no_motors(header: str, tmp_path: Path) -> None:
    expect(plain(tmp_path, header), "csv_malformed", "frames.csv, line 1: expected timestamp_ns,filename and further")


@pytest.mark.parametrize(
    ("cells", "where"),
    [(",0.5", "expected 4 cells"), (",0.5,x", "expected a finite number"), (",0.5,inf", "expected a finite number")],
)
def test_cells_that_are_no_numbers(cells: str, where: str, tmp_path: Path) -> None:
    expect(plain(tmp_path, ",motor_a,motor_b", cells), "csv_malformed", f"frames.csv, line 2: {where}")


def test_a_header_of_something_else_is_named_as_before(tmp_path: Path) -> None:
    folder = write_plain(tmp_path)
    lines = (folder / "frames.csv").read_text().splitlines()
    write_lines(folder / "frames.csv", ["stamp,filename,motor_x", *lines[1:]])
    expect(folder, "csv_malformed", "frames.csv, line 1: expected timestamp_ns,filename, found")
    (folder / "frames.csv").write_text("")
    expect(folder, "csv_malformed", "frames.csv, line 1: expected timestamp_ns,filename, found an empty file")
