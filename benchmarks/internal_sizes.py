"""What judging at an internal size costs and saves: regions, and the time of a pair beside DIS flow (medium).

Simulated 752x480 sequences of fixed seeds that no training has seen, and any other labelled recordings (KITTI drives,
say). For each size: average precision, recall at 0.1 false alarms a frame, what is labelled as motion, and the median
time of the same pairs, whose turns alternate with DIS at the picture's own size. One core.

    python benchmarks/internal_sizes.py
    python benchmarks/internal_sizes.py 2011_09_26_drive_0011_sync --sizes 0,240 --out /tmp/internal-sizes
"""

from __future__ import annotations

import argparse
import contextlib
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read once, when torch loads
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np

from viflow_anomaly.allocator import keep_freed_memory
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.evaluation.detection_scores import DetectionScores, ScoredBox
from viflow_anomaly.evaluation.flow_report import circumstances
from viflow_anomaly.evaluation.labelled_pairs import LabelledPairs, SimulatedPairs, every_nth, open_labelled
from viflow_anomaly.evaluation.report_files import write_report
from viflow_anomaly.sensor_data import FramePair
from viflow_anomaly.simulator.config import SimulatorConfig
from viflow_anomaly.simulator.run import simulate

FOLDER = Path("runs/internal-sizes")
RESULTS = Path("benchmarks/results/internal-sizes")
SEEDS = {"drone": 912_000, "car": 962_000}
SEQUENCES, FRAMES, WIDTH, HEIGHT = 10, 8, 752, 480
TIMED_PAIRS, ROUNDS = 5, 6
COLUMNS = ("roi_ap", "recall_at_0.1_false_alarms", "recall", "precision", "false_alarms_per_frame", "ms", "over_dis")


def simulated(folder: Path, jobs: int) -> list[LabelledPairs]:
    """The sequences, made where they are missing."""
    found: list[LabelledPairs] = []
    for rig, seed in SEEDS.items():
        asked = {"rig": rig, "seed": seed, "sequences": SEQUENCES, "frames": FRAMES, "jobs": jobs}
        config = SimulatorConfig.model_validate({**asked, "width": WIDTH, "height": HEIGHT})
        found += [SimulatedPairs(path, group=f"{rig} {WIDTH}x{HEIGHT}") for path in simulate(config, folder / rig)]
    return found


def scores(detector: AnomalyDetector, sequences: Sequence[LabelledPairs]) -> dict[str, Any]:
    """What one configuration finds."""
    found = DetectionScores()
    for pairs in sequences:
        for index in range(len(pairs)):
            pair = pairs.pair(index)
            try:
                detection = detector.detect(pair)
            except InvalidInputError:
                continue
            boxes = [ScoredBox(roi.bbox, roi.score, roi.label == "independent_motion") for roi in detection.rois]
            found.add_frame(boxes, pairs.labels(index), pair.interval_ns * 1e-9)
    return found.summary()


def usable(detector: AnomalyDetector, members: Sequence[LabelledPairs]) -> list[FramePair]:
    """A few pairs that can be judged, of different sequences where there are several."""
    found: list[FramePair] = []
    for pairs, index in every_nth(members, max(1, sum(map(len, members)) // (4 * TIMED_PAIRS))):
        with contextlib.suppress(InvalidInputError):
            pair = pairs.pair(index)
            detector.detect(pair)
            found.append(pair)
    return found[:: max(1, len(found) // TIMED_PAIRS)][:TIMED_PAIRS]


def milliseconds(detectors: Sequence[AnomalyDetector], pairs: Sequence[FramePair]) -> tuple[list[float], float]:
    """Median time of a pair of each detector, and of DIS."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    spent: list[list[float]] = [[] for _ in range(len(detectors) + 1)]
    for number in range(ROUNDS):
        for pair in pairs:
            for which, detector in enumerate((*detectors, None)):
                started = time.perf_counter()
                if detector is None:
                    dis.calc(pair.source.image, pair.target.image, None)
                else:
                    detector.detect(pair)
                if number:  # the first round warms up
                    spent[which].append((time.perf_counter() - started) * 1e3)
    medians = [float(np.median(one)) for one in spent]
    return medians[:-1], medians[-1]


def measure(sequences: Sequence[LabelledPairs], sizes: Sequence[int]) -> dict[str, Any]:
    """One table a group of sequences; a row a size."""
    detector = AnomalyDetector.from_checkpoint(threads=1)
    config = detector.config
    detectors = [
        detector.with_config(config.model_copy(update={"internal_short_side_px": size, "include_masks": False}))
        for size in sizes
    ]
    groups: dict[str, list[LabelledPairs]] = {}
    for pairs in sequences:
        groups.setdefault(pairs.group, []).append(pairs)
    tables = {}
    for group, members in groups.items():
        taken_ms, dis_ms = milliseconds(detectors, usable(detector, members))
        rows = []
        for size, one, ms in zip(sizes, detectors, taken_ms, strict=True):
            row = {name: value for name, value in scores(one, members).items() if name in COLUMNS}
            rows.append({"short_side_px": size, **row, "ms": round(ms, 2), "over_dis": round(ms / dis_ms, 3)})
        tables[group] = {"dis_ms": round(dis_ms, 2), "rows": rows}
    return {**circumstances(), "load_1min": round(os.getloadavg()[0], 2), "groups": tables}


def markdown(report: dict[str, Any]) -> str:
    lines = ["# Internal sizes", ""]
    for group, table in report["groups"].items():
        lines += [
            f"## {group}",
            "",
            "| shorter side | " + " | ".join(COLUMNS) + " |",
            "|---" * (len(COLUMNS) + 1) + "|",
        ]
        for row in table["rows"]:
            told = ("-" if row[name] is None else f"{row[name]:.3g}" for name in COLUMNS)
            cells = [str(row["short_side_px"] or "as it came"), *told]
            lines.append("| " + " | ".join(cells) + " |")
        lines += ["", f"DIS flow, medium, at the picture's own size: {table['dis_ms']} ms.", ""]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path, help="labelled recordings beside the simulated ones")
    parser.add_argument("--sizes", default="0,360,240,180,128", help="shorter sides in pixels, 0: as it came")
    parser.add_argument("--folder", type=Path, default=FOLDER, help=f"of the sequences (default {FOLDER})")
    parser.add_argument("--out", type=Path, default=RESULTS, help=f"without suffix (default {RESULTS})")
    parser.add_argument("--jobs", type=int, default=1, help="processes that simulate (default 1)")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    keep_freed_memory()  # as the command line and the service do
    sequences = [*simulated(arguments.folder, arguments.jobs), *map(open_labelled, arguments.recordings)]
    report = measure(sequences, [int(size) for size in arguments.sizes.split(",")])
    write_report(arguments.out, report, markdown(report))
    print(markdown(report))


if __name__ == "__main__":
    main()
