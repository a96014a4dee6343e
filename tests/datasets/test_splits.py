"""Train and test never share a frame under blocks; shares, determinism, and what the paper's rule does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds import in_memory, make_world

from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.recording import FileRecording
from viflow_anomaly.datasets.splits import SplitRule, split_pairs
from viflow_anomaly.errors import InvalidInputError


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> FileRecording:
    return in_memory(make_world(frames=1), tmp_path_factory.mktemp("world"))


def recorded(recording: FileRecording, stamps_ns: np.ndarray, name: str = "V1_01_easy") -> FileRecording:
    """Stamps are all that a split looks at; every frame is the same file."""
    return replace(
        recording,
        name=name,
        frame_timestamps_ns=stamps_ns.astype(np.int64),
        frame_paths=recording.frame_paths * stamps_ns.size,
    )


def steady(recording: FileRecording, frames: int, rate_hz: float = 20.0, **names: str) -> FileRecording:
    return recorded(recording, 10**18 + np.arange(frames) * round(1e9 / rate_hz), **names)


def frames_of(pairs: RecordingPairs, indices: list[int]) -> set[int]:
    return {frame for index in indices for frame in pairs.indices[index]}


GAPS_MS = st.lists(st.integers(10, 3000), min_size=1, max_size=150)
LOOK_AHEADS = st.sets(st.integers(1, 4), min_size=1)


@given(GAPS_MS, LOOK_AHEADS, st.integers(0, 2**31), st.floats(0.05, 0.95), st.floats(0.05, 20.0))
def test_blocks_never_share_a_frame(
    recording: FileRecording, gaps_ms: list[int], look_aheads: set[int], seed: int, share: float, block_s: float
) -> None:
    stamps = 10**18 + np.cumsum([0, *gaps_ms]) * 10**6
    pairs = RecordingPairs(recorded(recording, stamps), tuple(look_aheads))
    split = split_pairs(pairs, "blocks", seed=seed, test_share=share, block_s=block_s)
    assert sorted(split.train + split.test + split.straddling) == list(range(len(pairs)))
    assert frames_of(pairs, split.train).isdisjoint(frames_of(pairs, split.test))
    block_of = (stamps - stamps[0]) // round(block_s * 1e9)
    train, test = ({int(block_of[frame]) for frame in frames_of(pairs, part)} for part in (split.train, split.test))
    assert train.isdisjoint(test)
    for index in split.straddling:
        source, target = pairs.indices[index]
        assert block_of[source] != block_of[target]


@given(GAPS_MS, LOOK_AHEADS, st.integers(0, 2**31), st.floats(0.05, 0.95))
def test_random_uses_every_pair_once(
    recording: FileRecording, gaps_ms: list[int], look_aheads: set[int], seed: int, share: float
) -> None:
    stamps = 10**18 + np.cumsum([0, *gaps_ms]) * 10**6
    pairs = RecordingPairs(recorded(recording, stamps), tuple(look_aheads))
    split = split_pairs(pairs, "random", seed=seed, test_share=share)
    assert sorted(split.train + split.test) == list(range(len(pairs)))
    assert split.straddling == []
    assert split.train == sorted(split.train)
    assert split.test == sorted(split.test)


def test_a_random_split_keeps_its_share_and_knows_no_look_aheads(recording: FileRecording) -> None:
    near, far = (RecordingPairs(steady(recording, 2000, 20.0), look_aheads) for look_aheads in ((1,), (1, 2, 4)))
    tested = [{pairs.stamps(k) for k in split_pairs(pairs, "random", seed=5).test} for pairs in (near, far)]
    assert tested[0] < tested[1]
    assert {one for one in tested[1] if one in {near.stamps(k) for k in range(len(near))}} == tested[0]
    assert abs(len(tested[1]) / len(far) - 0.2) < 0.02


@pytest.mark.parametrize("rate_hz", [10.0, 20.0])
def test_blocks_are_of_time_and_a_fifth_of_them_is_for_the_test(recording: FileRecording, rate_hz: float) -> None:
    pairs = RecordingPairs(steady(recording, round(100 * rate_hz), rate_hz), (1,))
    split = split_pairs(pairs, "blocks", seed=0)
    blocks = {int(pairs.indices[index][0] / rate_hz // 5) for index in split.test}
    assert len(blocks) == 4  # of the twenty blocks of 5 s
    assert len(split.test) == pytest.approx(0.2 * len(pairs), rel=0.05)
    assert len(split.straddling) <= 2 * 4
    whole = [index for index, (source, target) in enumerate(pairs.indices) if source // rate_hz // 5 in blocks]
    assert set(split.test) <= set(whole)


def test_the_same_time_is_tested_at_any_rate(recording: FileRecording) -> None:
    tested = []
    for rate_hz in (10.0, 20.0):
        pairs = RecordingPairs(steady(recording, round(60 * rate_hz), rate_hz), (1,))
        test = split_pairs(pairs, "blocks", seed=3).test
        tested.append({int(pairs.indices[index][0] / rate_hz // 5) for index in test})
    assert tested[0] == tested[1]


def test_straddling_pairs_are_those_across_the_border(recording: FileRecording) -> None:
    pairs = RecordingPairs(steady(recording, 200), (1, 4))  # two blocks of 100 frames
    split = split_pairs(pairs, "blocks", seed=0, test_share=0.5)
    assert [pairs.indices[index] for index in split.straddling] == [
        (96, 100),
        (97, 101),
        (98, 102),
        (99, 100),
        (99, 103),
    ]
    assert len(split.train) == 99 + 96
    assert len(split.test) == 99 + 96


def test_recordings_of_one_block_keep_the_share_between_them(recording: FileRecording) -> None:
    tests = 0
    for k in range(500):
        pairs = RecordingPairs(steady(recording, 60, name=f"drone_{k:06d}"), (1,))
        split = split_pairs(pairs, "blocks", seed=0)
        assert (len(split.train), len(split.test)) in {(59, 0), (0, 59)}
        tests += bool(split.test)
    assert tests == pytest.approx(100, abs=30)  # three standard deviations


@pytest.mark.parametrize("rule", ["blocks", "random"])
def test_a_split_depends_on_name_and_seed_only(recording: FileRecording, rule: SplitRule, tmp_path: Path) -> None:
    def split(name: str, seed: int) -> list[int]:
        moved = replace(steady(recording, 1000, name=name), root=tmp_path / "elsewhere")
        return split_pairs(RecordingPairs(moved, (1,)), rule, seed=seed).test

    assert split("a", 0) == split("a", 0)
    assert split("a", 0) != split("b", 0)
    assert split("a", 0) != split("a", 1)


def test_a_split_is_the_same_in_every_process(recording: FileRecording) -> None:
    pairs = RecordingPairs(steady(recording, 1000), (1,))
    split = split_pairs(pairs, "blocks", seed=0)
    assert sorted({index // 100 for index in split.test}) == BLOCKS_OF_V1_01_EASY


BLOCKS_OF_V1_01_EASY = [3, 6]


@pytest.mark.parametrize(
    ("options", "code", "field"),
    [
        ({"rule": "alternating"}, "split_rule_unknown", "rule"),
        ({"test_share": 0.0}, "split_share_out_of_range", "test_share"),
        ({"test_share": 1.0}, "split_share_out_of_range", "test_share"),
        ({"test_share": float("nan")}, "split_share_out_of_range", "test_share"),
        ({"block_s": 0.0}, "split_block_out_of_range", "block_s"),
        ({"block_s": float("nan")}, "split_block_out_of_range", "block_s"),
        ({"block_s": float("inf")}, "split_block_out_of_range", "block_s"),
    ],
)
def test_nonsense_is_refused(options: dict[str, object], code: str, field: str, recording: FileRecording) -> None:
    pairs = RecordingPairs(steady(recording, 10), (1,))
    with pytest.raises(InvalidInputError) as caught:
        split_pairs(pairs, **({"rule": "blocks", "seed": 0} | options))  # type: ignore[arg-type]
    assert (caught.value.code, caught.value.field) == (code, field)
