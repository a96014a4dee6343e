"""What adapting the bundled model to real rigs without labels is worth: docs/adapting.md's recipe, run and measured.

Each adaptation of ``ADAPTATIONS`` is trained (``train --init``), exported, and measured beside the checkpoint that it
starts from, on every recording, those that it has never seen told apart:

- photometric: mean absolute difference of the source image and its reconstruction over that of the frames as they are;
- lidar_flow: endpoint error over no motion's, of the drives with LiDAR (``groundtruth kitti``, ``evaluate flow``);
- regions: ``evaluate detect`` on the drives with labels;
- simulated: endpoint error over no motion's on held-out simulated sequences. What is forgotten shows here.

    python benchmarks/adapting.py --real-data DATA --held-out runs/model/held-out --runs runs/adapting

A fifth of each drive (blocks of one second) and a third of the flight are kept from the training: ``kept`` is the
photometric error there. Trainings stay in ``--runs`` and are gone on with; they hold what was learnt from recordings
with licences of their own, so keep them out of the source tree. Everything is measured again at each call, or less:
``--only regions``. ``--rates`` compares learning rates on what their trainings left out.
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
from viflow_anomaly.geometry import pixel_grid
from viflow_anomaly.residual import photometric_residual, reconstruct
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
"""Three seconds of flight: half-second blocks, of which two are kept for the test."""
DRIVE_BLOCKS = {"rule": "blocks", "block_s": 1.0, "test_share": 0.2}
MEASURES = ("photometric", "lidar_flow", "regions", "simulated")
REGION_FIGURES = ("frames", "movers", "roi_ap", "best_f1", "recall_at_0.1_false_alarms", "false_alarms_per_frame")
OFFSETS_S = (0.0, 0.03, 0.06, 0.09)


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
        shown = np.isfinite(flow).all(axis=-1)
        at_px = np.where(shown[..., None], flow, 0).astype(np.float32) + pixel_grid(*shown.shape)
        reconstruction, inside = reconstruct(pair.target.image, at_px)
        judged = inside & shown
        residuals.append(float(photometric_residual(pair.source.image, reconstruction, judged)[judged].mean()))
        identities.append(float(cv2.absdiff(pair.source.image, pair.target.image)[judged].mean()))
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


def flow_of(checkpoint: Path, *arguments: object) -> dict[str, Any]:
    """Endpoint error and its ratio to no motion's, by group, as ``evaluate flow`` finds them."""
    report = asked("evaluate", "flow", *arguments, "--checkpoint", f"it={checkpoint}", "--methods", "identity")
    found = {}
    for group, methods in report["groups"].items():
        rows = {"predicted": methods["it"], "corrected": methods[f"it{CORRECTED}"]}
        found[group] = {
            name: {"epe_px": round(row["epe_mean_px"], 3), "ratio": round(row["epe_ratio"], 4)}
            for name, row in rows.items()
        }
    return found


def simulated(checkpoint: Path, held_out: Path) -> dict[str, Any]:
    """Held-out simulated sequences, by rig."""
    return flow_of(checkpoint, *sorted(held_out.iterdir()), "--max-pairs", MAX_SIMULATED_PAIRS)


def measured(checkpoint: Path, real: Path, truth: Path, held_out: Path, only: Sequence[str]) -> dict[str, Any]:
    """Everything of one checkpoint."""
    found: dict[str, Any] = {"sha256": read_checkpoint(checkpoint)[1].sha256}
    if "photometric" in only:
        found["photometric"] = photometric_all(checkpoint, real)
    if "lidar_flow" in only:
        found["lidar_flow"] = {}
        for drive in LIDAR_DRIVES:
            (found["lidar_flow"][drive],) = flow_of(
                checkpoint, real / PLACES[drive], "--ground-truth", truth / drive
            ).values()
    if "regions" in only:
        found["regions"] = {}
        for drive in LABELLED_DRIVES:
            report = asked("evaluate", "detect", real / PLACES[drive], "--no-rivals", "--checkpoint", checkpoint)
            found["regions"][drive] = {key: report["all"][OURS][key] for key in REGION_FIGURES}
    if "simulated" in only:
        found["simulated"] = simulated(checkpoint, held_out)
    return found


