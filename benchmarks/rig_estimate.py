"""How well gyro bias, time offset and mounting are estimated over a stream, and whether applying them pays.

Each recording is judged as it is and with errors put into it (5 and 20 ms of clock offset either way, a degree of
mounting), once with the estimate only reported and once with it applied. A row says over a group of recordings (of
simulated ones the name up to its first underscore) how far the estimates are from the truth and in their own sigmas,
where the truth is known (else the estimates themselves), the photometric residual, and the flow's endpoint error where
it can be measured.

    python benchmarks/rig_estimate.py SEQUENCE... --out benchmarks/results/rig-estimate.json
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from viflow_anomaly.checkpoint_record import write_atomically
from viflow_anomaly.config import RigEstimateConfig
from viflow_anomaly.datasets.ground_truth_folder import GroundTruthFolder
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import ViflowError
from viflow_anomaly.evaluation.flow_report import circumstances
from viflow_anomaly.rig_estimate import UNKNOWNS, RigEstimate, corrected_pair, observe, update
from viflow_anomaly.sensor_data import Float64Array

DEGREE = math.radians(1.0)
CASES: dict[str, tuple[float, ...]] = {
    "as it is": (0.0,) * UNKNOWNS,
    "+5 ms": (0.0, 0.0, 0.0, 0.005, 0.0, 0.0, 0.0),
    "-5 ms": (0.0, 0.0, 0.0, -0.005, 0.0, 0.0, 0.0),
    "+20 ms": (0.0, 0.0, 0.0, 0.02, 0.0, 0.0, 0.0),
    "-20 ms": (0.0, 0.0, 0.0, -0.02, 0.0, 0.0, 0.0),
    "1 deg": (0.0, 0.0, 0.0, 0.0, *np.full(3, DEGREE / math.sqrt(3)).tolist()),
}
BIAS_COLUMNS = slice(11, 14)


class Outcome(NamedTuple):
    """One recording, judged once.

    Attributes:
        estimate: after its last pair.
        truth: [7], None where the bias is not known.
        applied_pairs: that something was applied to.
        residual_gray: mean over pairs.
        endpoint_error_px: mean over pairs, None without ground truth.
    """

    estimate: RigEstimate
    truth: Float64Array | None
    applied_pairs: int
    residual_gray: float
    endpoint_error_px: float | None


def true_bias(path: Path) -> Float64Array | None:
    """[3] rad/s, mean over a sequence of the simulator; others keep theirs to themselves."""
    if not (path / "simulation.json").is_file():
        return None
    table = np.loadtxt(path / "mav0/state_groundtruth_estimate0/data.csv", delimiter=",", skiprows=1)
    return np.asarray(table[:, BIAS_COLUMNS].mean(axis=0))


def judge(detector: AnomalyDetector, path: Path, put_in: Float64Array, config: RigEstimateConfig) -> Outcome:
    """Every pair of a recording that has ``put_in`` wrong, in order."""
    recording = open_recording(path)
    pairs = RecordingPairs(recording, motor_source=detector.motor_source)
    truth = GroundTruthFolder.find(recording.root)
    estimate, applied_pairs = RigEstimate.prior(config), 0
    residuals, errors = [], []
    for index in range(len(pairs)):
        applied = estimate.applicable(config)
        try:
            pair = corrected_pair(corrected_pair(pairs[index], -put_in), applied)
            analysis = detector.analyze(pair)
        except ViflowError:
            continue
        applied_pairs += bool(applied.any())
        observation = observe(pair, analysis.predicted.correction, config, applied)
        estimate = estimate if observation is None else update(estimate, observation, config)
        residuals.append(float(analysis.residual[analysis.inside].mean()))
        if truth is not None:
            flow_px, valid = truth.static_flow(*pairs.stamps(index))
            valid = valid & analysis.inside
            errors.append(float(np.linalg.norm(analysis.flow_px - flow_px, axis=-1)[valid].mean()))
    bias = true_bias(path)
    return Outcome(
        estimate=estimate,
        truth=None if bias is None else put_in + np.concatenate([bias, np.zeros(UNKNOWNS - 3)]),
        applied_pairs=applied_pairs,
        residual_gray=float(np.mean(residuals)),
        endpoint_error_px=float(np.mean(errors)) if errors else None,
    )


def figures(outcomes: Sequence[Outcome], config: RigEstimateConfig) -> dict[str, Any]:
    """Of one group in one case."""
    known = [(one.estimate, one.truth) for one in outcomes if one.truth is not None]
    row: dict[str, Any] = {"recordings": len(outcomes)}
    if known:
        errors = np.array([estimate.mean[:UNKNOWNS] - truth for estimate, truth in known])
        scaled = errors / np.array([estimate.sigmas for estimate, _ in known])
        row |= {
            "bias_rms_error_rad_s": _root_mean_square(errors[:, :3]),
            "bias_left_if_ignored_rad_s": _root_mean_square(np.array([truth[:3] for _, truth in known])),
            "offset_median_error_ms": round(1e3 * float(np.median(np.abs(errors[:, 3]))), 2),
            "offset_rms_error_ms": round(1e3 * _root_mean_square(errors[:, 3]), 2),
            "mounting_rms_error_deg": round(math.degrees(_root_mean_square(errors[:, 4:])), 3),
            "errors_in_sigmas": {
                name: round(_root_mean_square(scaled[:, part]), 2)
                for name, part in (("bias", slice(0, 3)), ("offset", 3), ("mounting", slice(4, 7)))
            },
        }
    else:
        row["estimates"] = [one.estimate.report(config) for one in outcomes]
    row["applied_pairs"] = sum(one.applied_pairs for one in outcomes)
    row["pairs"] = sum(one.estimate.pairs for one in outcomes)
    row["rejected"] = sum(one.estimate.rejected for one in outcomes)
    row["residual_gray"] = round(float(np.mean([one.residual_gray for one in outcomes])), 3)
    measured = [one.endpoint_error_px for one in outcomes if one.endpoint_error_px is not None]
    if measured:
        row["endpoint_error_px"] = round(float(np.mean(measured)), 4)
    return row


def _root_mean_square(values: Float64Array) -> float:
    return round(float(np.sqrt((values**2).mean())), 6)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="+", type=Path)
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--cases", nargs="+", choices=tuple(CASES), default=tuple(CASES))
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    detector = AnomalyDetector.from_checkpoint(arguments.checkpoint, threads=1)
    groups: dict[str, list[Path]] = {}
    for path in arguments.sequences:
        simulated = (path / "simulation.json").is_file()
        name = path.name.split("_", 1)[0] if simulated else "/".join(path.resolve().parts[-3:])
        groups.setdefault(name, []).append(path)
    found: dict[str, Any] = {}
    for case in arguments.cases:
        for mode, config in (("reported", RigEstimateConfig()), ("applied", RigEstimateConfig(apply=True))):
            for name, paths in groups.items():
                outcomes = [judge(detector, path, np.array(CASES[case]), config) for path in paths]
                row = figures(outcomes, config)
                found.setdefault(name, {}).setdefault(case, {})[mode] = row
                print(name, case, mode, json.dumps(row), flush=True)
    result = {
        "model": {"name": detector.model_info.name, "sha256": detector.model_info.sha256},
        **circumstances(),
        "configuration": RigEstimateConfig().model_dump(mode="json"),
        "groups": found,
    }
    if arguments.out is not None:
        write_atomically(arguments.out, (json.dumps(result, indent=2) + "\n").encode())


if __name__ == "__main__":
    main()
