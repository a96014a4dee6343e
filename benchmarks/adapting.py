"""What adapting the bundled model to real rigs without labels is worth: docs/adapting.md's recipe, run and measured.

Each adaptation of ``ADAPTATIONS`` is trained (``train --init``), exported, and measured beside the checkpoint that it
starts from, on every recording, those that it has never seen told apart:

- photometric: mean absolute difference of the source image and its reconstruction over that of the frames as they are;
- lidar_flow: endpoint error over no motion's, of the drives with LiDAR (``groundtruth kitti``, ``evaluate flow``);
- regions: ``evaluate detect`` on the drives with labels;
- simulated: endpoint error over no motion's on held-out simulated sequences. What is forgotten shows here.

    python benchmarks/adapting.py --real-data DATA --held-out runs/model/held-out --runs runs/adapting

A fifth of each drive (blocks of one second) and half of the flight are kept from the training: ``kept`` is the
photometric error there. Trainings stay in ``--runs`` and are gone on with; they hold what was learnt from recordings
with licences of their own, so keep them out of the source tree. Everything is measured again at each call, or less:
``--only regions``. ``--rates 1e-4,3e-4`` compares learning rates on what their trainings left out, instead of all that.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read once, when torch loads

import cv2
import numpy as np
from reproduction import call, command

from viflow_anomaly.checkpoint_record import bundled_checkpoint, read_checkpoint, write_atomically
from viflow_anomaly.config import CorrectionConfig
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.recording import FileRecording
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.datasets.splits import split_pairs
from viflow_anomaly.errors import ViflowError
from viflow_anomaly.evaluation.detection_methods import OURS
from viflow_anomaly.evaluation.flow_methods import CORRECTED, FlowMethod, NoEstimateError, network_methods
from viflow_anomaly.evaluation.flow_report import circumstances
from viflow_anomaly.evaluation.flow_truth import PairName
from viflow_anomaly.evaluation.photometric_error import photometric_error
from viflow_anomaly.runtime.loading import load_runtime

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "adapting.json"
FLIGHT = "V1_01_easy"
SEQUENCES = ("01", "06")
DRIVE_5, DRIVE_11, DRIVE_27 = (f"2011_09_26_drive_00{number}_sync" for number in ("05", "11", "27"))
LIDAR_DRIVES = (DRIVE_5, DRIVE_27)
LABELLED_DRIVES = (DRIVE_5, DRIVE_11, DRIVE_27)
PLACES = {
    FLIGHT: f"euroc/{FLIGHT}",
    **{name: f"kitti/odometry/sequences/{name}" for name in SEQUENCES},
    **{name: f"kitti/2011_09_26/{name}" for name in LABELLED_DRIVES},
}
FLIGHT_BLOCKS = {"rule": "blocks", "block_s": 0.5, "test_share": 0.34}
"""Three seconds of flight: half-second blocks, of which the lot keeps about half for the test."""
DRIVE_BLOCKS = {"rule": "blocks", "block_s": 1.0, "test_share": 0.2}
MEASURES = ("photometric", "lidar_flow", "regions", "simulated")
REGION_FIGURES = ("frames", "movers", "roi_ap", "best_f1", "recall_at_0.1_false_alarms", "false_alarms_per_frame")
START = "start"
OFFSETS_S = (0.0, 0.03, 0.06, 0.09)


Named = dict[str, Path]
"""Checkpoints by the name that the report calls them."""


class Adaptation(NamedTuple):
    """Recordings to learn from, and the settings beside the defaults of ``train --init``."""

    name: str
    recordings: tuple[str, ...]
    settings: dict[str, Any] = {}  # noqa: RUF012  # never changed

    @property
    def split(self) -> dict[str, Any]:
        """What is kept for a test; empty: nothing."""
        return {key.rpartition(".")[2]: value for key, value in self.settings.items() if ".split." in key}


def _splitting(blocks: dict[str, Any]) -> dict[str, Any]:
    """Blocks as settings of a training."""
    return {f"training.split.{key}": value for key, value in blocks.items()}


ADAPTATIONS = (
    Adaptation("euroc", (FLIGHT,), _splitting(FLIGHT_BLOCKS)),
    Adaptation("kitti-without-0011", (*SEQUENCES, DRIVE_5, DRIVE_27), _splitting(DRIVE_BLOCKS)),
    Adaptation("kitti-without-0005-0027", (*SEQUENCES, DRIVE_11), _splitting(DRIVE_BLOCKS)),
)
RATE_STUDY = ADAPTATIONS[:2]
MAX_PAIRS = 60
"""Of a recording, evenly spread, for the photometric error."""
MAX_SIMULATED_PAIRS = 120


def trained(adaptation: Adaptation, real: Path, folder: Path, init: str, settings: dict[str, Any]) -> Path:
    """The adapted checkpoint, exported; a training that is there is gone on with, or refused if it is another."""
    assignments = [
        part for key, value in {**adaptation.settings, **settings}.items() for part in ("--set", f"{key}={value}")
    ]
    recordings = [real / PLACES[name] for name in adaptation.recordings]
    call(command("train", *recordings, "--init", init, "--out", folder, "--resume", *assignments), folder / "log")
    checkpoint = folder / "model.safetensors"
    call(command("export", "--checkpoint", checkpoint), folder / "log")
    return checkpoint


def evenly(chosen: Sequence[int], most: int) -> list[int]:
    """All of them, or so many spread evenly."""
    if len(chosen) <= most:
        return list(chosen)
    return [chosen[place] for place in np.linspace(0, len(chosen) - 1, most).round().astype(int)]


def photometric(method: FlowMethod, pairs: RecordingPairs, chosen: Sequence[int]) -> dict[str, Any]:
    """Mean residual of the reconstruction, and its ratio to the frame difference on the same pixels."""
    residuals, identities, failed = [], [], 0
    for index in evenly(chosen, MAX_PAIRS):
        try:
            pair = pairs[index]
            flow = method.flow(pair, PairName(pairs.recording.name, 1, *pairs.stamps(index)))
        except (ViflowError, NoEstimateError):
            failed += 1
            continue
        error = photometric_error(pair, flow)
        residuals.append(error.residual_gray)
        identities.append(error.frame_difference_gray)
    if not residuals:
        return {"pairs": 0, "failed": failed}
    residual, identity = float(np.mean(residuals)), float(np.mean(identities))
    return {
        "pairs": len(residuals),
        "failed": failed,
        "residual_gray": round(residual, 3),
        "ratio": round(residual / identity, 4),
    }


def both(checkpoint: Path, measure: Callable[[FlowMethod], dict[str, Any]]) -> dict[str, Any]:
    """What ``measure`` says of a checkpoint's flow as predicted and as corrected."""
    runtime, record = load_runtime(checkpoint, threads=1)
    methods = network_methods("", runtime, record, CorrectionConfig())
    return {"corrected" if one.about.corrected else "predicted": measure(one) for one in methods}


