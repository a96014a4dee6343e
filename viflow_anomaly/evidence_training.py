"""Supervised training of the evidence head: simulated masks of what moves are the teacher, geometric cues the pupil's
only view. The network whose flow is judged stays as it is.

As in ``training``, a step's data are a pure function of (seed, step), and the state on disk is exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F  # noqa: N812  # torch's own convention
from torch import nn

from viflow_anomaly.checkpoint import save_training_state
from viflow_anomaly.config import EVIDENCE_BLOCK_PX, EvidenceTrainingConfig
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.evidence_data import EvidenceBatch, EvidenceData
from viflow_anomaly.evidence_truth import IGNORED, MOVING, SEAM, SIZE_SHIFT
from viflow_anomaly.model.evidence_builder import build_evidence_head
from viflow_anomaly.model.evidence_head import OFFSET_SCALE_BLOCKS, EvidenceHead
from viflow_anomaly.training_state import learning_rate, resume_state, state_tensors

Fingerprint = dict[str, object]
BALANCED_AREA_PX = 1024.0
"""Pixels of movers of this size and above weigh ``motion_weight``, of smaller ones more..."""
MAX_BALANCE = 4.0
"""...up to so many times as much."""


class EvidenceTraining:
    """Head, optimiser and step counter of one run on a torch device."""

    def __init__(self, config: EvidenceTrainingConfig, *, device: str = "cpu") -> None:
        self.config = config
        self.device = device
        network = build_evidence_head(config.head, seed=config.seed).to(device)
        self.network: EvidenceHead = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.optimizer = torch.optim.AdamW(
            network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
        self.step = 0

    def run(self, data: EvidenceData, on_step: Callable[[int, float], None]) -> None:
        """All steps that are left; ``on_step`` is called with the number of steps taken and the last one's loss.

        Raises:
            ConfigError: ``training_diverged``.
        """
        self.network.train()
        while self.step < self.config.steps:
            loss = self.train_step(data.sample(self.step))
            on_step(self.step, loss)
        self.network.eval()

    def train_step(self, batch: EvidenceBatch) -> float:
        """One optimiser step; its loss."""
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(self.config, self.step)
        cues = (torch.from_numpy(one).to(self.device) for one in (batch.photometric, batch.geometric))
        logits, offsets = self.network(*(one.contiguous(memory_format=torch.channels_last) for one in cues))
        truth = torch.from_numpy(batch.truth).to(self.device)
        weights = {name: getattr(self.config, name) for name in ("motion_weight", "size_balance", "seam_weight")}
        loss = evidence_loss(logits, truth, **weights)
        true_offsets = torch.from_numpy(batch.offsets).to(self.device)
        loss = loss + self.config.offset_weight * offset_loss(offsets, true_offsets, truth)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise ConfigError(
                f"step {self.step}: expected a finite loss, found {value}: the training has diverged; a smaller "
                "learning_rate helps",
                code="training_diverged",
                field="evidence_training.learning_rate",
            )
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), self.config.gradient_clip)
        self.optimizer.step()
        self.step += 1
        return value

    def save(self, folder: Path, fingerprint: Fingerprint) -> None:
        """Write the whole state atomically."""
        tensors = state_tensors(self.network, self.optimizer)
        save_training_state(folder, tensors, {"step": self.step, **fingerprint})

    def restore(self, folder: Path, fingerprint: Fingerprint) -> bool:
        """Take up the state in ``folder``; False where there is none. Errors as ``resume_state``."""
        step = resume_state(self.network, self.optimizer, folder, fingerprint)
        if step is None:
            return False
        self.step = step
        return True


def evidence_loss(
    logits: torch.Tensor, truth: torch.Tensor, *, motion_weight: float, seam_weight: float, size_balance: float
) -> torch.Tensor:
    """Binary cross-entropy of motion, half its Dice loss, and cross-entropy of seams among moving pixels.

    In the cross-entropy the pixels of movers under ``BALANCED_AREA_PX`` weigh more: a region counts
    once, whatever its size.

    Args:
        logits: [B, 2, H, W] of motion and of seam.
        truth: [B, H, W] uint8 bits (``evidence_truth``); what is ignored does not count.
        motion_weight: of a moving pixel's cross-entropy.
        seam_weight: of the last term.
        size_balance: power of what a small mover's area is short of that its pixels weigh more by; 0: all weigh alike.
    """
    judged = ((truth & IGNORED) == 0).float()
    moving, seam = ((truth & MOVING) != 0).float(), ((truth & SEAM) != 0).float()
    weight = logits.new_tensor(motion_weight)
    motion = F.binary_cross_entropy_with_logits(logits[:, 0], moving, reduction="none", pos_weight=weight)
    motion = motion * torch.where(moving > 0, _balance(truth, size_balance), 1.0)
    cross_entropy = (motion * judged).sum() / judged.sum().clamp(min=1)
    probability = torch.sigmoid(logits[:, 0]) * judged
    shared, total = (probability * moving).sum(), probability.sum() + (judged * moving).sum()
    dice = 1 - (2 * shared + 1) / (total + 1)
    seams = F.binary_cross_entropy_with_logits(logits[:, 1], seam, reduction="none", pos_weight=weight)
    return cross_entropy + 0.5 * dice + seam_weight * (seams * moving).sum() / moving.sum().clamp(min=1)


def _balance(truth: torch.Tensor, power: float) -> torch.Tensor:
    """What the pixels of a mover weigh more for its smallness."""
    area_px = torch.exp2((truth >> SIZE_SHIFT).float())
    return (BALANCED_AREA_PX / area_px).clamp(min=1).pow(power).clamp(max=MAX_BALANCE)


def offset_loss(offsets: torch.Tensor, true_offsets: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Huber loss (knee at a block) of where things have their middles, y plus x, in ``OFFSET_SCALE_BLOCKS``.

    Its mean is over the blocks whose four innermost pixels move, so that a mirror changes nothing.

    Args:
        offsets: [B, 2, h, w] in blocks.
        true_offsets: [B, 2, h, w] likewise.
        truth: [B, H, W] uint8 bits.
    """
    size, middle = EVIDENCE_BLOCK_PX, EVIDENCE_BLOCK_PX // 2
    four = [truth[:, middle - down :: size, middle - right :: size] for down in (0, 1) for right in (0, 1)]
    moving = ((four[0] & four[1] & four[2] & four[3] & MOVING) != 0).float()
    error = F.smooth_l1_loss(offsets, true_offsets.float(), reduction="none").sum(dim=1) / OFFSET_SCALE_BLOCKS
    return (error * moving).sum() / moving.sum().clamp(min=1)
