"""Endpoint error of predicted flow against ground truth, beside the identity's (no motion at all).

Measured in source-image pixels over every pixel with ground truth, twice: on the hypothesis that reconstructs the
source best, as the network predicted it (the paper's method; the choice needs no ground truth), and after the
correction on the target image, as the detector uses it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from viflow_anomaly.config import CorrectionConfig, ModelConfig
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.evaluation.flow_run import group_of
from viflow_anomaly.evaluation.flow_truth import FlowTruth, RecordingTruth, spread
from viflow_anomaly.geometry import Float32Array, pixel_grid
from viflow_anomaly.model_input import prepare
from viflow_anomaly.motor_input import require_command
from viflow_anomaly.prediction import predict_flow
from viflow_anomaly.runtime.interface import Runtime


@dataclass(frozen=True)
class PairError:
    """One pair: mean endpoint errors in pixels of the flow that the detector uses, of the winning hypothesis as it was
    predicted, and of the identity; and which hypothesis won."""

    sequence: str
    source_timestamp_ns: int
    epe_px: float
    predicted_epe_px: float
    identity_epe_px: float
    hypothesis: int


@dataclass(frozen=True)
class EndpointErrors:
    """Errors of many pairs."""

    pairs: tuple[PairError, ...] = field(default=())

    def summary(self) -> dict[str, float]:
        """Means over pairs, and their ratios to the identity's."""
        epe, predicted, identity = (
            float(np.mean([getattr(pair, name) for pair in self.pairs]))
            for name in ("epe_px", "predicted_epe_px", "identity_epe_px")
        )
        ratio, predicted_ratio = (one / identity if identity else float("nan") for one in (epe, predicted))
        return {
            "epe_px": round(epe, 4),
            "predicted_epe_px": round(predicted, 4),
            "identity_epe_px": round(identity, 4),
            "epe_ratio": round(ratio, 4),
            "predicted_epe_ratio": round(predicted_ratio, 4),
        }

    def per_sequence(self) -> dict[str, EndpointErrors]:
        """The errors of each sequence, by its name."""
        return self._split(lambda pair: pair.sequence)

    def per_group(self) -> dict[str, EndpointErrors]:
        """The errors of each group of sequences: the name up to its first underscore (the simulator's rig)."""
        return self._split(lambda pair: group_of(pair.sequence))

    def _split(self, key: Callable[[PairError], str]) -> dict[str, EndpointErrors]:
        names = sorted({key(pair) for pair in self.pairs})
        return {name: EndpointErrors(tuple(pair for pair in self.pairs if key(pair) == name)) for name in names}


def measure_endpoint_errors(
    runtime: Runtime,
    config: ModelConfig,
    recordings: Sequence[Path],
    *,
    correction: CorrectionConfig | None = None,
    max_pairs: int | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> EndpointErrors:
    """Errors against simulated static flow, adjacent frames.

    Args:
        runtime: of the network.
        config: what its input looks like.
        correction: None: its defaults.
        recordings: simulated sequences with ground truth.
        max_pairs: evenly spread over all pairs (None: all).
        on_progress: called with (done, total) after each pair.

    Raises:
        DatasetError: ``ground_truth_missing`` for a recording without ground truth, or with none that is valid for a
            pair; ``ground_truth_malformed``; as ``open_recording``.
    """
    chosen = spread([RecordingTruth(path) for path in recordings], max_pairs)
    errors = []
    for done, (truth, index) in enumerate(chosen, start=1):
        errors.append(_pair_error(runtime, config, truth, index, correction or CorrectionConfig()))
        if on_progress is not None:
            on_progress(done, len(chosen))
    return EndpointErrors(tuple(errors))


def require_ground_truth(recordings: Sequence[Path], model: ModelConfig) -> None:
    """Find out before a long training, not after it, that a recording cannot be measured on.

    Raises:
        DatasetError: as ``measure_endpoint_errors``; only the first pair and its ground truth are read.
        InvalidInputError: the pair cannot be read, or lacks the motor command that the model wants.
    """
    for path in recordings:
        truth = RecordingTruth(path)
        truth.truth(0)
        pair = truth.pair(0, model.motor_source)
        if model.motor_source is not None:
            require_command(pair.motor_command, model)


def _pair_error(
    runtime: Runtime,
    config: ModelConfig,
    truth: FlowTruth,
    index: int,
    correction: CorrectionConfig,
) -> PairError:
    pair = truth.pair(index, config.motor_source)
    model_input = prepare(pair, config)
    predicted = predict_flow(runtime, model_input, correction, focal_px=config.view.focal_px)
    flow, valid = truth.truth(index)
    if not valid.any():
        raise DatasetError(
            f"{truth.sequence}: expected valid static flow at {pair.source.timestamp_ns}, found no valid pixel",
            code="ground_truth_missing",
            field="validation",
        )

    def epe(flow_view_px: Float32Array) -> float:
        target = model_input.view.target_coordinates(flow_view_px, predicted.stride)
        difference = target - pixel_grid(*flow.shape[:2]) - flow
        return float(np.linalg.norm(difference, axis=-1)[valid].mean())

    return PairError(
        sequence=truth.sequence,
        source_timestamp_ns=pair.source.timestamp_ns,
        epe_px=epe(predicted.flow_px),
        predicted_epe_px=epe(predicted.hypothesis_px),
        identity_epe_px=float(np.linalg.norm(flow, axis=-1)[valid].mean()),
        hypothesis=predicted.hypothesis,
    )