def photometric_all(checkpoint: Path, real: Path) -> dict[str, Any]:
    """Every recording; of the flight its training's blocks and its test's apart."""
    found = {}
    for name, place in PLACES.items():
        pairs = RecordingPairs(open_recording(real / place))
        parts: dict[str, Sequence[int]] = {name: range(len(pairs))}
        if name == FLIGHT:
            split = split_pairs(pairs, seed=0, **FLIGHT_BLOCKS)
            parts = {f"{name} (training blocks)": split.train, f"{name} (test blocks)": split.test}
        for part, chosen in parts.items():
            found[part] = both(checkpoint, lambda method, p=pairs, c=chosen: photometric(method, p, c))
    return found


def photometric_kept(checkpoint: Path, adaptation: Adaptation, real: Path) -> dict[str, Any]:
    """The parts of an adaptation's recordings that its split keeps from the training."""
    found = {}
    for name in adaptation.recordings:
        pairs = RecordingPairs(open_recording(real / PLACES[name]))
        kept = split_pairs(pairs, seed=0, **adaptation.split).test
        if kept:
            found[name] = both(checkpoint, lambda method, p=pairs, c=kept: photometric(method, p, c))
    return found


def time_offsets(checkpoint: Path, real: Path) -> dict[str, Any]:
    """Photometric ratios of the odometry sequences, their IMU read so much later than its stamps say."""
    found: dict[str, Any] = {}
    for name in SEQUENCES:
        recording = open_recording(real / PLACES[name])
        if not isinstance(recording, FileRecording) or recording.camera is None:
            raise SystemExit(f"{recording.name}: expected a recording with a calibrated camera")
        for offset_s in OFFSETS_S:
            camera = dataclasses.replace(recording.camera, time_offset_s=offset_s)
            pairs = RecordingPairs(dataclasses.replace(recording, camera=camera))
            figures = both(checkpoint, lambda method, p=pairs: photometric(method, p, range(len(p))))
            found.setdefault(name, {})[f"{offset_s:g}"] = {key: one["ratio"] for key, one in figures.items()}
    return found


def asked(*arguments: object) -> dict[str, Any]:
    """The JSON that a command writes into ``--out``."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "report.json"
        call(command(*arguments, "--out", out))
        report: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
    return report


def flow_figures(named: Named, *arguments: object) -> dict[str, Any]:
    """Endpoint error and its ratio to no motion's of every checkpoint, by group, as ``evaluate flow`` finds them."""
    chosen = [part for name, path in named.items() for part in ("--checkpoint", f"{name}={path}")]
    report = asked("evaluate", "flow", *arguments, *chosen, "--methods", "identity")
    return {
        group: {
            name: {
                key: {"epe_px": round(row["epe_mean_px"], 3), "ratio": round(row["epe_ratio"], 4)}
                for key, row in (("predicted", methods[name]), ("corrected", methods[name + CORRECTED]))
            }
            for name in named
        }
        for group, methods in report["groups"].items()
    }


def simulated(named: Named, held_out: Path) -> dict[str, Any]:
    """Held-out simulated sequences, by rig."""
    return flow_figures(named, *sorted(held_out.iterdir()), "--max-pairs", MAX_SIMULATED_PAIRS)


