"""Where true flow comes from: pairs of frames, and how the static world moves between them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.config import MotorSource, SplitConfig
from viflow_anomaly.datasets.camera_json import camera_to_mapping
from viflow_anomaly.datasets.ground_truth_folder import GroundTruthFolder
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.datasets.splits import split_pairs
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.sensor_data import FramePair

BoolArray = NDArray[np.bool_]


class PairName(NamedTuple):
    """Which pair: its sequence, how many frames apart, both stamps in nanoseconds."""

    sequence: str
    look_ahead: int
    source_timestamp_ns: int
    target_timestamp_ns: int

    def __str__(self) -> str:
        return f"{self.sequence} {self.source_timestamp_ns}-{self.target_timestamp_ns}"


class TrueFlow(NamedTuple):
    """flow_px [H, W, 2] float32 in source-image pixels, valid [H, W] where it is known."""

    flow_px: Float32Array
    valid: BoolArray


class FlowTruth(Protocol):
    """Pairs with ground truth, of one sequence."""

    @property
    def sequence(self) -> str:
        """Its name; the group is what stands before the first underscore."""

    def __len__(self) -> int:
        """How many pairs."""

    def name(self, index: int) -> PairName:
        """Which pair; no image is read."""

    def pair(self, index: int, motor_source: MotorSource | None = None) -> FramePair:
        """Both frames with the motor command that a network wants beside them (None: none).

        Raises:
            InvalidInputError: a pair that cannot be used; it is left out and counted.
            DatasetError: a recording that cannot be read.
        """

    def truth(self, index: int) -> TrueFlow:
        """The true flow from source to target.

        Raises:
            DatasetError: ``ground_truth_missing`` for a pair without; it is left out and counted.
                ``ground_truth_malformed``.
        """


class RecordingTruth:
    """A recording with ground truth in the simulator's layout (``groundtruth0``).

    Args:
        path: the recording.
        look_aheads: each between 1 and 4.
        ground_truth: the folder that holds ``groundtruth0``; None: the recording itself.
        movers: False: pixels of moving things do not count. The truth is the static world's, so that on a mover a
            method is wrong for seeing it; needs ``groundtruth0/instances``.

    Raises:
        DatasetError: ``ground_truth_missing`` without ground truth or pairs; ``ground_truth_camera_differs`` where it
            was rendered for another camera than the recording's; ``ground_truth_no_movers`` without ``movers`` where
            ground truth does not say which pixels those are; ``ground_truth_malformed``; as ``open_recording``.
        InvalidInputError: as ``RecordingPairs``.
    """

    def __init__(
        self,
        path: Path,
        look_aheads: Sequence[int] = (1,),
        *,
        ground_truth: Path | None = None,
        movers: bool = True,
    ) -> None:
        self.recording = open_recording(path)
        self._movers = movers
        self._look_aheads = tuple(look_aheads)
        truth = GroundTruthFolder.find(self.recording.root if ground_truth is None else ground_truth)
        self.pairs = RecordingPairs(self.recording, self._look_aheads, motor_source=None)
        if truth is None or not self.pairs:
            found = "none" if truth is None else f"{len(self.recording)} frame"
            place = path if ground_truth is None else ground_truth
            raise DatasetError(
                f"{place}: expected a recording with ground truth (groundtruth0) and two frames, found {found}",
                code="ground_truth_missing",
                field="validation",
            )
        if truth.is_rendered:
            _require_same_camera(truth, self.recording)
        if not movers and not truth.has_instances:
            raise DatasetError(
                f"{truth.folder}: expected instances/, which say what moves, to leave movers out, found none (ground "
                "truth that is rendered for a recording knows of no movers)",
                code="ground_truth_no_movers",
                field="movers",
            )
        self.ground_truth = truth
        self._pairs_by_source: dict[MotorSource | None, RecordingPairs] = {None: self.pairs}

    @property
    def sequence(self) -> str:
        return self.recording.name

    def __len__(self) -> int:
        return len(self.pairs)

    def name(self, index: int) -> PairName:
        source, target = self.pairs.indices[index]
        return PairName(self.sequence, target - source, *self.pairs.stamps(index))

    def pair(self, index: int, motor_source: MotorSource | None = None) -> FramePair:
        if motor_source not in self._pairs_by_source:
            pairs = RecordingPairs(self.recording, self._look_aheads, motor_source=motor_source)
            self._pairs_by_source[motor_source] = pairs
        return self._pairs_by_source[motor_source][index]

    def truth(self, index: int) -> TrueFlow:
        stamps = self.pairs.stamps(index)
        flow, valid = self.ground_truth.static_flow(*stamps)
        return TrueFlow(flow, valid if self._movers else valid & (self.ground_truth.instances(stamps[0]) == 0))


def _require_same_camera(truth: GroundTruthFolder, recording: Recording) -> None:
    """Two cameras of a rig have the same stamps, and often the same size: nothing else would tell."""
    known = camera_to_mapping(truth.camera) | {"name": truth.camera_name}
    found: dict[str, object] = {} if recording.camera is None else camera_to_mapping(recording.camera)
    found["name"] = recording.camera_name
    both = [key for key in known if known[key] is not None and found.get(key) is not None]
    wrong = next((key for key in both if not _same(known[key], found[key])), None)
    if wrong is not None:
        raise DatasetError(
            f"{truth.folder}: expected ground truth of the camera of {recording.root}, whose {wrong} is "
            f"{found[wrong]!r:.120}, found ground truth of one whose {wrong} is {known[wrong]!r:.120}",
            code="ground_truth_camera_differs",
            field="ground_truth",
        )


def _same(one: object, other: object) -> bool:
    """Equal but for the last digits, which differ from machine to machine in a product of matrices."""
    if isinstance(one, str) or isinstance(other, str):
        return one == other
    first, second = np.asarray(one), np.asarray(other)
    return first.shape == second.shape and bool(np.allclose(first, second, rtol=1e-9, atol=1e-9))


class TestPart:
    """The pairs of a recording that a split keeps for the test (``SplitConfig``; its training never saw them).

    Args:
        whole: the recording.
        split: as the training had it, with the same look-aheads.

    Raises:
        InvalidInputError: as ``split_pairs``.
    """

    __test__ = False  # pytest: no test

    def __init__(self, whole: RecordingTruth, split: SplitConfig) -> None:
        assert split.rule != "none"
        parts = split_pairs(
            whole.pairs, split.rule, seed=split.seed, test_share=split.test_share, block_s=split.block_s
        )
        self._whole = whole
        self._indices = parts.test

    @property
    def sequence(self) -> str:
        return self._whole.sequence

    def __len__(self) -> int:
        return len(self._indices)

    def name(self, index: int) -> PairName:
        return self._whole.name(self._indices[index])

    def pair(self, index: int, motor_source: MotorSource | None = None) -> FramePair:
        return self._whole.pair(self._indices[index], motor_source)

    def truth(self, index: int) -> TrueFlow:
        return self._whole.truth(self._indices[index])


def spread(truths: Sequence[FlowTruth], max_pairs: int | None) -> list[tuple[FlowTruth, int]]:
    """(truth, index) of all pairs, or of ``max_pairs`` that are spread evenly over all of them."""
    chosen = [(truth, index) for truth in truths for index in range(len(truth))]
    if max_pairs is not None and len(chosen) > max_pairs:
        chosen = [chosen[k] for k in np.linspace(0, len(chosen) - 1, max_pairs).round().astype(int)]
    return chosen
