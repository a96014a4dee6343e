"""Recordings with movers, small enough to learn from within a test."""

from __future__ import annotations

from pathlib import Path

from simulated_truth import add_ground_truth, add_movers
from worlds import make_world

from viflow_anomaly.config import EvidenceHeadConfig, EvidenceTrainingConfig

SMALL = EvidenceTrainingConfig(
    head=EvidenceHeadConfig(widths=(8, 8, 8, 8)),
    steps=6,
    batch_size=2,
    crop_width=64,
    crop_height=32,
    warmup_steps=1,
    checkpoint_every=2,
)


def recording(folder: Path, *, frames: int = 3) -> Path:
    """EuRoC layout with ground truth and two movers."""
    return add_movers(add_ground_truth(folder, make_world(frames=frames)))