def lidar_flow(named: Named, real: Path, truth: Path) -> dict[str, Any]:
    """The drives with scans."""
    found = {}
    for drive in LIDAR_DRIVES:
        call(command("groundtruth", "kitti", real / PLACES[drive], "--out", truth / drive))
        (found[drive],) = flow_figures(named, real / PLACES[drive], "--ground-truth", truth / drive).values()
    return found


def regions(named: Named, real: Path) -> dict[str, Any]:
    """The drives with labels; of each checkpoint its detector at the default settings."""
    drives = [real / PLACES[drive] for drive in LABELLED_DRIVES]
    found: dict[str, Any] = {drive: {} for drive in LABELLED_DRIVES}
    for name, checkpoint in named.items():
        report = asked("evaluate", "detect", *drives, "--no-rivals", "--checkpoint", checkpoint)
        for drive in LABELLED_DRIVES:
            figures = report["sequences"][drive]["methods"][OURS]
            found[drive][name] = {key: figures[key] for key in REGION_FIGURES}
    return found


def rate_study(rates: Sequence[float], real: Path, runs: Path, held_out: Path, init: str, start: Path) -> Any:
    """Learning rates by what their trainings left out, and by what they forget."""
    found: dict[str, Any] = {}
    for adaptation in RATE_STUDY:
        named = {START: start}
        for rate in rates:
            folder = runs / "rates" / f"{adaptation.name}-{rate:g}"
            named[f"{rate:g}"] = trained(adaptation, real, folder, init, {"training.learning_rate": rate})
        kept = {name: photometric_kept(checkpoint, adaptation, real) for name, checkpoint in named.items()}
        found[adaptation.name] = {"kept": kept, "simulated": simulated(named, held_out)}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--real-data",
        type=Path,
        default=Path(os.environ.get("VIFLOW_REAL_DATA", ROOT / ".." / "shared" / "data")),
        help="holds euroc/ and kitti/ (default: VIFLOW_REAL_DATA)",
    )
    parser.add_argument("--held-out", type=Path, required=True, help="simulated sequences (make held-out)")
    parser.add_argument("--runs", type=Path, required=True, help="where trainings are kept; outside the source tree")
    parser.add_argument("--init", default="default", help="checkpoint to start from (default: the bundled one)")
    parser.add_argument("--rates", help="compare learning rates (1e-4,3e-4,...) and nothing else")
    parser.add_argument("--only", default=",".join(MEASURES), help="measures, with commas between (default: all)")
    parser.add_argument("--adaptations", default=",".join(one.name for one in ADAPTATIONS), help="(default: all)")
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    only = _some_of(MEASURES, arguments.only, parser, "--only")
    names = _some_of([one.name for one in ADAPTATIONS], arguments.adaptations, parser, "--adaptations")
    chosen = [one for one in ADAPTATIONS if one.name in names]
    cv2.setNumThreads(1)
    real, runs, held_out = arguments.real_data, arguments.runs, arguments.held_out
    start = bundled_checkpoint() if arguments.init == "default" else Path(arguments.init)
    report = json.loads(arguments.out.read_text(encoding="utf-8")) if arguments.out.exists() else {}

    def write(key: str, values: object) -> None:
        # After each part: an hour of measuring is not lost to the last one's failure.
        report[key] = {**circumstances(), "found": values}
        write_atomically(arguments.out, (json.dumps(report, indent=2) + "\n").encode())

    if arguments.rates is not None:
        rates = [float(text) for text in arguments.rates.split(",")]
        write("rates", rate_study(rates, real, runs, held_out, arguments.init, start))
        return
    named = {START: start}
    for adaptation in chosen:
        named[adaptation.name] = trained(adaptation, real, runs / adaptation.name, arguments.init, {})
    write("checkpoints", {name: about(path) for name, path in named.items()})
    if "photometric" in only:
        write("photometric", {name: photometric_all(path, real) for name, path in named.items()})
        kept = {}
        for adaptation in chosen:
            pair = {"before": start, "after": named[adaptation.name]}
            kept[adaptation.name] = {key: photometric_kept(path, adaptation, real) for key, path in pair.items()}
        write("kept", kept)
        write("time_offset_s", time_offsets(start, real))
    if "lidar_flow" in only:
        write("lidar_flow", lidar_flow(named, real, runs / "truth"))
    if "regions" in only:
        write("regions", regions(named, real))
    if "simulated" in only:
        write("simulated", simulated(named, held_out))


def about(checkpoint: Path) -> dict[str, Any]:
    """Which checkpoint it is, and what it learnt from; of one that began from fresh weights only the former."""
    record = read_checkpoint(checkpoint)[1]
    found: dict[str, Any] = {"name": record.name, "version": record.version, "sha256": record.sha256}
    if "init" in record.provenance:
        found |= {key: record.provenance[key] for key in ("init", "training", "data")}
    return found


def _some_of(known: Sequence[str], text: str, parser: argparse.ArgumentParser, option: str) -> list[str]:
    found = text.split(",")
    if unknown := sorted(set(found) - set(known)):
        parser.error(f"{option}: expected some of {','.join(known)}, found {','.join(unknown)}")
    return found


if __name__ == "__main__":
    main()
