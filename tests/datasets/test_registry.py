"""Which format a folder is, and what is said when it is none."""

from __future__ import annotations

from pathlib import Path

import pytest
from worlds import write_euroc, write_kitti_raw, write_plain

from viflow_anomaly.datasets.registry import READERS, open_recording, recognise
from viflow_anomaly.errors import DatasetError


def expect(code: str, path: Path | str, **options: str) -> DatasetError:
    with pytest.raises(DatasetError) as caught:
        open_recording(path, **options)  # type: ignore[arg-type]
    assert caught.value.code == code
    return caught.value


def test_missing_directory(tmp_path: Path) -> None:
    assert str(tmp_path / "no") in expect("directory_missing", tmp_path / "no").message


def test_a_file_is_no_directory(tmp_path: Path) -> None:
    (tmp_path / "bag").write_text("x")
    expect("not_a_directory", tmp_path / "bag")


def test_unknown_layout_says_what_each_format_needs_and_what_was_found(tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    (tmp_path / "notes.txt").write_text("x")
    message = expect("layout_unknown", tmp_path).message
    for name, reader in READERS.items():
        assert name in message
        assert reader.needs in message
    assert "found notes.txt, pictures/" in message


def test_unknown_layout_of_an_empty_or_crowded_folder(tmp_path: Path) -> None:
    assert "an empty directory" in expect("layout_unknown", tmp_path).message
    for k in range(20):
        (tmp_path / f"{k:02d}").write_text("x")
    assert "11 and 8 more" in expect("layout_unknown", tmp_path).message


def test_a_named_format_that_does_not_fit(tmp_path: Path) -> None:
    message = expect("layout_unknown", write_plain(tmp_path), format="euroc").message
    assert "euroc needs" in message
    assert "plain needs" not in message


def test_an_unknown_format(tmp_path: Path) -> None:
    assert (
        "euroc, kitti_raw, kitti_odometry, kitti_odometry_raw, plain"
        in expect("format_unknown", tmp_path, format="tum").message
    )


def test_a_folder_of_several_formats_is_the_first_of_the_registry(tmp_path: Path) -> None:
    write_plain(tmp_path)
    assert recognise(tmp_path) == "plain"
    write_euroc(tmp_path)
    assert recognise(tmp_path) == "euroc"
    assert open_recording(tmp_path, format="plain").format == "plain"


def test_a_lone_imu_is_no_recording(tmp_path: Path) -> None:
    for file in ("cam0/data.csv", "imu0/data.csv"):
        folder = write_euroc(tmp_path / file.replace("/", "_"))
        (folder / "mav0" / file).unlink()
        expect("layout_unknown", folder)


def test_an_incomplete_drive_is_no_recording(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path)
    (drive / "oxts" / "timestamps.txt").unlink()
    expect("layout_unknown", drive)


def test_paths_may_be_text(tmp_path: Path) -> None:
    assert len(open_recording(str(write_plain(tmp_path)))) == 6
