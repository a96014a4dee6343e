"""Middlebury's format: its bytes, a round trip, and files that are none."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from viflow_anomaly.errors import DatasetError
from viflow_anomaly.evaluation.flo_files import read_flo, write_flo


def test_bytes_are_those_of_the_format(tmp_path: Path) -> None:
    write_flo(tmp_path / "a.flo", np.array([[[1.5, -2.0], [0.0, 3.0]]], np.float32))
    assert (tmp_path / "a.flo").read_bytes() == struct.pack("<fii4f", 202021.25, 2, 1, 1.5, -2.0, 0.0, 3.0)


def test_round_trip_with_unknown_pixels(tmp_path: Path) -> None:
    flow = np.random.default_rng(0).normal(0, 30, (5, 7, 2)).astype(np.float32)
    flow[2, 3] = np.nan
    flow[4, 0, 1] = np.inf
    write_flo(tmp_path / "deep" / "a.flo", flow)
    read = read_flo(tmp_path / "deep" / "a.flo")
    flow[4, 0] = np.nan
    np.testing.assert_array_equal(read, flow)
    assert read.dtype == np.float32


def test_a_component_that_says_unknown(tmp_path: Path) -> None:
    (tmp_path / "a.flo").write_bytes(struct.pack("<4sii4f", b"PIEH", 2, 1, 1.6e9, 0.0, 1e9, 0.0))
    np.testing.assert_array_equal(read_flo(tmp_path / "a.flo"), [[[np.nan, np.nan], [1e9, 0.0]]])


GOOD = struct.pack("<4sii2f", b"PIEH", 1, 1, 0.0, 0.0)


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (b"", "found b''"),
        (GOOD[:11], "found b'PIEH"),
        (b"PIEI" + GOOD[4:], "found b'PIEI"),
        (GOOD[:-1], "expected 20 bytes for 1x1 px, found 19"),
        (GOOD + b"\0", "found 21"),
        (struct.pack("<4sii", b"PIEH", 400_000, 400_000), "1280000000012 bytes for 400000x400000 px, found 12"),
        (struct.pack("<4sii", b"PIEH", 0, 1), "found 0x1"),
        (struct.pack("<4sii", b"PIEH", 1, -1), "found 1x-1"),
    ],
)
def test_malformed_files(tmp_path: Path, data: bytes, found: str) -> None:
    path = tmp_path / "a.flo"
    path.write_bytes(data)
    with pytest.raises(DatasetError, match=r"a\.flo: expected") as raised:
        read_flo(path)
    assert raised.value.code == "flow_file_malformed"
    assert found in raised.value.message


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(DatasetError) as raised:
        read_flo(tmp_path / "a.flo")
    assert raised.value.code == "flow_file_missing"
