"""The paper's table on simulated rigs: nine networks and two more seeds of three of them, trained, measured, drawn.

Rows: motion inputs ``imu``, ``sffms``, ``imu+sffms`` x K = 1, 4, 8 hypotheses, preset ``compact``; K = 8 with three
seeds. Every finished training is kept, so the command goes on where it was stopped.

    python benchmarks/reproduction.py --data runs/reproduction --out benchmarks/results/reproduction

``--data`` holds what ``make reproduction`` simulates: ``train/RIG_*``, ``held-out/RIG_*`` with ground truth,
``split/RIG_*`` long recordings with ground truth; the trainings go to its ``runs``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from viflow_anomaly.checkpoint_record import read_checkpoint, write_atomically
from viflow_anomaly.config import ModelConfig
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.evaluation.flow_report import circumstances
from viflow_anomaly.evaluation.plots import clustering_error_histogram
from viflow_anomaly.motor_input import clustering_error_m

LOOK_AHEADS = {"drone": (1, 2, 3, 4), "car": (1,)}
"""As the paper's: EuRoC's Vicon rooms up to four frames apart, KITTI adjacent frames."""
INPUTS = ("imu", "sffms", "imu+sffms")
HYPOTHESES = (1, 4, 8)
SPREAD_SEEDS = (0, 1, 2)
BASELINES = "identity,dis-ultrafast,dis-fast,dis-medium,farneback"
SPLIT_RULES = ("blocks", "random")
SPLIT_RIG = "drone"


class Row(NamedTuple):
    """One training."""

    rig: str
    inputs: str
    hypotheses: int
    seed: int

    @property
    def name(self) -> str:
        return f"{self.inputs}-k{self.hypotheses}" + (f"-seed{self.seed}" if self.seed else "")

    def folder(self, data: Path) -> Path:
        return data / "runs" / self.rig / f"{self.inputs}-k{self.hypotheses}-seed{self.seed}"


def rows(rigs: Sequence[str]) -> Iterator[Row]:
    """All trainings, the nine rows first."""
    for seed in SPREAD_SEEDS:
        for inputs in INPUTS:
            for hypotheses in HYPOTHESES if seed == 0 else (8,):
                for rig in rigs:
                    yield Row(rig, inputs, hypotheses, seed)


def command(*arguments: object) -> list[str]:
    return [str(Path(sys.executable).with_name("viflow-anomaly")), *map(str, arguments)]


def call(arguments: list[str], log: Path | None = None) -> None:
    """Run a command of the project; its output goes to ``log``."""
    environment = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE"}
    if log is None:
        subprocess.run(arguments, check=True, env=environment, stdout=subprocess.DEVNULL)
        return
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as file:
        done = subprocess.run(arguments, check=False, env=environment, stdout=file, stderr=file)
    if done.returncode:
        raise SystemExit(f"failed ({done.returncode}), see {log}: {' '.join(arguments[:6])} ...")


def trained(data: Path, recordings: Path, folder: Path, *, steps: int, settings: dict[str, object]) -> Path:
    """The checkpoint of one training, exported; trained now where it is not there."""
    checkpoint = folder / "model.safetensors"
    if checkpoint.exists():
        _require_same(checkpoint, {"training.steps": steps, **settings})
    else:
        assignments = [part for key, value in settings.items() for part in ("--set", f"{key}={value}")]
        sequences = sorted(recordings.parent.glob(recordings.name))
        if not sequences:
            raise SystemExit(f"expected recordings {recordings}, found none: make reproduction simulates them")
        options = ["--out", folder, "--resume", "--steps", steps, "--threads", 1]
        call(command("train", *sequences, *options, *assignments), folder.with_suffix(".log"))
    if not checkpoint.with_suffix(".onnx").exists():
        call(command("export", "--checkpoint", checkpoint), folder.with_suffix(".log"))
    return checkpoint


def _require_same(checkpoint: Path, wanted: dict[str, object]) -> None:
    """An older training under the same name is not taken for the one that was asked for."""
    record = read_checkpoint(checkpoint)[1]
    found = {"model": record.model.model_dump(mode="json"), "training": record.provenance["training"]}
    for key, value in wanted.items():
        there: Any = found
        for step in key.split("."):
            there = there.get(step) if isinstance(there, dict) else None
        if there != value:
            raise SystemExit(f"{checkpoint}: expected a training with {key} {value}, found {there}; move it away")


def train_rows(data: Path, rigs: Sequence[str], *, steps: int, jobs: int) -> None:
    """Train what is missing, ``jobs`` at a time on one thread each."""

    def one(row: Row) -> None:
        settings: dict[str, object] = {
            "model.preset": "compact",
            "model.motion_inputs": row.inputs,
            "model.hypotheses": row.hypotheses,
            "training.look_aheads": list(LOOK_AHEADS[row.rig]),
            "training.seed": row.seed,
        }
        trained(data, data / "train" / f"{row.rig}_*", row.folder(data), steps=steps, settings=settings)
        print(f"{row.rig} {row.name}: trained", flush=True)

    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(one, rows(rigs)))


def measure_rig(data: Path, rig: str, out: Path, *, extra: Sequence[str]) -> dict[str, Any]:
    """All rows of a rig beside the baselines, on its held-out sequences."""
    checkpoints = [f"{row.name}={row.folder(data) / 'model.safetensors'}" for row in rows([rig])]
    options = ["--look-aheads", ",".join(map(str, LOOK_AHEADS[rig])), "--methods", BASELINES, "--threads", 1]
    files = ["--out", out / f"{rig}.json", "--markdown", out / f"{rig}.md", "--latex", out / f"{rig}.tex"]
    chosen = [part for one in (*checkpoints, *extra) for part in ("--checkpoint", one)]
    held_out = sorted((data / "held-out").glob(f"{rig}_*"))
    call(command("evaluate", "flow", *held_out, *chosen, *options, *files, "--plots", out / "figures" / rig))
    report: dict[str, Any] = json.loads((out / f"{rig}.json").read_text(encoding="utf-8"))
    return report


def spread_of_seeds(report: dict[str, Any]) -> dict[str, Any]:
    """Mean and range of the K = 8 rows over their seeds, as predicted and corrected."""
    found = {}
    for inputs in INPUTS:
        for suffix in ("", "+correction"):
            names = [Row("", inputs, 8, seed).name + suffix for seed in SPREAD_SEEDS]
            errors = [report["all"][name]["epe_mean_px"] for name in names]
            found[f"{inputs}-k8{suffix}"] = {
                "epe_mean_px": [round(error, 4) for error in errors],
                "mean": round(float(np.mean(errors)), 4),
                "sd": round(float(np.std(errors, ddof=1)), 4),
            }
    return found


def clustering_errors(data: Path, rigs: Sequence[str], out: Path) -> dict[str, Any]:
    """The paper's Fig. 3: what one of 20 clusters leaves of the displacements on the held-out sequences."""
    errors = {}
    for rig in rigs:
        _, record = read_checkpoint(Row(rig, "sffms", 8, 0).folder(data) / "model.safetensors")
        displacements = _displacements(sorted((data / "held-out").glob(f"{rig}_*")), LOOK_AHEADS[rig], record.model)
        errors[rig] = clustering_error_m(displacements, record.model.motor)
    clustering_error_histogram(errors, out / "figures" / "sffms-clustering-error")
    return {rig: {"sigma_m": round(float(error.std()), 4), "pairs": len(error)} for rig, error in errors.items()}


