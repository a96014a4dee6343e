"""Does ground truth agree with the pictures? Medians over pairs of its distance to measured flow, and of the gray
difference that is left when the next frame is warped by it.

    python benchmarks/check_ground_truth.py RECORDING TRUTH [--pairs 50]

TRUTH is the folder that holds ``groundtruth0``. The measured flow (dense inverse search) has errors of its own, of a
few tenths of a pixel and more where it loses large motion: the distance is an upper bound.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np

from viflow_anomaly.datasets.ground_truth_folder import GroundTruthFolder
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.ground_truth.picture_check import check_pair


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--pairs", type=int, default=50, help="evenly spread (default 50)")
    arguments = parser.parse_args()
    recording, truth = open_recording(arguments.recording), GroundTruthFolder(arguments.truth)
    known = np.isin(recording.frame_timestamps_ns[:-1], truth.source_stamps)
    stored = [
        index
        for index in np.flatnonzero(known).tolist()
        if (truth.folder / "static_flow" / f"{recording.frame_timestamps_ns[index]}.png").is_file()
    ]
    if not stored:
        sys.exit(f"{truth.folder}: expected stored flow of frames of {arguments.recording}, found none")
    chosen = np.unique(np.linspace(0, len(stored) - 1, min(arguments.pairs, len(stored))).round().astype(int))
    checks = [check for k in chosen if (check := check_pair(recording, truth, stored[k])) is not None]
    if not checks:
        sys.exit(f"{truth.folder}: expected flow at pixels with texture, found none in {len(chosen)} pairs")
    medians = {
        name: round(float(np.median([asdict(check)[name] for check in checks])), 3)
        for name in ("flow_px", "distance_px", "identity_gray", "warped_gray")
    }
    print(json.dumps({"recording": recording.name, "pairs": len(checks), **medians}, indent=2))


if __name__ == "__main__":
    main()
