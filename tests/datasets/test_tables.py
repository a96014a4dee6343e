"""Malformed tables, by name: the file, the line and the reason are always said."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds import write_euroc, write_plain

from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.datasets.tables import parse_integer_ns, parse_numbers, read_lines, read_text
from viflow_anomaly.errors import DatasetError

Edit = Callable[[list[str]], list[str]]


def refuse(tmp_path: Path, file: str, edit: Edit, code: str, where: str, euroc: bool = False) -> str:
    """Edit the lines of one file of a good recording; opening must fail with the code and name ``file, where``."""
    folder = write_euroc(tmp_path) if euroc else write_plain(tmp_path)
    path = folder / file
    path.write_text("\n".join(edit(path.read_text().splitlines())) + "\n")
    with pytest.raises(DatasetError) as caught:
        open_recording(folder, format="euroc" if euroc else "plain")
    assert caught.value.code == code
    assert caught.value.message.startswith(f"{path}{where}")
    return caught.value.message


def accept(tmp_path: Path, file: str, edit: Callable[[bytes], bytes]) -> None:
    folder = write_plain(tmp_path)
    good = open_recording(folder)
    (folder / file).write_bytes(edit((folder / file).read_bytes()))
    edited = open_recording(folder)
    assert edited.frame_timestamps_ns.tolist() == good.frame_timestamps_ns.tolist()
    assert edited.imu.gyro_rad_s.tolist() == good.imu.gyro_rad_s.tolist()


def line(number: int, change: Callable[[str], str]) -> Edit:
    """Change one line, counted from 1."""
    return lambda lines: [change(text) if k == number else text for k, text in enumerate(lines, start=1)]


FILES = ["frames.csv", "imu.csv"]


@pytest.mark.parametrize("file", FILES)
def test_crlf(file: str, tmp_path: Path) -> None:
    accept(tmp_path, file, lambda data: data.replace(b"\n", b"\r\n"))


@pytest.mark.parametrize("file", FILES)
def test_old_mac_newlines(file: str, tmp_path: Path) -> None:
    accept(tmp_path, file, lambda data: data.replace(b"\n", b"\r"))


@pytest.mark.parametrize("file", FILES)
def test_byte_order_mark(file: str, tmp_path: Path) -> None:
    accept(tmp_path, file, lambda data: b"\xef\xbb\xbf" + data)


@pytest.mark.parametrize("file", FILES)
def test_blank_lines_and_spaces(file: str, tmp_path: Path) -> None:
    accept(tmp_path, file, lambda data: b"\n" + data.replace(b",", b" , ").replace(b"\n", b" \n\n") + b"  \n")


@pytest.mark.parametrize("file", FILES)
def test_no_newline_at_the_end(file: str, tmp_path: Path) -> None:
    accept(tmp_path, file, lambda data: data.rstrip(b"\n"))


@pytest.mark.parametrize("file", FILES)
def test_header_in_capitals_with_hash(file: str, tmp_path: Path) -> None:
    accept(tmp_path, file, lambda data: b"# " + data.split(b"\n", 1)[0].upper() + b"\n" + data.split(b"\n", 1)[1])


@pytest.mark.parametrize("file", FILES)
def test_trailing_delim(file: str, tmp_path: Path) -> None:
    message = refuse(tmp_path, file, line(3, lambda text: text + ","), "csv_malformed", ", line 3: ")
    assert "cells" in message


@pytest.mark.parametrize("file", FILES)
def test_too_few_cells(file: str, tmp_path: Path) -> None:
    refuse(tmp_path, file, line(4, lambda text: text.rsplit(",", 1)[0]), "csv_malformed", ", line 4: ")


@pytest.mark.parametrize("file", FILES)
def test_wrong_delim(file: str, tmp_path: Path) -> None:
    refuse(tmp_path, file, line(2, lambda text: text.replace(",", ";")), "csv_malformed", ", line 2: ")


@pytest.mark.parametrize("file", FILES)
def test_header_missing(file: str, tmp_path: Path) -> None:
    refuse(tmp_path, file, lambda lines: lines[1:], "csv_malformed", ", line 1: expected timestamp_ns,")


@pytest.mark.parametrize("file", FILES)
def test_header_in_another_order(file: str, tmp_path: Path) -> None:
    swapped = line(1, lambda text: ",".join(reversed(text.split(","))))
    refuse(tmp_path, file, swapped, "csv_malformed", ", line 1: expected timestamp_ns,")


@pytest.mark.parametrize("file", FILES)
def test_empty_file(file: str, tmp_path: Path) -> None:
    assert "an empty file" in refuse(tmp_path, file, lambda _: [], "csv_malformed", ", line 1: ")


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize(
    "stamp", ["1.5e18", "1403715285262142976.0", "", "abc", "0x10", "9223372036854775808", "\u0661"]
)
def test_timestamp_that_is_no_integer(file: str, stamp: str, tmp_path: Path) -> None:
    edit = line(2, lambda text: stamp + "," + text.split(",", 1)[1])
    refuse(tmp_path, file, edit, "csv_malformed", ", line 2: expected a timestamp in whole nanoseconds, ")


@pytest.mark.parametrize(
    ("file", "stamp", "span"),
    [
        ("frames.csv", 2**62 + 1, f"0 to {2**62}"),
        ("imu.csv", 2**62 + 1, f"{-(2**61)} to {2**62}"),
        ("imu.csv", -(2**61) - 1, f"{-(2**61)} to {2**62}"),
    ],
)
def test_timestamp_whose_differences_wrap(file: str, stamp: int, span: str, tmp_path: Path) -> None:
    edit = line(2, lambda text: f"{stamp}," + text.split(",", 1)[1])
    refuse(tmp_path, file, edit, "csv_malformed", f", line 2: expected a timestamp in whole nanoseconds, {span}, found")


def test_frame_before_the_clock_began(tmp_path: Path) -> None:
    edit = line(2, lambda text: "-5," + text.split(",", 1)[1])
    refuse(tmp_path, "frames.csv", edit, "csv_malformed", ", line 2: ")


@pytest.mark.parametrize("value", ["nan", "inf", "-Infinity", "", "1.5x", "1e999"])
def test_imu_value_that_is_no_finite_number(value: str, tmp_path: Path) -> None:
    edit = line(5, lambda text: text.rsplit(",", 1)[0] + "," + value)
    refuse(tmp_path, "imu.csv", edit, "csv_malformed", ", line 5: expected a finite number, found")


def test_imu_header_that_does_not_fit_its_rows(tmp_path: Path) -> None:
    edit = line(1, lambda _: "timestamp_ns,gyro_x,gyro_y,gyro_z")
    refuse(tmp_path, "imu.csv", edit, "csv_malformed", ", line 2: expected 4 cells")


def test_duplicate_frame_stamps(tmp_path: Path) -> None:
    def edit(lines: list[str]) -> list[str]:
        return [*lines[:3], lines[2].split(",")[0] + "," + lines[3].split(",")[1], *lines[4:]]

    assert "duplicate" in refuse(tmp_path, "frames.csv", edit, "timestamps_not_increasing", ", line 4: ")


def test_frames_out_of_order(tmp_path: Path) -> None:
    def edit(lines: list[str]) -> list[str]:
        return [*lines[:2], lines[3], lines[2], *lines[4:]]

    assert " after " in refuse(tmp_path, "frames.csv", edit, "timestamps_not_increasing", ", line 4: ")


@pytest.mark.parametrize("name", ["images/none.png", "images", "x" * 300, "images/\0.png"])
def test_image_that_is_not_there(name: str, tmp_path: Path) -> None:
    edit = line(6, lambda text: text.split(",")[0] + "," + name)
    refuse(tmp_path, "frames.csv", edit, "image_missing", ", line 6: expected the image ")


@pytest.mark.parametrize("name", ["", "/etc/hostname", "../images/0001.png", "images/../../x.png"])
def test_image_outside_the_folder(name: str, tmp_path: Path) -> None:
    edit = line(2, lambda text: text.split(",")[0] + "," + name)
    refuse(tmp_path, "frames.csv", edit, "csv_malformed", ", line 2: expected the name of an image below ")


def test_euroc_image_that_is_not_there(tmp_path: Path) -> None:
    edit = line(3, lambda text: text.split(",")[0] + ",7.png")
    refuse(tmp_path, "mav0/cam0/data.csv", edit, "image_missing", ", line 3: ", euroc=True)


def test_euroc_without_header_reads_the_same(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path)
    path = folder / "mav0" / "cam0" / "data.csv"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[1:]))
    assert len(open_recording(folder)) == 6


def test_euroc_trailing_delim(tmp_path: Path) -> None:
    edit = line(9, lambda text: text + ",")
    refuse(tmp_path, "mav0/imu0/data.csv", edit, "csv_malformed", ", line 9: expected 7 cells", euroc=True)


def test_not_utf8(tmp_path: Path) -> None:
    folder = write_plain(tmp_path)
    (folder / "imu.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DatasetError) as caught:
        open_recording(folder)
    assert caught.value.code == "text_not_utf8"
    assert str(folder / "imu.csv") in caught.value.message


@pytest.mark.parametrize("name", ["absent", "."])
def test_text_file_missing(name: str, tmp_path: Path) -> None:
    with pytest.raises(DatasetError) as caught:
        read_text(tmp_path / name)
    assert caught.value.code == "file_missing"


def test_lines_keep_their_numbers(tmp_path: Path) -> None:
    (tmp_path / "t").write_text("\n a \n\n\nb")
    assert [(entry.number, entry.text) for entry in read_lines(tmp_path / "t")] == [(2, "a"), (5, "b")]


@given(st.integers(0, 2**62))
def test_stamps_are_read_exactly(stamp: int) -> None:
    assert parse_integer_ns(Path("t"), 1, str(stamp)) == stamp


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_numbers_are_read_exactly(value: float) -> None:
    assert parse_numbers(Path("t"), 1, [repr(value)]) == [value]
