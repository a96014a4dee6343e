"""PLY files: every byte order, what surrounds the points, and what is no point cloud."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from room import write_ply

from viflow_anomaly.errors import DatasetError, TooLargeError
from viflow_anomaly.ground_truth import ply
from viflow_anomaly.ground_truth.ply import read_ply_points

POINTS = np.array([[0.5, -1.25, 3.0], [1e-3, 2.0, -7.5], [4.0, 5.0, 6.0]], np.float32)
HEADER = b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_points_survive_in_every_order(tmp_path: Path, order: str) -> None:
    write_ply(tmp_path / "data.ply", POINTS, order=order)
    np.testing.assert_array_equal(read_ply_points(tmp_path / "data.ply"), POINTS)


def test_properties_are_found_by_name_and_other_elements_skipped(tmp_path: Path) -> None:
    text = (
        "ply\r\nformat ascii 1.0\r\nobj_info scanner\r\nelement camera 1\r\nproperty float focal\r\n"
        "element vertex 2\r\nproperty uchar red\r\nproperty double z\r\nproperty double y\r\nproperty double x\r\n"
        "element face 1\r\nproperty list uchar int vertex_indices\r\nend_header\r\n"
        "50.0\r\n9 3 2 1\r\n9 6 5 4\r\n2 0 1\r\n"
    )
    (tmp_path / "data.ply").write_bytes(text.encode())
    np.testing.assert_array_equal(read_ply_points(tmp_path / "data.ply"), [[1, 2, 3], [4, 5, 6]])


def test_binary_elements_before_the_points_are_skipped(tmp_path: Path) -> None:
    head = "ply\nformat binary_little_endian 1.0\nelement camera 2\nproperty short a\nproperty uchar b\n"
    head += "element vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    (tmp_path / "data.ply").write_bytes(head.encode() + b"\xff" * 6 + POINTS[0].astype("<f4").tobytes())
    np.testing.assert_array_equal(read_ply_points(tmp_path / "data.ply"), POINTS[:1])


def test_the_shortest_lines_there_are(tmp_path: Path) -> None:
    (tmp_path / "data.ply").write_bytes(HEADER + b"1 2 3\n4 5 6")
    np.testing.assert_array_equal(read_ply_points(tmp_path / "data.ply"), [[1, 2, 3], [4, 5, 6]])


def test_binary_points_are_read_in_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ply, "BLOCK_BYTES", 40)  # a row of write_ply has 19 bytes
    write_ply(tmp_path / "data.ply", POINTS)
    np.testing.assert_array_equal(read_ply_points(tmp_path / "data.ply"), POINTS)


def test_points_without_return_are_left_out(tmp_path: Path) -> None:
    write_ply(tmp_path / "data.ply", np.vstack([POINTS, [[np.nan, 0, 0]], [[0, np.inf, 0]]]).astype(np.float32))
    np.testing.assert_array_equal(read_ply_points(tmp_path / "data.ply"), POINTS)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "expected a PLY file"),
        (b"solid stl", "expected a PLY file"),
        (b"ply\nformat ascii 1.0\n", "end_header"),
        (b"ply\n" + b"comment x\n" * 8000, "end_header"),
        (HEADER.replace(b"ascii", b"utf8"), "line 2"),
        (HEADER.replace(b"format ascii 1.0\n", b""), "format"),
        (HEADER.replace(b"vertex 2", b"vertex two"), "line 3"),
        (HEADER.replace(b"float y", b"quad y"), "line 5"),
        (HEADER.replace(b"float y", b"float x"), "line 5"),
        (HEADER.replace(b"element vertex 2\n", b""), "line 3"),
        (HEADER.replace(b"vertex", b"face"), "element vertex"),
        (HEADER.replace(b"float z", b"float w"), "no number z"),
        (HEADER.replace(b"float z", b"float z\nproperty list uchar int more"), "a list in vertex"),
        (HEADER + b"1 2 3\n", "2 lines of x y z, found only 6 bytes"),
        (HEADER.replace(b"vertex 2", b"vertex 99999999") + b"1 2 3\n", "found only 6 bytes"),
        (HEADER + b"1.00 2.00 3.00\n", "ends after 1"),
        (HEADER + b"1 2 3\n" + b"4" * 70_000 + b" 5 6\n", "less than 65536 bytes"),
        (HEADER.replace(b"element vertex", b"element a 1\nelement vertex") + b"0" * 70_000 + b"\n", "less than 65536"),
        (HEADER + b"1 2 3\n1 2\n", "2 lines of x y z"),
        (HEADER + b"1 2 3\n1 2 three\n", "2 lines of x y z"),
        (HEADER + b"1 2 3\n1 2 \xff\n", "2 lines of x y z"),
        (HEADER + b"nan 2 3\n1 inf 2\n", "one finite point"),
        (HEADER.replace(b"vertex 2", b"vertex 0"), "one finite point"),
        (HEADER.replace(b"ascii", b"binary_little_endian") + b"\0" * 23, "ends after 1"),
    ],
)
def test_what_is_no_cloud_is_named(tmp_path: Path, content: bytes, words: str) -> None:
    (tmp_path / "data.ply").write_bytes(content)
    with pytest.raises(DatasetError, match=words) as raised:
        read_ply_points(tmp_path / "data.ply")
    assert raised.value.code == "point_cloud_malformed"
    assert "data.ply" in raised.value.message


def test_too_many_points_are_refused_before_they_are_read(tmp_path: Path) -> None:
    (tmp_path / "data.ply").write_bytes(HEADER.replace(b"vertex 2", b"vertex 999999999"))
    with pytest.raises(TooLargeError, match="999999999") as raised:
        read_ply_points(tmp_path / "data.ply")
    assert raised.value.code == "point_cloud_too_large"


@pytest.mark.parametrize("name", ["missing.ply", "."])
def test_a_missing_cloud_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(DatasetError, match="PLY point cloud") as raised:
        read_ply_points(tmp_path / name)
    assert raised.value.code == "point_cloud_missing"
