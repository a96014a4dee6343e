"""A pair touched by broken stamps is left out and counted by its reason; none gets a window of wrong rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from kitti_worlds import imu_stamps
from worlds import car_world, in_memory, make_world, turning_imu

from viflow_anomaly.config import MotionWindowConfig
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.usable_pairs import usable_pairs
from viflow_anomaly.imu_log import ImuLog
from viflow_anomaly.motion_input import build_motion_window

PAPER = MotionWindowConfig(layout="paper_kitti", axes="sensor")
FRAMES = 20


def pairs_of(tmp_path: Path, imu: ImuLog) -> RecordingPairs:
    world = car_world(frames=FRAMES)
    object.__setattr__(world, "imu", imu)
    # What the window touches and a sample more.
    return RecordingPairs(in_memory(world, tmp_path), before_s=0.11, after_s=0.01)


@pytest.fixture
def imu() -> ImuLog:
    return car_world(frames=FRAMES).imu


def without(imu: ImuLog, rows: list[int]) -> ImuLog:
    keep = np.delete(np.arange(len(imu)), rows)
    assert imu.accel_m_s2 is not None
    return ImuLog(imu.timestamps_ns[keep], imu.gyro_rad_s[keep], imu.accel_m_s2[keep])


def with_stamp(imu: ImuLog, row: int, stamp: int) -> ImuLog:
    stamps = imu.timestamps_ns.copy()
    stamps[row] = stamp
    return ImuLog(stamps, imu.gyro_rad_s, imu.accel_m_s2)


def test_a_sound_log_loses_no_pair(tmp_path: Path, imu: ImuLog) -> None:
    usable = usable_pairs(pairs_of(tmp_path, imu), PAPER)
    assert usable.indices == list(range(FRAMES - 1))
    assert usable.excluded == {}


@pytest.mark.parametrize("fault", ["gap", "duplicate", "disorder"])
def test_only_pairs_that_touch_a_fault_are_left_out(fault: str, tmp_path: Path, imu: ImuLog) -> None:
    """Row 105 lies 0.55 s after the first frame: between frames 5 and 6, and in the 100 ms before frame 6."""
    if fault == "gap":
        broken, code = without(imu, [105]), "imu_window_count"
    elif fault == "duplicate":
        broken, code = with_stamp(imu, 105, int(imu.timestamps_ns[104])), "imu_duplicate_timestamps"
    else:
        broken, code = with_stamp(imu, 105, int(imu.timestamps_ns[103]) - 1), "imu_unsorted"
    usable = usable_pairs(pairs_of(tmp_path, broken), PAPER)
    assert usable.excluded == {code: 2}
    assert usable.indices == [k for k in range(FRAMES - 1) if k not in (5, 6)]


def test_a_log_that_begins_late_and_ends_early(tmp_path: Path, imu: ImuLog) -> None:
    first, last = (int(np.searchsorted(imu.timestamps_ns, imu.timestamps_ns[0] + s * 10**7)) for s in (100, 200))
    usable = usable_pairs(pairs_of(tmp_path, without(imu, [*range(first), *range(last, len(imu))])), PAPER)
    assert set(usable.excluded) <= {"imu_not_covering", "imu_window_count"}
    assert sum(usable.excluded.values()) + len(usable.indices) == FRAMES - 1
    assert usable.indices == list(range(6, 15))  # from 0.5 s to 1.49 s: 100 ms before frame 6, 90 ms after frame 14


def test_many_faults_are_counted_apart(tmp_path: Path, imu: ImuLog) -> None:
    broken = without(with_stamp(imu, 75, int(imu.timestamps_ns[74])), [165])
    assert usable_pairs(pairs_of(tmp_path, broken), PAPER).excluded == {
        "imu_duplicate_timestamps": 2,
        "imu_window_count": 2,
    }


def test_a_frame_interval_that_the_layout_has_no_place_for(tmp_path: Path) -> None:
    pairs = RecordingPairs(in_memory(make_world(), tmp_path))
    assert usable_pairs(pairs, PAPER).excluded == {"imu_window_interval": 5}


def test_ten_records_with_a_hole_among_them_are_not_the_layout(tmp_path: Path, imu: ImuLog) -> None:
    # Three records 30 ms late: ten in the block, but nothing for 40 ms.
    broken = ImuLog(imu.timestamps_ns.copy(), imu.gyro_rad_s, imu.accel_m_s2)
    broken.timestamps_ns[103:106] = imu.timestamps_ns[106] - np.array([6, 4, 2]) * 1_000_000
    usable = usable_pairs(pairs_of(tmp_path, broken), PAPER)
    assert usable.excluded == {"imu_window_count": 2}
    assert usable.indices == [k for k in range(FRAMES - 1) if k not in (5, 6)]


def test_windows_of_usable_pairs_are_the_records_themselves(tmp_path: Path, imu: ImuLog) -> None:
    broken = without(imu, [105, 140, 141])
    pairs = pairs_of(tmp_path, broken)
    stamps = pairs.recording.frame_timestamps_ns
    for index in usable_pairs(pairs, PAPER).indices:
        window = build_motion_window(pairs[index], PAPER).values
        first = int(np.searchsorted(broken.timestamps_ns, stamps[index] - 10**8))
        np.testing.assert_array_equal(window[:, :3], broken.gyro_rad_s[first : first + 20].astype(np.float32))
        assert broken.timestamps_ns[first + 19] - broken.timestamps_ns[first] == 190_000_000


def test_stamps_that_jitter_as_kittis_do_lose_nothing(tmp_path: Path) -> None:
    stamps = imu_stamps(25)
    jitter = np.random.default_rng(3).integers(-300_000, 300_000, stamps.size)
    imu = turning_imu(stamps + jitter, 0.1, car_world().camera.T_cam_imu)  # type: ignore[arg-type]
    assert usable_pairs(pairs_of(tmp_path, imu), PAPER).excluded == {}