def _displacements(recordings: Sequence[Path], look_aheads: tuple[int, ...], model: ModelConfig) -> Any:
    commands = []
    for path in recordings:
        pairs = RecordingPairs(open_recording(path), look_aheads, motor_source=model.motor_source)
        commands += [pairs.motor_command(index) for index in range(len(pairs))]
    return np.array(commands)


def measure_splits(data: Path, out: Path, *, steps: int, jobs: int) -> dict[str, Any]:
    """How much the paper's random split of pairs flatters: each rule's own test beside sequences nobody saw."""
    long = sorted((data / "split").glob(f"{SPLIT_RIG}_*"))
    look_aheads = ",".join(map(str, LOOK_AHEADS[SPLIT_RIG]))

    def one(rule: str) -> tuple[str, dict[str, float]]:
        settings: dict[str, object] = {
            "model.preset": "compact",
            "model.hypotheses": 8,
            "training.look_aheads": list(LOOK_AHEADS[SPLIT_RIG]),
            "training.split.rule": rule,
        }
        folder = data / "runs" / "split" / rule
        checkpoint = trained(data, data / "split" / f"{SPLIT_RIG}_*", folder, steps=steps, settings=settings)
        shared = ["--checkpoint", f"split={checkpoint}", "--methods", "none", "--look-aheads", look_aheads]
        split = ["--test-part", "--set", f"training.split.rule={rule}", "--set", "detector.correction.enabled=false"]
        held_out = sorted((data / "held-out").glob(f"{SPLIT_RIG}_*"))
        found = {}
        for name, recordings, options in (("own_test", long, split), ("unseen", held_out, split[3:])):
            file = out / f"split-{rule}-{name}.json"
            call(command("evaluate", "flow", *recordings, *shared, *options, "--out", file))
            found[name] = json.loads(file.read_text(encoding="utf-8"))["all"]["split"]["epe_ratio"]
        return rule, found

    with ThreadPoolExecutor(jobs) as pool:
        return dict(pool.map(one, SPLIT_RULES))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--rigs", nargs="+", choices=tuple(LOOK_AHEADS), default=list(LOOK_AHEADS))
    parser.add_argument("--steps", type=int, default=5000, help="of each training (default 5000)")
    parser.add_argument("--split-steps", type=int, default=2500, help="of the two trainings of the splits")
    parser.add_argument("--jobs", type=int, default=2, help="trainings at a time, one thread each")
    parser.add_argument(
        "--checkpoint", action="append", default=[], metavar="NAME=PATH", help="measure these beside the nine rows"
    )
    arguments = parser.parse_args()
    data, out = arguments.data, arguments.out
    out.mkdir(parents=True, exist_ok=True)
    train_rows(data, arguments.rigs, steps=arguments.steps, jobs=arguments.jobs)
    reports = {rig: measure_rig(data, rig, out, extra=arguments.checkpoint) for rig in arguments.rigs}
    summary = {
        **circumstances(),
        "steps": arguments.steps,
        "split_steps": arguments.split_steps,
        "seeds": {rig: spread_of_seeds(report) for rig, report in reports.items()},
        "clustering": clustering_errors(data, arguments.rigs, out),
        "splits": measure_splits(data, out, steps=arguments.split_steps, jobs=arguments.jobs),
    }
    write_atomically(out / "summary.json", (json.dumps(summary, indent=2) + "\n").encode())
    print(json.dumps(summary, indent=2))


if __name__ == "__main__":
    main()