def rate_study(rates: Sequence[float], real: Path, runs: Path, held_out: Path, init: str, start: Path) -> Any:
    """Learning rates by what their trainings left out, and by what they forget."""
    found: dict[str, Any] = {}
    for adaptation in RATE_STUDY:
        checkpoints = {"start": start}
        for rate in rates:
            folder = runs / "rates" / f"{adaptation.name}-{rate:g}"
            checkpoints[f"{rate:g}"] = trained(adaptation, real, folder, init, {"training.learning_rate": rate})
        found[adaptation.name] = {
            rate: {
                "photometric": photometric_kept(checkpoint, adaptation, real),
                "simulated": simulated(checkpoint, held_out),
            }
            for rate, checkpoint in checkpoints.items()
        }
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--real-data", type=Path, default=ROOT / ".." / "shared" / "data", help="euroc/ and kitti/")
    parser.add_argument("--held-out", type=Path, required=True, help="simulated sequences (make held-out)")
    parser.add_argument("--runs", type=Path, required=True, help="where trainings are kept; outside the source tree")
    parser.add_argument("--init", default="default", help="checkpoint to start from (default: the bundled one)")
    parser.add_argument("--rates", help="learning rates to compare, 1e-4,3e-4,...")
    parser.add_argument("--only", default=",".join(MEASURES), help="measures, with commas between (default: all)")
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    only = arguments.only.split(",")
    if unknown := sorted(set(only) - set(MEASURES)):
        parser.error(f"--only: expected some of {','.join(MEASURES)}, found {','.join(unknown)}")
    cv2.setNumThreads(1)
    real, runs = arguments.real_data, arguments.runs
    start = bundled_checkpoint() if arguments.init == "default" else Path(arguments.init)
    report = _report_to_add_to(arguments.out, read_checkpoint(start)[1].sha256)

    def write(key: str, values: dict[str, Any]) -> None:
        # After each part: an hour of measuring is not lost to the last one's failure.
        report[key] = {**report.get(key, {}), **values}
        write_atomically(arguments.out, (json.dumps(report, indent=2) + "\n").encode())

    if arguments.rates is not None:
        rates = [float(text) for text in arguments.rates.split(",")]
        write("rates", rate_study(rates, real, runs, arguments.held_out, arguments.init, start))
        write("measured", {"rates": circumstances()})
    for drive in LIDAR_DRIVES if "lidar_flow" in only else ():
        call(command("groundtruth", "kitti", real / PLACES[drive], "--out", runs / "truth" / drive))
    if "photometric" in only:
        write("time_offset_s", time_offsets(start, real))
    write("start", measured(start, real, runs / "truth", arguments.held_out, only))
    for adaptation in ADAPTATIONS:
        checkpoint = trained(adaptation, real, runs / adaptation.name, arguments.init, {})
        figures = measured(checkpoint, real, runs / "truth", arguments.held_out, only)
        if "photometric" in only:
            kept = {"before": start, "after": checkpoint}
            figures["kept"] = {name: photometric_kept(one, adaptation, real) for name, one in kept.items()}
        provenance = read_checkpoint(checkpoint)[1].provenance
        about = {
            "recordings": adaptation.recordings,
            "pairs": provenance["data"]["pairs"],
            **{key: provenance[key] for key in ("init", "training")},
        }
        earlier = report.get("adapted", {}).get(adaptation.name, {})
        write("adapted", {adaptation.name: {**earlier, **about, **figures}})
    write("measured", {measure: circumstances() for measure in only})


def _report_to_add_to(path: Path, start_sha256: str) -> dict[str, Any]:
    """The last report, whose other measures stay (``--only``); a new one where that began at another checkpoint."""
    report: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return report if report.get("start", {}).get("sha256") == start_sha256 else {"start": {"sha256": start_sha256}}


if __name__ == "__main__":
    main()
