"""Recordings -> the scores of all regions that some threshold labels as motion, in blocks of seconds; see
``alarm_budget``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from viflow_anomaly.alarm_budget import LOWEST_THRESHOLD, ScoredFootage
from viflow_anomaly.config import DetectorConfig, MotorSource
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.detection import Detection
from viflow_anomaly.errors import DatasetError, InvalidInputError, ViflowError
from viflow_anomaly.pair_detector import PairDetector

SECONDS_PER_HOUR = 3600.0
DEFAULT_BLOCK_S = 10.0
MIN_BLOCKS = 20
"""Fewer say too little of how alarms clump."""


class JudgedPair(NamedTuple):
    """How long a pair lasts, and the scores of its regions labelled as motion at the lowest threshold."""

    seconds: float
    scores: tuple[float, ...]


@dataclass(frozen=True)
class WatchedRecording:
    """What one recording gave, in time order.

    Attributes:
        name, camera: which (no path).
        judged: the pairs that were judged.
        abstained: how many could not be.
        failed: how many could not be used at all, by error code.
    """

    name: str
    camera: str | None
    judged: tuple[JudgedPair, ...]
    abstained: int
    failed: Mapping[str, int]

    @property
    def seconds(self) -> float:
        return sum(pair.seconds for pair in self.judged)


OnProgress = Callable[[int, int], None]
"""Called after every pair with: pairs behind us, pairs in all."""


def watch_recordings(
    recordings: Sequence[Recording], detector: PairDetector, *, on_progress: OnProgress | None = None
) -> list[WatchedRecording]:
    """Judge all pairs of successive frames; a pair that cannot be used is counted and left out.

    Args:
        recordings: without movers.
        detector: its ``regions.motion_score`` is set aside.
        on_progress: told after every pair.

    Raises:
        DatasetError: ``recording_too_short``, ``no_usable_pairs``; ``trajectory_missing`` for a model that wants
            displacements.
        InvalidInputError: ``recording_repeated``.
    """
    _refuse_repeated(recordings)
    open_detector = detector.with_config(_lowest_threshold(detector.config))
    watched, sequences = [], [_pairs(recording, detector.motor_source) for recording in recordings]
    total, behind = sum(map(len, sequences)), 0
    for pairs in sequences:
        judged, abstained, failed = [], 0, Counter[str]()
        for index in range(len(pairs)):
            try:
                detection = open_detector.detect(pairs[index])
            except ViflowError as err:
                failed[err.code] += 1
            else:
                abstained += detection.status == "abstained"
                judged += [_judged(detection)] if detection.status == "ok" else []
            behind += 1
            if on_progress:
                on_progress(behind, total)
        recording = pairs.recording
        watched.append(
            WatchedRecording(
                recording.name, recording.camera_name, tuple(judged), abstained, dict(sorted(failed.items()))
            )
        )
    if not any(one.judged for one in watched):
        abstained, lost = (
            sum(one.abstained for one in watched),
            sum((Counter(one.failed) for one in watched), Counter()),
        )
        raise DatasetError(
            f"expected pairs that can be judged, found none in {total} ({abstained} abstained, failed: {dict(lost)})",
            code="no_usable_pairs",
        )
    return watched


def footage_of(watched: Sequence[WatchedRecording], *, block_s: float = DEFAULT_BLOCK_S) -> ScoredFootage:
    """The scores in blocks of about ``block_s`` seconds of judged pairs.

    A recording is cut into equal parts; none reaches into the next recording, and one that is shorter than a block is
    a block. Footage of less than ``MIN_BLOCKS`` blocks is cut into shorter ones, and is too short for any promise.
    """
    total_s = sum(recording.seconds for recording in watched)
    part_s = min(block_s, total_s / MIN_BLOCKS)
    hours: list[float] = []
    scores: list[float] = []
    blocks: list[int] = []
    for recording in watched:
        count = max(1, round(recording.seconds / part_s))
        before_s, last = 0.0, None
        for pair in recording.judged:
            part = min(count - 1, int(before_s / recording.seconds * count))
            before_s += pair.seconds
            if part != last:
                hours.append(0.0)
            last = part
            hours[-1] += pair.seconds / SECONDS_PER_HOUR
            scores += pair.scores
            blocks += [len(hours) - 1] * len(pair.scores)
    return ScoredFootage(
        np.array(hours),
        np.array(scores, np.float64),
        np.array(blocks, np.int64),
        hours_for_promise=MIN_BLOCKS * block_s / SECONDS_PER_HOUR,
    )


def _lowest_threshold(config: DetectorConfig) -> DetectorConfig:
    regions = config.regions.model_copy(update={"motion_score": LOWEST_THRESHOLD})
    return config.model_copy(update={"regions": regions, "include_masks": False})


def _judged(detection: Detection) -> JudgedPair:
    return JudgedPair(
        seconds=(detection.target_timestamp_ns - detection.source_timestamp_ns) * 1e-9,
        scores=tuple(roi.score for roi in detection.rois if roi.label == "independent_motion"),
    )


def _pairs(recording: Recording, motor_source: MotorSource | None) -> RecordingPairs:
    pairs = RecordingPairs(recording, motor_source=motor_source)
    if not len(pairs):
        raise DatasetError(
            f"{recording.root}: expected at least 2 frames, found {len(recording)}", code="recording_too_short"
        )
    return pairs


def _refuse_repeated(recordings: Sequence[Recording]) -> None:
    """The same footage twice would look like twice the certainty."""
    seen = Counter((recording.root.resolve(), recording.camera_name) for recording in recordings)
    for (root, _), times in seen.items():
        if times > 1:
            raise InvalidInputError(
                f"{root}: expected each recording once, found it {times} times",
                code="recording_repeated",
                field="recordings",
            )
