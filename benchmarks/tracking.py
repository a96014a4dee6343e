"""What tracking does to the regions of simulated sequences with ground truth, and what it costs.

For each group of sequences (the name up to its first underscore): recall and false alarms of what is labelled
``independent_motion``, as two frames say and with persistence required; how often a mover that is found twice in a row
has the same number; how far a track's own speed is from the truth; milliseconds a pair.

    python benchmarks/tracking.py SEQUENCE... --out benchmarks/results/tracking.json
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from viflow_anomaly.checkpoint_record import write_atomically
from viflow_anomaly.config import TrackingConfig
from viflow_anomaly.detection import OWN_VELOCITY_NAMES, Detection
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.evaluation.detection_scores import MIN_IOU, DetectionScores, ScoredBox, iou
from viflow_anomaly.evaluation.flow_report import circumstances
from viflow_anomaly.evaluation.flow_truth import RecordingTruth
from viflow_anomaly.evaluation.labelled_pairs import Labels, labels_of
from viflow_anomaly.tracking import Tracker, TrackingState

TIMED_ROUNDS = 20
SETTLED_SIGHTINGS = 4
"""A track's speed is compared with the truth from this sighting on."""


class Judged(NamedTuple):
    """One pair: what was detected, what is true."""

    detection: Detection
    labels: Labels
    mover_ids: tuple[int, ...]


@dataclass
class Identity:
    """How movers keep their numbers, and how well their speed is known; of one in parts the best fitting one counts."""

    kept: int = 0
    changed: int = 0
    numbered: int = 0
    found: int = 0
    speed_errors_px_s: list[float] = field(default_factory=list)

    def add(self, sequence: Iterable[Judged]) -> None:
        number_of: dict[int, int] = {}
        sightings: dict[int, int] = {}
        for detection, labels, mover_ids in sequence:
            interval_s = (detection.target_timestamp_ns - detection.source_timestamp_ns) * 1e-9
            for mover, mover_id in zip(labels.objects, mover_ids, strict=True):
                overlaps = [(iou(roi.bbox, mover.bbox), -roi.id, roi) for roi in detection.rois]
                best, _, roi = max(overlaps, key=lambda one: one[:2], default=(0.0, 0, None))
                if best < MIN_IOU or roi is None or not mover.counted:
                    continue
                self.found += 1
                if roi.track_id is None:
                    continue
                self.numbered += 1
                if mover_id in number_of:
                    self.kept += number_of[mover_id] == roi.track_id
                    self.changed += number_of[mover_id] != roi.track_id
                number_of[mover_id] = roi.track_id
                sightings[roi.track_id] = sightings.get(roi.track_id, 0) + 1
                if sightings[roi.track_id] >= SETTLED_SIGHTINGS:
                    speed = math.hypot(*(float(roi.evidence[name] or 0) for name in OWN_VELOCITY_NAMES))
                    self.speed_errors_px_s.append(abs(speed - mover.independent_flow_px / interval_s))


def judge(detector: AnomalyDetector, path: Path) -> list[Judged]:
    """Every pair of a sequence, untracked."""
    pairs = RecordingTruth(path)
    truth = pairs.ground_truth
    rows = []
    for index in range(len(pairs)):
        source_ns = pairs.name(index).source_timestamp_ns
        ids = tuple(thing.instance_id for thing in truth.objects(source_ns))
        rows.append(Judged(detector.detect(pairs.pair(index, detector.motor_source)), labels_of(truth, source_ns), ids))
    return rows


def tracked(rows: Sequence[Judged], config: TrackingConfig | None) -> list[Judged]:
    """The sequence with its tracks; as it is without a configuration."""
    state, done = TrackingState(), []
    for row in rows:
        detection = row.detection
        if config is not None:
            state, detection = Tracker(config).update(state, detection)
        done.append(row._replace(detection=detection))
    return done


def scores(sequences: Iterable[Sequence[Judged]]) -> dict[str, Any]:
    """Recall and false alarms of what is labelled as motion, and the curve's figures."""
    over_all, motion = DetectionScores(), DetectionScores()
    for row in (row for rows in sequences for row in rows):
        boxes = [ScoredBox(roi.bbox, roi.score, roi.label == "independent_motion") for roi in row.detection.rois]
        seconds = (row.detection.target_timestamp_ns - row.detection.source_timestamp_ns) * 1e-9
        over_all.add_frame(boxes, row.labels, seconds)
        motion.add_frame([box for box in boxes if box.motion], row.labels, seconds)
    summary = over_all.summary()
    kept = ("roi_ap", "recall_at_0.1_false_alarms", "false_alarms_per_frame")
    return {"recall": motion.summary()["recall"]} | {name: summary[name] for name in kept}


def milliseconds(sequences: Sequence[Sequence[Judged]]) -> dict[str, float]:
    """Mean over pairs of the quickest of some rounds, with the mean number of tracks."""
    tracker, spent_s, tracks = Tracker(TrackingConfig()), [], []
    for rows in sequences:
        state = TrackingState()
        for row in rows:
            rounds = []
            for _ in range(TIMED_ROUNDS):
                started = time.perf_counter()
                after, _ = tracker.update(state, row.detection)
                rounds.append(time.perf_counter() - started)
            state = after
            spent_s.append(min(rounds))
            tracks.append(len(state.tracks))
    return {"ms_per_pair": round(1e3 * statistics.mean(spent_s), 3), "tracks": round(statistics.mean(tracks), 1)}


def measure(sequences: Sequence[Sequence[Judged]]) -> dict[str, Any]:
    """One group's figures."""
    identity = Identity()
    numbered = [tracked(rows, TrackingConfig()) for rows in sequences]
    for rows in numbered:
        identity.add(rows)
    persistent = [tracked(rows, TrackingConfig(require_persistence=True)) for rows in sequences]
    return {
        "two_frames": scores(sequences),
        "persistence": scores(persistent),
        "found_movers_with_a_number": f"{identity.numbered}/{identity.found}",
        "number_kept": identity.kept,
        "number_changed": identity.changed,
        "own_speed_median_error_px_s": round(statistics.median(identity.speed_errors_px_s), 1),
        **milliseconds(sequences),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="+", type=Path)
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    detector = AnomalyDetector.from_checkpoint(arguments.checkpoint, threads=1)
    groups: dict[str, list[list[Judged]]] = {}
    for path in arguments.sequences:
        groups.setdefault(path.name.split("_", 1)[0], []).append(judge(detector, path))
    result = {
        "model": {"name": detector.model_info.name, "sha256": detector.model_info.sha256},
        **circumstances(),
        "groups": {name: measure(sequences) for name, sequences in sorted(groups.items())},
    }
    print(json.dumps(result["groups"], indent=2))
    if arguments.out is not None:
        write_atomically(arguments.out, (json.dumps(result, indent=2) + "\n").encode())


if __name__ == "__main__":
    main()
