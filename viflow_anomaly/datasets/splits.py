"""Which pairs of a recording are for training and which for testing.

``blocks``, the rule that does not leak: the recording is cut into blocks of time, whole blocks are drawn for the test,
and a pair belongs to a part only if both its frames do; one whose frames lie in different parts is left out of both.

``random``, the paper's rule [Datasets]: pairs are drawn one by one. Neighbouring pairs share frames, and with
look-aheads up to four the same frame may be in both parts many times: what is measured on such a test is flattered.

Either depends on the recording's name and frames and on the seed only: not on what other recordings or look-aheads
there are.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.sensor_data import Int64Array

SplitRule = Literal["blocks", "random"]
SPLIT_RULES: tuple[SplitRule, ...] = ("blocks", "random")
BLOCK_RANGE_S = (0.001, 1e9)


@dataclass(frozen=True)
class Split:
    """Indices into the pairs of one recording, each in order; every pair is in exactly one of the three."""

    train: list[int]
    test: list[int]
    straddling: list[int]


def split_pairs(
    pairs: RecordingPairs, rule: SplitRule, *, seed: int, test_share: float = 0.2, block_s: float = 5.0
) -> Split:
    """Divide the pairs of one recording.

    Under ``blocks`` a recording of n blocks gives n * test_share of them to the test, the fraction by chance: one of
    a single block is a test with probability ``test_share``, so that many short recordings keep the share too.

    Args:
        pairs: of one recording.
        rule: ``blocks`` or ``random``.
        seed: from 0 up.
        test_share: of the blocks (``blocks``), or the chance of each pair (``random``); above 0 and below 1.
        block_s: length of a block in seconds of the camera's clock, counted from the first frame.

    Raises:
        InvalidInputError: ``split_rule_unknown``, ``split_share_out_of_range``, ``split_block_out_of_range``.
    """
    _check(rule, test_share, block_s)
    rng = _generator(pairs.recording.name, seed)
    if rule == "random":
        tested = [_lot(pairs.recording.name, seed, *pairs.stamps(k)) < test_share for k in range(len(pairs))]
        return Split([k for k, one in enumerate(tested) if not one], [k for k, one in enumerate(tested) if one], [])
    is_test = _tested_frames(pairs.recording.frame_timestamps_ns, rng, test_share, block_s)
    split = Split([], [], [])
    for index, (source, target) in enumerate(pairs.indices):
        part = split.test if is_test[source] else split.train
        (part if is_test[source] == is_test[target] else split.straddling).append(index)
    return split


def _check(rule: str, test_share: float, block_s: float) -> None:
    if rule not in SPLIT_RULES:
        raise InvalidInputError(
            f"rule: expected one of {', '.join(SPLIT_RULES)}, found {rule!r}", code="split_rule_unknown", field="rule"
        )
    if not 0 < test_share < 1:
        raise InvalidInputError(
            f"test_share: expected a share between 0 and 1, found {test_share}",
            code="split_share_out_of_range",
            field="test_share",
        )
    if not BLOCK_RANGE_S[0] <= block_s <= BLOCK_RANGE_S[1]:
        raise InvalidInputError(
            f"block_s: expected {BLOCK_RANGE_S[0]} to {BLOCK_RANGE_S[1]:.0f} seconds, found {block_s}",
            code="split_block_out_of_range",
            field="block_s",
        )


def _generator(name: str, seed: int) -> np.random.Generator:
    """Python's own hash of a text changes from process to process."""
    digest = hashlib.sha256(name.encode()).digest()
    return np.random.default_rng([seed, int.from_bytes(digest[:8], "big")])


def _lot(name: str, seed: int, source_ns: int, target_ns: int) -> float:
    """A number in 0..1 of one pair's own: the same whatever other pairs there are (look-aheads)."""
    digest = hashlib.sha256(f"{seed} {source_ns} {target_ns} {name}".encode()).digest()
    return int.from_bytes(digest[:8], "big") / 2**64


def _share_of(count: int, share: float, rng: np.random.Generator) -> int:
    """``count * share``, rounded up with the probability of its fraction: right on average at any count."""
    return math.floor(count * share + float(rng.random()))


def _tested_frames(stamps_ns: Int64Array, rng: np.random.Generator, share: float, block_s: float) -> list[bool]:
    """For each frame whether its block is for the test."""
    numbers = (stamps_ns - stamps_ns[0]) // round(block_s * 1e9)
    blocks, block_of_frame = np.unique(numbers, return_inverse=True)
    tested = np.zeros(blocks.size, dtype=np.bool_)
    tested[rng.permutation(blocks.size)[: _share_of(blocks.size, share, rng)]] = True
    return [bool(one) for one in tested[block_of_frame]]
