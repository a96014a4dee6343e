"""The evidence head: shapes, seeds, sharp edges, cues."""

from __future__ import annotations

import pytest
import torch

from viflow_anomaly.config import EVIDENCE_BLOCK_PX, EvidenceHeadConfig
from viflow_anomaly.evidence_cues import GEOMETRIC_CUES, PHOTOMETRIC_CUES
from viflow_anomaly.model.evidence_builder import GEOMETRIC, PHOTOMETRIC, build_evidence_head


def cues(height: int, width: int, *, count: int = 1, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    blocks = (height // EVIDENCE_BLOCK_PX, width // EVIDENCE_BLOCK_PX)
    return (
        torch.rand((count, PHOTOMETRIC, height, width), generator=generator) * 2 - 1,
        torch.rand((count, GEOMETRIC, *blocks), generator=generator) * 2 - 1,
    )


def test_it_takes_the_cues_that_there_are() -> None:
    assert (len(PHOTOMETRIC_CUES), len(GEOMETRIC_CUES)) == (PHOTOMETRIC, GEOMETRIC)


@pytest.mark.parametrize(("height", "width"), [(32, 32), (64, 96), (128, 416)])
def test_every_pixel_gets_two_logits_and_every_block_an_offset(height: int, width: int) -> None:
    logits, offsets = build_evidence_head(EvidenceHeadConfig())(*cues(height, width, count=2))
    assert logits.shape == (2, 2, height, width)
    assert offsets.shape == (2, 2, height // 4, width // 4)
    assert bool(torch.isfinite(logits).all() and torch.isfinite(offsets).all())


def test_the_seed_fixes_the_weights_and_nothing_else() -> None:
    torch.manual_seed(7)
    before = torch.rand(1)
    torch.manual_seed(7)
    first, again, other = (build_evidence_head(EvidenceHeadConfig(), seed=seed) for seed in (1, 1, 2))
    assert torch.equal(torch.rand(1), before)
    assert torch.equal(first.logits.weight, again.logits.weight)
    assert not torch.equal(first.logits.weight, other.logits.weight)


def test_a_pixel_has_a_say_in_its_own_logit() -> None:
    head = build_evidence_head(EvidenceHeadConfig())
    photometric, geometric = cues(32, 32)
    photometric.requires_grad_()
    head(photometric, geometric)[0][0, 0, 13, 22].backward()
    assert photometric.grad is not None
    assert float(photometric.grad[0, :, 13, 22].abs().max()) > 0


def test_other_widths_make_another_network() -> None:
    small, large = (
        sum(one.numel() for one in build_evidence_head(EvidenceHeadConfig(widths=widths)).parameters())
        for widths in ((8, 8, 8, 8), (16, 16, 16, 16))
    )
    assert small * 2 < large
