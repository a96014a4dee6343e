from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from difference_detector import DifferenceDetector
from worlds import in_memory, make_world

from viflow_anomaly.alarm_footage import JudgedPair, WatchedRecording, footage_of, watch_recordings
from viflow_anomaly.config import DetectorConfig, RegionConfig
from viflow_anomaly.datasets.recording import FileRecording
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.sensor_data import FramePair


def recording(folder: Path, *, frames: int = 5, dark: bool = False, square_px: int = 20) -> FileRecording:
    world = make_world(frames=frames, shift_px=0, square_px=square_px)
    if dark:
        for image in world.images:
            image[:] = 0
    return in_memory(world, folder)


def watched(*seconds: float, scores: tuple[float, ...] = ()) -> WatchedRecording:
    return WatchedRecording("a", None, tuple(JudgedPair(one, scores) for one in seconds), abstained=0, failed={})


def test_scores_are_those_of_regions_that_pass_the_shape_rule(tmp_path: Path) -> None:
    """Whatever threshold the detector is set to, and without masks."""
    (expected,) = watch_recordings([recording(tmp_path / "a")], DifferenceDetector())
    strict = DetectorConfig(regions=RegionConfig(motion_score=1.01), include_masks=True)
    (found,) = watch_recordings([recording(tmp_path / "b")], DifferenceDetector(config=strict))
    assert found == expected
    assert len(found.judged) == 4
    assert all(pair.scores and min(pair.scores) >= 0.5 for pair in found.judged)
    assert found.seconds == pytest.approx(4 * 0.05)
    assert (found.abstained, found.failed) == (0, {})


def test_bands_are_no_alarms(tmp_path: Path) -> None:
    config = DetectorConfig(regions=RegionConfig(min_x_extent_fraction=1.0))
    (found,) = watch_recordings([recording(tmp_path)], DifferenceDetector(config=config))
    assert [pair.scores for pair in found.judged] == [()] * 4


def test_pairs_that_cannot_be_used_are_counted_and_left_out(tmp_path: Path) -> None:
    broken = recording(tmp_path / "broken")
    broken.frame_path(0).write_bytes(b"")
    broken.frame_path(4).unlink()
    found = watch_recordings([broken, recording(tmp_path / "dark", dark=True)], DifferenceDetector())
    assert [len(one.judged) for one in found] == [2, 0]
    assert found[0].failed == {"image_empty": 1, "image_missing": 1}
    assert found[1].abstained == 4


def test_progress_counts_over_all_recordings(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    both = [recording(tmp_path / "a", frames=3), recording(tmp_path / "b", frames=2)]
    watch_recordings(both, DifferenceDetector(), on_progress=lambda *state: told.append(state))
    assert told == [(1, 3), (2, 3), (3, 3)]


def test_a_recording_without_a_pair_is_refused(tmp_path: Path) -> None:
    both = [recording(tmp_path / "a"), recording(tmp_path / "b", frames=1)]
    with pytest.raises(DatasetError, match=r"b: expected at least 2 frames, found 1") as caught:
        watch_recordings(both, DifferenceDetector())
    assert caught.value.code == "recording_too_short"


def test_the_same_recording_twice_is_refused(tmp_path: Path) -> None:
    """It would count for twice the certainty."""
    recording(tmp_path / "a")
    again = [recording(tmp_path / "a"), recording(tmp_path / "a" / ".." / "a")]
    with pytest.raises(InvalidInputError, match="expected each recording once, found it 2 times") as caught:
        watch_recordings(again, DifferenceDetector())
    assert caught.value.code == "recording_repeated"


def test_abstained_pairs_alone_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"found none in 4 \(4 abstained, failed: \{\}\)") as caught:
        watch_recordings([recording(tmp_path, dark=True)], DifferenceDetector())
    assert caught.value.code == "no_usable_pairs"


def test_failed_pairs_alone_are_refused(tmp_path: Path) -> None:
    def fail(pair: FramePair) -> None:
        raise InvalidInputError("broken", code="pair_broken")

    with pytest.raises(DatasetError, match=r"\(0 abstained, failed: \{'pair_broken': 4\}\)") as caught:
        watch_recordings([recording(tmp_path)], DifferenceDetector(on_pair=fail))
    assert caught.value.code == "no_usable_pairs"


# --- blocks


def test_blocks_are_equal_parts_of_a_recording() -> None:
    footage = footage_of([watched(*[0.1] * 2040)], block_s=10.0)  # 204 s: 20 blocks of 10.2 s
    assert footage.block_hours * 3600 == pytest.approx(np.full(20, 10.2))
    assert footage.hours == pytest.approx(204 / 3600)
    assert footage.hours >= footage.hours_for_promise


def test_no_block_reaches_into_the_next_recording() -> None:
    short, long = watched(*[0.5] * 6, scores=(0.7,)), watched(*[0.5] * 500, scores=(0.6, 0.8))
    footage = footage_of([short, long], block_s=10.0)
    assert footage.block_hours[0] * 3600 == pytest.approx(3.0)
    assert footage.block_hours.size == 1 + 25
    counts = np.bincount(footage.blocks)
    assert counts.tolist() == [6, *[40] * 25]
    assert footage.scores[:8].tolist() == [0.7] * 6 + [0.6, 0.8]


def test_short_footage_is_cut_finer_and_promises_nothing() -> None:
    footage = footage_of([watched(*[0.05] * 60)], block_s=10.0)  # 3 s
    assert footage.block_hours.size == 20
    assert footage.hours < footage.hours_for_promise == pytest.approx(200 / 3600)


def test_pairs_longer_than_a_block_are_a_block_each() -> None:
    footage = footage_of([watched(4.0, 1.0, 30.0, scores=(0.9,))], block_s=0.1)
    assert footage.block_hours * 3600 == pytest.approx([4.0, 1.0, 30.0])
    assert footage.blocks.tolist() == [0, 1, 2]


def test_a_recording_of_which_nothing_was_judged_has_no_block() -> None:
    footage = footage_of([watched(), watched(0.1, 0.1)], block_s=0.1)
    assert footage.block_hours.size == 2
