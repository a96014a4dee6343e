"""What a training starts from instead of fresh weights: a checkpoint's tensors and its whole model configuration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch

from viflow_anomaly.checkpoint import LoadedEvidenceHead, load_checkpoint, load_evidence_head
from viflow_anomaly.checkpoint_record import CheckpointRecord, EvidenceRecord
from viflow_anomaly.config import EvidenceHeadConfig, FrozenConfig, ModelConfig
from viflow_anomaly.errors import CheckpointError, ConfigError
from viflow_anomaly.evidence_cues import GEOMETRIC_CUES, PHOTOMETRIC_CUES


class InitialWeights(NamedTuple):
    """A checkpoint to go on from.

    Attributes:
        weights: the network's state, on the CPU.
        model: its configuration, the motor stream as it was fitted.
        origin: name, version and sha256, for the provenance of what comes of it.
    """

    weights: Mapping[str, torch.Tensor]
    model: ModelConfig
    origin: dict[str, Any]


def read_initial_weights(path: Path, asked: ModelConfig) -> InitialWeights:
    """The checkpoint to start from.

    Args:
        path: its tensor file.
        asked: what was asked for; only what was set in it counts, its defaults contradict nothing.

    Raises:
        CheckpointError: as ``load_checkpoint``.
        ConfigError: ``init_model_differs``: a setting of ``asked`` is not the checkpoint's.
    """
    network, record = load_checkpoint(path)
    _require_same(path, "model", asked, record.model)
    return InitialWeights(network.state_dict(), record.model, origin_of(record))


def read_initial_head(path: Path, asked: EvidenceHeadConfig) -> LoadedEvidenceHead:
    """The evidence head to start from, also one of an older cues' arithmetic; arguments and errors as above.

    Raises:
        CheckpointError: ``evidence_cues_differ`` for one that was trained on other cues.
    """
    loaded = load_evidence_head(path)
    found = loaded.record.photometric_cues, loaded.record.geometric_cues
    if found != (PHOTOMETRIC_CUES, GEOMETRIC_CUES):
        raise CheckpointError(
            f"{path}: with --init expected a head that was trained on the cues {PHOTOMETRIC_CUES + GEOMETRIC_CUES}, "
            f"found {found[0] + found[1]}",
            code="evidence_cues_differ",
            field="init",
        )
    _require_same(path, "evidence_training.head", asked, loaded.record.head)
    return loaded


def origin_of(record: CheckpointRecord | EvidenceRecord) -> dict[str, Any]:
    """What the provenance of a training tells of the checkpoint that it began with."""
    return {"name": record.name, "version": record.version, "sha256": record.sha256}


def _require_same(path: Path, name: str, asked: FrozenConfig, has: FrozenConfig) -> None:
    differing = list(_differing(name, asked, has))
    if differing:
        raise ConfigError(
            f"{path}: with --init expected the checkpoint's own settings of {name}, or none, found "
            + "; ".join(f"{key}: {wanted!r}, but the checkpoint has {found!r}" for key, wanted, found in differing),
            code="init_model_differs",
            field=differing[0][0],
        )


def _differing(name: str, asked: FrozenConfig, has: FrozenConfig) -> Iterator[tuple[str, object, object]]:
    """Each setting that was set in ``asked`` and is another in ``has``: its dotted name and both values."""
    for key in sorted(asked.model_fields_set):
        wanted, found = getattr(asked, key), getattr(has, key)
        if isinstance(wanted, FrozenConfig):
            yield from _differing(f"{name}.{key}", wanted, found)
        elif wanted != found:
            yield f"{name}.{key}", wanted, found
