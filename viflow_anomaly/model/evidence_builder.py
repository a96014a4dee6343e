"""Where numbers meet the evidence head's class."""

from __future__ import annotations

import torch

from viflow_anomaly.config import EvidenceHeadConfig
from viflow_anomaly.model.evidence_head import EvidenceHead

PHOTOMETRIC, GEOMETRIC = 3, 13
"""How many cues of each kind, as ``evidence_cues`` makes them (a test compares them)."""


def build_evidence_head(config: EvidenceHeadConfig, *, seed: int = 0) -> EvidenceHead:
    """A freshly initialised head; the same seed gives the same weights and leaves the global generator alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return EvidenceHead(photometric=PHOTOMETRIC, geometric=GEOMETRIC, widths=config.widths)
