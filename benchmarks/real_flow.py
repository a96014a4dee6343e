"""The reproduction's networks on real recordings that none of them was trained on.

KITTI drives with LiDAR: endpoint error against the sparse flow of scans moved by the OXTS (``groundtruth kitti``),
every row of the car beside the classical methods. EuRoC: no depth is known there, so the *photometric* error is
measured instead: mean absolute difference between the source image and its reconstruction, over that of the frames as
they are (no motion), for every row of the drone.

    python benchmarks/real_flow.py --data runs/reproduction --out benchmarks/results/reproduction
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from reproduction import BASELINES, call, command, rows

from viflow_anomaly.checkpoint_record import write_atomically
from viflow_anomaly.config import CorrectionConfig
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.errors import ViflowError
from viflow_anomaly.evaluation.flow_methods import network_methods
from viflow_anomaly.evaluation.flow_report import circumstances
from viflow_anomaly.evaluation.flow_truth import PairName
from viflow_anomaly.evaluation.photometric_error import photometric_error
from viflow_anomaly.runtime.loading import load_runtime

ROOT = Path(__file__).resolve().parents[1]
DRIVES = ("2011_09_26_drive_0005_sync", "2011_09_26_drive_0027_sync")
FLIGHT = "V1_01_easy"


def checkpoints(data: Path, rig: str, extra: Sequence[str]) -> dict[str, Path]:
    """The nine rows of a rig by name, and what the caller adds."""
    found = {row.name: row.folder(data) / "model.safetensors" for row in rows([rig]) if not row.seed}
    for text in extra:
        name, _, path = text.partition("=")
        found[name] = Path(path)
    return found


def kitti(real: Path, named: dict[str, Path], out: Path) -> dict[str, Any]:
    """Figures of every method by drive."""
    found = {}
    for drive in DRIVES:
        recording = next(real.glob(f"kitti/*/{drive}"), None)
        if recording is None:
            raise SystemExit(f"expected {drive} below {real}, found none")
        chosen = [part for name, path in named.items() for part in ("--checkpoint", f"{name}={path}")]
        with tempfile.TemporaryDirectory() as folder:
            call(command("groundtruth", "kitti", recording, "--out", folder))
            file = out / f"{drive}.json"
            options = ["--ground-truth", folder, "--methods", BASELINES, "--out", file]
            call(command("evaluate", "flow", recording, *chosen, *options))
        found[drive] = json.loads(file.read_text(encoding="utf-8"))["all"]
    return found


def flight(recording: Path, named: dict[str, Path]) -> dict[str, Any]:
    """Photometric error of each network over the frame difference, as predicted and corrected."""
    found: dict[str, Any] = {}
    for name, path in named.items():
        runtime, record = load_runtime(path, threads=1)
        for method in network_methods(name, runtime, record, CorrectionConfig()):
            pairs = RecordingPairs(open_recording(recording), motor_source=method.motor_source)
            residuals, identities, failed = [], [], 0
            for index in range(len(pairs)):
                try:
                    pair = pairs[index]
                    flow = method.flow(pair, PairName(FLIGHT, 1, *pairs.stamps(index)))
                except (ViflowError, RuntimeError):
                    failed += 1
                    continue
                error = photometric_error(pair, flow)
                residuals.append(error.residual_gray)
                identities.append(error.frame_difference_gray)
            found[method.about.name] = {
                "pairs": len(residuals),
                "failed": failed,
                "residual_gray": round(float(np.mean(residuals)), 3),
                "frame_difference_gray": round(float(np.mean(identities)), 3),
                "ratio": round(float(np.mean(residuals) / np.mean(identities)), 4),
            }
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="of benchmarks/reproduction.py")
    parser.add_argument("--real-data", type=Path, default=ROOT / ".." / "shared" / "data")
    parser.add_argument("--checkpoint", action="append", default=[], metavar="NAME=PATH")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    real, out = arguments.real_data, arguments.out
    out.mkdir(parents=True, exist_ok=True)
    car, drone = (checkpoints(arguments.data, rig, arguments.checkpoint) for rig in ("car", "drone"))
    report = {
        **circumstances(),
        "kitti_lidar": kitti(real, car, out),
        "euroc_photometric": flight(real / "euroc" / FLIGHT, drone),
    }
    write_atomically(out / "real.json", (json.dumps(report, indent=2) + "\n").encode())


if __name__ == "__main__":
    main()
