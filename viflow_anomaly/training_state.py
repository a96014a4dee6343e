"""The exact way of a network and its optimiser to disk and back."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import nn

from viflow_anomaly.checkpoint import load_training_state
from viflow_anomaly.errors import CheckpointError, ConfigError


def state_tensors(network: nn.Module, optimizer: torch.optim.Optimizer) -> dict[str, torch.Tensor]:
    """All tensors of a running training by name."""
    tensors = {f"model.{key}": value for key, value in network.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{key}": torch.as_tensor(value) for key, value in state.items()}
    return tensors


def _restore(
    network: nn.Module, optimizer: torch.optim.Optimizer, tensors: Mapping[str, torch.Tensor], folder: Path
) -> None:
    """Take up what ``state_tensors`` gave."""
    try:
        network.load_state_dict(_below(tensors, "model."))
        _restore_optimizer(network, optimizer, _below(tensors, "optimizer."))
    except (RuntimeError, ValueError, LookupError) as err:
        raise CheckpointError(
            f"{folder}: expected the whole state of this training, found: {' '.join(str(err).split())[:300]}",
            code="checkpoint_corrupt",
            field="out",
        ) from err


class Schedule(Protocol):
    """What the learning rate of a step depends on."""

    @property
    def learning_rate(self) -> float: ...

    @property
    def warmup_steps(self) -> int: ...

    @property
    def steps(self) -> int: ...


def learning_rate(config: Schedule, step: int) -> float:
    """Linear warm-up, then half a cosine down to a hundredth."""
    if step < config.warmup_steps:
        return config.learning_rate * (step + 1) / config.warmup_steps
    progress = (step - config.warmup_steps) / max(1, config.steps - config.warmup_steps)
    return config.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, progress))))


def resume_state(
    network: nn.Module, optimizer: torch.optim.Optimizer, folder: Path, fingerprint: Mapping[str, Any]
) -> int | None:
    """Take up the state in ``folder``; the step that it had reached, None where there is none.

    Raises:
        ConfigError: ``resume_config_differs``.
        CheckpointError: ``checkpoint_corrupt``.
    """
    loaded = load_training_state(folder)
    if loaded is None:
        return None
    tensors, record = loaded
    require_same_run(folder, record, fingerprint)
    _restore(network, optimizer, tensors, folder)
    return _reached_step(record, folder)


def _reached_step(record: Mapping[str, Any], folder: Path) -> int:
    step = record.get("step")
    if not isinstance(step, int):
        raise CheckpointError(
            f"{folder}: expected the step that was reached, found {step!r}", code="checkpoint_corrupt", field="out"
        )
    return step


def _restore_optimizer(
    network: nn.Module, optimizer: torch.optim.Optimizer, tensors: Mapping[str, torch.Tensor]
) -> None:
    parameters = list(network.parameters())
    states: dict[int, dict[str, torch.Tensor]] = {}
    for key, value in tensors.items():
        index, name = key.split(".", 1)
        # A moment of another memory layout than its parameter's would take another arithmetic path.
        like = parameters[int(index)]
        same_layout = torch.empty_like(like).copy_(value) if value.shape == like.shape else value
        states.setdefault(int(index), {})[name] = same_layout
    optimizer.load_state_dict({**optimizer.state_dict(), "state": states})


def _below(tensors: Mapping[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}


def require_same_run(folder: Path, record: Mapping[str, Any], fingerprint: Mapping[str, Any]) -> None:
    """A resumed training must be the one that was started.

    Raises:
        ConfigError: ``resume_config_differs``.
    """
    for key, value in fingerprint.items():
        now = json.loads(json.dumps(value))
        if key not in record or record[key] != now:
            raise ConfigError(
                f"{folder}: --resume expects the {key} that the run was started with, "
                + (_difference(record[key], now) if key in record else _unnamed(now)),
                code="resume_config_differs",
                field=key,
            )


def _unnamed(now: object) -> str:
    """What the error shows where an older version wrote the state."""
    return f"which its state does not name, found {len(now) if isinstance(now, list) else now}"


def _difference(before: object, now: object) -> str:
    """What the error shows: both values, of settings those that differ; of lists of names what one of them lacks."""
    if isinstance(before, dict) and isinstance(now, dict):
        differing = [key for key in {**before, **now} if before.get(key) != now.get(key)]
        before, now = ({key: one.get(key) for key in differing} for one in (before, now))
    if not isinstance(before, list) or not isinstance(now, list):
        return f"{before}, found {now}"
    lost, added = ((Counter(one) - Counter(other)).elements() for one, other in ((before, now), (now, before)))
    return f"{len(before)}, found {len(now)}: without {sorted(lost)[:5]}, with {sorted(added)[:5]}"
