"""What the bundled model does on recordings without ground truth: does its prediction explain more than standing still?

For each recording: how many pairs were judged, the mean photometric residual inside the analysed part, the mean frame
difference over the same pixels (the identity's residual), and the ROIs by label for a pair.

    python benchmarks/real_recordings.py RECORDING... --out benchmarks/results/real-recordings.json
"""

from __future__ import annotations

import argparse
import json
import os
import platform
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read once, when torch loads

import numpy as np
import torch

from viflow_anomaly.checkpoint_record import source_commit, write_atomically
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import ViflowError


def measure(detector: AnomalyDetector, path: Path) -> dict[str, Any]:
    """One recording's row; a pair that fails is counted by the code of its error."""
    pairs = RecordingPairs(open_recording(path), motor_source=detector.motor_source)
    residuals, identities = [], []
    counts = {"ok": 0, "abstained": 0, "independent_motion": 0, "model_error": 0}
    failed: dict[str, int] = {}
    for index in range(len(pairs)):
        try:
            pair = pairs[index]
            analysis = detector.analyze(pair)
        except ViflowError as err:
            failed[err.code] = failed.get(err.code, 0) + 1
            continue
        counts[analysis.detection.status] += 1
        for roi in analysis.detection.rois:
            counts[roi.label] += 1
        difference = np.abs(pair.source.image.astype(np.float32) - pair.target.image)
        judged = analysis.residual > 0  # outside the analysed part the residual is 0
        residuals.append(float(analysis.residual[judged].mean()))
        identities.append(float(difference[judged].mean()))
    judged_pairs = max(1, len(residuals))
    return {
        "recording": "/".join(path.resolve().parts[-2:]),
        "pairs": len(pairs),
        **{name: counts[name] for name in ("ok", "abstained")},
        "failed": failed,
        "residual_gray": round(float(np.mean(residuals)), 2),
        "frame_difference_gray": round(float(np.mean(identities)), 2),
        "motion_rois_per_pair": round(counts["independent_motion"] / judged_pairs, 2),
        "model_error_rois_per_pair": round(counts["model_error"] / judged_pairs, 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    detector = AnomalyDetector.from_checkpoint(arguments.checkpoint)
    rows = [measure(detector, path) for path in arguments.recordings]
    columns = list(rows[0])
    print("| " + " | ".join(columns) + " |\n|" + "---|" * len(columns))
    for row in rows:
        print("| " + " | ".join(str(row[column]) for column in columns) + " |")
    if arguments.out is not None:
        result = {
            "model": {"name": detector.model_info.name, "sha256": detector.model_info.sha256},
            "commit": source_commit(),
            "machine": {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()},
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "recordings": rows,
        }
        write_atomically(arguments.out, (json.dumps(result, indent=2) + "\n").encode())


if __name__ == "__main__":
    main()
