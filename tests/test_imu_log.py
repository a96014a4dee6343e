"""Slices of an IMU log: edges with their neighbours, and disorder that only touches the slices that hold it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.imu_log import ImuLog


def log(stamps: list[int], *, accel: bool = True) -> ImuLog:
    rows = np.arange(len(stamps) * 3, dtype=np.float64).reshape(-1, 3)
    return ImuLog(np.array(stamps, dtype=np.int64), rows, rows + 0.5 if accel else None)


def expect(code: str, imu: ImuLog, start_ns: int, end_ns: int) -> InvalidInputError:
    with pytest.raises(InvalidInputError) as caught:
        imu.between(start_ns, end_ns)
    assert caught.value.code == code
    return caught.value


@pytest.mark.parametrize(
    ("start_ns", "end_ns", "expected"),
    [
        pytest.param(20, 30, [10, 20, 30, 40], id="both ends inclusive, a neighbour each"),
        pytest.param(15, 35, [10, 20, 30, 40], id="between samples"),
        pytest.param(0, 10, [0, 10, 20], id="no neighbour before the first"),
        pytest.param(45, 99, [40, 50], id="no neighbour after the last"),
        pytest.param(-5, 99, [0, 10, 20, 30, 40, 50], id="everything"),
        pytest.param(21, 29, [20, 30], id="only neighbours"),
        pytest.param(30, 30, [20, 30, 40], id="one moment"),
    ],
)
def test_between(start_ns: int, end_ns: int, expected: list[int]) -> None:
    samples = log([0, 10, 20, 30, 40, 50]).between(start_ns, end_ns)
    assert samples.timestamps_ns.tolist() == expected
    assert samples.gyro_rad_s[:, 0].tolist() == [0.3 * stamp for stamp in expected]
    assert samples.accel_m_s2 is not None
    np.testing.assert_array_equal(samples.accel_m_s2, samples.gyro_rad_s + 0.5)


def test_gyro_only() -> None:
    assert log([0, 10], accel=False).between(0, 10).accel_m_s2 is None


@pytest.mark.parametrize(("start_ns", "end_ns"), [(-20, -1), (51, 60)])
@pytest.mark.parametrize("stamps", [[0, 10, 20, 50], [0, 20, 10, 50]])
def test_outside_the_log(stamps: list[int], start_ns: int, end_ns: int) -> None:
    error = expect("imu_not_covering", log(stamps), start_ns, end_ns)
    assert "between 0 and 50 ns" in error.message
    assert error.field == "imu"


def test_disorder_surfaces_where_it_is_and_nowhere_else() -> None:
    imu = log([0, 10, 20, 30, 25, 40, 50, 60, 70])
    expect("imu_unsorted", imu, 20, 40)
    assert imu.between(0, 11).timestamps_ns.tolist() == [0, 10, 20]
    assert imu.between(55, 70).timestamps_ns.tolist() == [50, 60, 70]


def test_a_stamp_that_jumps_out_of_the_slice_surfaces() -> None:
    expect("imu_unsorted", log([0, 10, 20, 999, 30, 40, 50]), 20, 30)


def test_a_stray_sample_far_away_in_the_file_surfaces() -> None:
    expect("imu_unsorted", log([0, 10, 20, 30, 40, 50, 60, 15, 70]), 10, 20)


def test_duplicates_surface_where_they_are() -> None:
    imu = log([0, 10, 20, 20, 30, 40, 50])
    expect("imu_duplicate_timestamps", imu, 15, 25)
    assert imu.between(35, 50).timestamps_ns.tolist() == [30, 40, 50]
    expect("imu_duplicate_timestamps", log([9, 0, 10, 20, 20, 30, 40, 50]), 15, 25)


def test_neighbours_of_an_empty_slice_in_an_unsorted_log() -> None:
    assert log([5, 0, 10, 20, 30]).between(12, 18).timestamps_ns.tolist() == [10, 20]


@given(st.lists(st.integers(0, 1000), min_size=1, max_size=30, unique=True), st.integers(0, 1000), st.integers(0, 1000))
def test_sorted_slices_hold_all_inside_and_one_beyond(stamps: list[int], first: int, second: int) -> None:
    stamps, (start, end) = sorted(stamps), sorted((first, second))
    before, after = [s for s in stamps if s < start], [s for s in stamps if s > end]
    inside = [s for s in stamps if start <= s <= end]
    if not inside and not (before and after):
        expect("imu_not_covering", log(stamps), start, end)
    else:
        assert log(stamps).between(start, end).timestamps_ns.tolist() == before[-1:] + inside + after[:1]


@given(st.permutations(range(8)), st.integers(-1, 9), st.integers(-1, 9))
def test_unsorted_slices_are_in_order_and_complete_or_refused(order: list[int], first: int, second: int) -> None:
    start, end = sorted((first, second))
    try:
        found = log(list(order)).between(start, end).timestamps_ns.tolist()
    except InvalidInputError as err:
        if err.code not in {"imu_unsorted", "imu_not_covering"}:
            raise
        return
    assert found == sorted(found)
    assert {s for s in order if start <= s <= end} <= set(found)


def test_length() -> None:
    assert len(log([0, 10, 20])) == 3


@pytest.mark.parametrize(
    ("stamps", "gyro", "accel", "code"),
    [
        pytest.param(np.zeros(0, np.int64), np.zeros((0, 3)), None, "imu_empty", id="empty"),
        pytest.param(np.zeros((2, 1), np.int64), np.zeros((2, 3)), None, "imu_wrong_shape", id="stamps 2-D"),
        pytest.param(np.zeros(2), np.zeros((2, 3)), None, "imu_wrong_shape", id="stamps float"),
        pytest.param(np.arange(2), np.zeros((3, 3)), None, "imu_wrong_shape", id="gyro rows"),
        pytest.param(np.arange(2), np.zeros((2, 3)), np.zeros((2, 4)), "imu_wrong_shape", id="accel columns"),
    ],
)
def test_refused(stamps: np.ndarray, gyro: np.ndarray, accel: np.ndarray | None, code: str) -> None:
    with pytest.raises(InvalidInputError) as caught:
        ImuLog(stamps, gyro, accel)
    assert caught.value.code == code
