"""Regions of the bundled model and of its rivals on simulated sequences of fixed seeds that no training has seen.

Drone and car, several image sizes, a camera that rests, one that only turns, and worlds in which nothing moves by
itself, where only false alarms count. Sequences are simulated into a folder; those that are there are kept.

    python benchmarks/detection_suite.py                     # about a quarter of an hour on one core
    python benchmarks/detection_suite.py --only drone-static --no-rivals --out /tmp/static

Training takes seeds from 10000 and from 50000 on (`make model`), up to 60000; the held-out sequences of `make held-out`
have 900000 and 950000 on. These have 910000 (drone) and 960000 (car) on, a hundred apart for each scenario.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read once, when torch loads

import cv2

from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.evaluation.detection_methods import OURS, DetectionMethod, DetectorMethod, rival_methods
from viflow_anomaly.evaluation.detection_plots import draw_detection_figures
from viflow_anomaly.evaluation.detection_quality import measure_detection
from viflow_anomaly.evaluation.detection_report import detection_report
from viflow_anomaly.evaluation.detection_tables import markdown
from viflow_anomaly.evaluation.labelled_pairs import SimulatedPairs
from viflow_anomaly.evaluation.report_files import write_report
from viflow_anomaly.simulator.config import SimulatorConfig
from viflow_anomaly.simulator.run import simulate

FOLDER = Path("runs/detection-suite")
RESULTS = Path("benchmarks/results/detection-suite")
SEQUENCES, FRAMES = 3, 12


class Scenario(NamedTuple):
    """What the simulator is asked for (``SimulatorConfig``), beside the number of sequences and frames."""

    rig: str
    seed: int
    width: int
    height: int
    motion: str = "normal"
    movers: tuple[int, int] = (1, 4)


SCENARIOS: dict[str, Scenario] = {
    "drone-224x224": Scenario("drone", 910_000, 224, 224),
    "drone-384x256": Scenario("drone", 910_100, 384, 256),
    "drone-752x480": Scenario("drone", 910_200, 752, 480),
    "drone-static": Scenario("drone", 910_300, 384, 256, motion="static"),
    "drone-rotation": Scenario("drone", 910_400, 384, 256, motion="rotation"),
    "drone-no-movers": Scenario("drone", 910_500, 384, 256, movers=(0, 0)),
    "car-416x128": Scenario("car", 960_000, 416, 128),
    "car-752x480": Scenario("car", 960_100, 752, 480),
    "car-static": Scenario("car", 960_200, 416, 128, motion="static"),
    "car-no-movers": Scenario("car", 960_300, 416, 128, movers=(0, 0)),
}


def simulated(scenario: Scenario, folder: Path, jobs: int) -> list[Path]:
    """The sequences of one scenario, made where they are missing."""
    values = {**scenario._asdict(), "sequences": SEQUENCES, "frames": FRAMES, "jobs": jobs}
    return simulate(SimulatorConfig.model_validate(values), folder)


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """The report of the chosen scenarios; each is a group."""
    names: Sequence[str] = arguments.only or list(SCENARIOS)
    sequences = []
    for name in names:
        paths = simulated(SCENARIOS[name], arguments.folder / name, arguments.jobs)
        sequences += [SimulatedPairs(path, group=name) for path in paths]
    cv2.setNumThreads(1)
    detector = AnomalyDetector.from_checkpoint(arguments.checkpoint, threads=1)
    methods: list[DetectionMethod] = [DetectorMethod(OURS, detector)]
    methods += rival_methods(detector) if arguments.rivals else []
    options = {
        "scenarios": {name: SCENARIOS[name]._asdict() for name in names},
        "sequences": SEQUENCES,
        "frames": FRAMES,
    }
    run = measure_detection(methods, sequences)
    return detection_report(run, detector.model_info, detector.config.model_dump(mode="json"), options=options)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=SCENARIOS, metavar="SCENARIO", help=", ".join(SCENARIOS))
    parser.add_argument("--folder", type=Path, default=FOLDER, help=f"of the sequences (default {FOLDER})")
    parser.add_argument("--out", type=Path, default=RESULTS, help=f"without suffix (default {RESULTS})")
    parser.add_argument("--plots", type=Path, help="folder for charts")
    parser.add_argument("--checkpoint", type=Path, help="another model than the bundled one")
    parser.add_argument("--no-rivals", dest="rivals", action="store_false")
    parser.add_argument("--jobs", type=int, default=1, help="processes that simulate (default 1)")
    arguments = parser.parse_args()
    report = measure(arguments)
    text = markdown(report, title="Detection suite: simulated sequences of fixed seeds")
    write_report(arguments.out, report, text)
    if arguments.plots is not None:
        draw_detection_figures(arguments.plots, report)
    print(text)


if __name__ == "__main__":
    main()
