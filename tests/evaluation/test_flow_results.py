"""Result files of other methods: where they lie, what they may be, what is refused."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from viflow_anomaly.datasets.ground_truth_png import write_flow_png
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.evaluation.flo_files import write_flo
from viflow_anomaly.evaluation.flow_methods import NoEstimateError
from viflow_anomaly.evaluation.flow_results import ResultFiles
from viflow_anomaly.evaluation.flow_truth import PairName
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples

NEXT = PairName("drone_1", 1, 100, 200)
FAR = PairName("drone_1", 2, 100, 300)
OTHER = PairName("car_1", 1, 100, 200)
FLOW = np.full((32, 40, 2), (1.5, -0.5), np.float32)
FLOW[0, 0] = np.nan
IMU = ImuSamples(np.array([0, 1000]), np.zeros((2, 3)), np.zeros((2, 3)))
PAIR = FramePair(Frame(100, np.zeros((32, 40), np.uint8)), Frame(200, np.zeros((32, 40), np.uint8)), IMU, None)


def write(path: Path, flow: Float32Array = FLOW) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".flo":
        write_flo(path, flow)
    elif path.suffix == ".png":
        valid = np.isfinite(flow).all(axis=-1)
        write_flow_png(path, np.where(valid[..., None], flow, np.float32(0)), valid)
    else:
        np.save(path, flow)


@pytest.mark.parametrize("suffix", [".flo", ".png", ".npy"])
@pytest.mark.parametrize("stem", ["drone_1/100", "drone_1/100_200", "100", "100_200"])
def test_every_format_in_every_place(tmp_path: Path, suffix: str, stem: str) -> None:
    write(tmp_path / f"{stem}{suffix}")
    method = ResultFiles("other", tmp_path, [NEXT])
    np.testing.assert_array_equal(method.flow(PAIR, NEXT), FLOW)
    assert not method.timed


def test_further_pairs_need_both_stamps(tmp_path: Path) -> None:
    write(tmp_path / "drone_1/100.flo")
    method = ResultFiles("other", tmp_path, [NEXT, FAR])
    with pytest.raises(NoEstimateError) as raised:
        method.flow(PAIR, FAR)
    assert raised.value.reason == "no_file"
    write(tmp_path / "drone_1/100_300.flo", FLOW + 1)
    np.testing.assert_array_equal(method.flow(PAIR, FAR), FLOW + 1)
    np.testing.assert_array_equal(method.flow(PAIR, NEXT), FLOW)


def test_a_bare_stamp_is_not_enough_for_several_sequences(tmp_path: Path) -> None:
    write(tmp_path / "100.flo")
    with pytest.raises(DatasetError, match="found none") as raised:
        ResultFiles("other", tmp_path, [NEXT, OTHER])
    assert raised.value.code == "results_missing"


@pytest.mark.parametrize("names", [[NEXT], []])
def test_a_folder_without_any_file(tmp_path: Path, names: list[PairName]) -> None:
    with pytest.raises(DatasetError, match="nowhere") as raised:
        ResultFiles("other", tmp_path / "nowhere", names)
    assert raised.value.code == "results_missing"


def refusal(folder: Path) -> DatasetError:
    with pytest.raises(DatasetError, match=r"drone_1.100\.") as raised:
        ResultFiles("other", folder, [NEXT]).flow(PAIR, NEXT)
    return raised.value


def test_two_files_for_one_pair(tmp_path: Path) -> None:
    write(tmp_path / "drone_1/100.flo")
    write(tmp_path / "drone_1/100.npy")
    assert refusal(tmp_path).code == "results_ambiguous"


@pytest.mark.parametrize("suffix", [".flo", ".png", ".npy"])
def test_another_size_than_the_images(tmp_path: Path, suffix: str) -> None:
    write(tmp_path / f"drone_1/100{suffix}", FLOW[:31])
    error = refusal(tmp_path)
    assert error.code == "results_malformed"
    assert "(32, 40, 2)" in error.message
    assert "(31, 40, 2)" in error.message


@pytest.mark.parametrize(
    ("suffix", "code"),
    [(".flo", "flow_file_malformed"), (".png", "ground_truth_malformed"), (".npy", "results_malformed")],
)
@pytest.mark.parametrize("data", [b"", b"no flow at all"])
def test_malformed_files(tmp_path: Path, suffix: str, code: str, data: bytes) -> None:
    (tmp_path / "drone_1").mkdir()
    (tmp_path / f"drone_1/100{suffix}").write_bytes(data)
    assert refusal(tmp_path).code == code


HUGE = (400_000, 400_000, 2)


def npy_head(version: tuple[int, int], shape: tuple[int, ...]) -> bytes:
    return npy_header(version, f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}\n".encode())


def npy_header(version: tuple[int, int], text: bytes) -> bytes:
    length = struct.pack("<H" if version == (1, 0) else "<I", len(text))
    return b"\x93NUMPY" + bytes(version) + length + text


@pytest.mark.parametrize("version", [(1, 0), (2, 0)])
def test_a_header_is_compared_before_what_it_promises_is_read(tmp_path: Path, version: tuple[int, int]) -> None:
    (tmp_path / "drone_1").mkdir()
    path = tmp_path / "drone_1/100.npy"
    path.write_bytes(npy_head(version, HUGE))
    assert "(400000, 400000, 2)" in refusal(tmp_path).message
    path.write_bytes(npy_head(version, FLOW.shape) + FLOW.tobytes())
    np.testing.assert_array_equal(ResultFiles("other", tmp_path, [NEXT]).flow(PAIR, NEXT), FLOW)
    path.write_bytes(npy_head(version, FLOW.shape) + FLOW.tobytes()[:-1])
    assert refusal(tmp_path).code == "results_malformed"


@pytest.mark.parametrize("text", [b"(", b"-" * 9000 + b"1", b"{[]: 1}", b"  1\n 2\n", b"[", b"1 +", b"\xff", b""])
def test_a_header_that_is_none(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "drone_1").mkdir()
    (tmp_path / "drone_1/100.npy").write_bytes(npy_header((1, 0), text))
    assert refusal(tmp_path).code == "results_malformed"


def test_an_array_of_a_later_format(tmp_path: Path) -> None:
    (tmp_path / "drone_1").mkdir()
    (tmp_path / "drone_1/100.npy").write_bytes(npy_head((3, 0), FLOW.shape) + FLOW.tobytes())
    assert "format (3, 0)" in refusal(tmp_path).message


def test_a_picture_that_claims_to_be_huge(tmp_path: Path) -> None:
    path = tmp_path / "drone_1/100.png"
    write(path)
    data = path.read_bytes()
    head = data[12:16] + struct.pack(">II", 100_000, 100_000) + data[24:29]
    path.write_bytes(data[:12] + head + struct.pack(">I", zlib.crc32(head)) + data[33:])
    error = refusal(tmp_path)
    assert error.code == "ground_truth_malformed"
    assert "100000x100000" in error.message


def test_an_array_of_something_else(tmp_path: Path) -> None:
    (tmp_path / "drone_1").mkdir()
    np.save(tmp_path / "drone_1/100.npy", np.zeros((32, 40, 2), np.int32))
    assert "int32" in refusal(tmp_path).message
    with (tmp_path / "drone_1/100.npy").open("wb") as file:
        np.savez(file, flow=FLOW)
    assert refusal(tmp_path).code == "results_malformed"
    np.save(tmp_path / "drone_1/100.npy", np.array([None]), allow_pickle=True)
    assert refusal(tmp_path).code == "results_malformed"
