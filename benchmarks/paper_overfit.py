"""Does the paper's network learn? It must fit eight pairs: their photometric error has to fall below a tenth.

Preset ``paper`` (244 million parameters, 224x224 crops, 50x6 window), the paper's loss (squared error, winner takes
all), one batch of a recording's first eight pairs, no augmentation. A step takes seconds on a CPU: this is no test.
The recording is simulated, without movers: even the true flow leaves 0.043 of the error there (noise, occlusion, what
leaves the crop); on the bundled sample, with its mover, it leaves 0.078, and the goal would be out of reach.

    viflow-anomaly simulate --rig drone --seed 71003 --frames 10 --out runs/overfit --set 'simulator.movers=[0,0]'
    python benchmarks/paper_overfit.py runs/overfit/drone_071003 --out benchmarks/results/paper-overfit.json
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read once, when torch loads

import torch

from viflow_anomaly.batch import Batch, collate
from viflow_anomaly.checkpoint_record import write_atomically
from viflow_anomaly.config import ModelConfig, MotionWindowConfig, ViewConfig
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.evaluation.flow_report import circumstances
from viflow_anomaly.losses import LossResult, squared_error_loss
from viflow_anomaly.model.builder import build_model
from viflow_anomaly.model_input import prepare

PAIRS = 8
GOAL = 0.1
REPORT_EVERY = 10


def paper_config(hypotheses: int) -> ModelConfig:
    """Preset ``paper`` as on EuRoC."""
    return ModelConfig.model_validate(
        {
            "preset": "paper",
            "hypotheses": hypotheses,
            "view": ViewConfig(mode="center_crop"),
            "motion_window": MotionWindowConfig(layout="paper_euroc", axes="sensor"),
        }
    )


def sample_batch(folder: Path, config: ModelConfig) -> Batch:
    """The first eight adjacent pairs of a recording."""
    pairs = RecordingPairs(open_recording(folder))
    if len(pairs) < PAIRS:
        raise SystemExit(f"{folder}: expected at least {PAIRS + 1} frames, found {len(pairs) + 1}")
    return collate([prepare(pairs[k], config) for k in range(PAIRS)])


def overfit(batch: Batch, config: ModelConfig, *, steps: int, learning_rate: float, goal: float) -> list[float]:
    """Mean squared error a pixel (intensities 0..1) before each step, until ``goal`` of the first is reached."""
    network = build_model(config, seed=0)
    optimizer = torch.optim.Adam(network.parameters(), lr=learning_rate, fused=True)
    pixels = batch.source[0].numel()
    errors: list[float] = []
    started = time.process_time()
    for step in range(steps + 1):
        result: LossResult = squared_error_loss(
            network(batch.source, batch.motion, batch.interval_s), batch.source, batch.target
        )
        errors.append(float(result.loss.detach()) / pixels)
        if step % REPORT_EVERY == 0:
            spent_s = time.process_time() - started
            print(f"step {step}: {errors[-1] / errors[0]:.3f} of the first error, {spent_s:.0f} s of CPU")
        if errors[-1] <= goal * errors[0] or step == steps:
            break
        optimizer.zero_grad(set_to_none=True)
        (result.loss / pixels).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    return errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--hypotheses", type=int, choices=(1, 4, 8), default=1)
    parser.add_argument("--steps", type=int, default=600, help="at most")
    parser.add_argument("--learning-rate", type=float, default=3e-4)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    config = paper_config(arguments.hypotheses)
    batch = sample_batch(arguments.recording, config)
    started = time.process_time()
    errors = overfit(batch, config, steps=arguments.steps, learning_rate=arguments.learning_rate, goal=GOAL)
    report: dict[str, Any] = {
        **circumstances(),
        "model": config.model_dump(mode="json"),
        "recording": arguments.recording.name,
        "pairs": PAIRS,
        "learning_rate": arguments.learning_rate,
        "steps": len(errors) - 1,
        "cpu_seconds": round(time.process_time() - started),
        "first_error": errors[0],
        "last_error": errors[-1],
        "ratio": round(errors[-1] / errors[0], 4),
        "goal": GOAL,
        "errors": [round(error, 6) for error in errors],
    }
    print(f"{report['ratio']:.3f} of the first error after {report['steps']} steps (goal {GOAL})")
    if arguments.out is not None:
        write_atomically(arguments.out, (json.dumps(report, indent=2) + "\n").encode())
    raise SystemExit(0 if report["ratio"] <= GOAL else 1)


if __name__ == "__main__":
    main()
