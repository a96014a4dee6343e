"""What can be measured: a method answers a pair with dense flow, NaN where it has no estimate."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np

from viflow_anomaly.checkpoint_record import CheckpointRecord
from viflow_anomaly.config import CorrectionConfig, MotorSource
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.evaluation.flow_truth import PairName
from viflow_anomaly.geometry import Float32Array, pixel_grid
from viflow_anomaly.model_input import prepare
from viflow_anomaly.prediction import predict_flow
from viflow_anomaly.runtime.interface import Runtime
from viflow_anomaly.sensor_data import FramePair

MethodKind = Literal["network", "baseline", "results"]
CORRECTED = "+correction"
"""Ends the name of a network's flow after the correction on the target image."""


@dataclass(frozen=True)
class MethodAbout:
    """What a row of a table says of a method.

    Attributes:
        name: of the row, unique in a run.
        kind: ``network`` (ours), ``baseline`` (computed here), ``results`` (read from files).
        preset, inputs, hypotheses: of a network; ``inputs`` is the motion that it eats.
        corrected: whether the network's flow was corrected on the target image.
        details: more for the JSON (checksum, runtime, folder).
    """

    name: str
    kind: MethodKind
    preset: str | None = None
    inputs: str | None = None
    hypotheses: int | None = None
    corrected: bool = False
    details: dict[str, Any] = field(default_factory=dict)

    @property
    def series(self) -> str:
        """What networks that differ in their hypotheses alone have in common; other methods stand alone."""
        if self.hypotheses is None:
            return self.name
        return f"{self.preset} {self.inputs}" + (CORRECTED if self.corrected else "")


class NoEstimateError(Exception):
    """A method has nothing to say about a pair; ``reason`` is what its missing pairs are counted by."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class FlowMethod(Protocol):
    """Anything that gives flow for a pair."""

    @property
    def about(self) -> MethodAbout: ...

    @property
    def motor_source(self) -> MotorSource | None:
        """What the pairs' motor command must hold; None: the method looks at none."""

    @property
    def timed(self) -> bool:
        """Whether the time of ``flow`` is the method's runtime (reading a file is not)."""

    def flow(self, pair: FramePair, name: PairName) -> Float32Array:
        """[H, W, 2] float32 in source-image pixels, NaN where there is no estimate.

        Raises:
            NoEstimateError: for no pixel of this pair; it is counted as missing.
            ViflowError: the method cannot be used.
        """


class NetworkMethod:
    """A network: the hypothesis that rebuilds the source best as it was predicted, or corrected on the target image.

    What lies outside the network's view has no estimate.

    Args:
        name: of the checkpoint in tables; the corrected flow's row ends in ``+correction``.
        runtime, record: the network.
        correction: not enabled: as the network predicted it, the paper's method.
    """

    timed = True

    def __init__(self, name: str, runtime: Runtime, record: CheckpointRecord, correction: CorrectionConfig) -> None:
        self._runtime = runtime
        self._correction = correction
        self.motor_source: MotorSource | None = record.model.motor_source
        self._config = record.model
        self.about = MethodAbout(
            name=name + (CORRECTED if correction.enabled else ""),
            kind="network",
            preset=record.model.preset,
            inputs=record.model.motion_inputs,
            hypotheses=record.model.hypotheses,
            corrected=correction.enabled,
            details={
                "model": {"name": record.name, "version": record.version, "sha256": record.sha256},
                **runtime.backend._asdict(),
            },
        )

    def flow(self, pair: FramePair, name: PairName) -> Float32Array:
        del name
        try:
            model_input = prepare(pair, self._config)
        except InvalidInputError as err:
            raise NoEstimateError(err.code) from err
        predicted = predict_flow(self._runtime, model_input, self._correction, focal_px=self._config.view.focal_px)
        view = model_input.view
        at_px = view.target_coordinates(predicted.flow_px, predicted.stride)
        flow = np.asarray(at_px - pixel_grid(*at_px.shape[:2]), dtype=np.float32)
        shown = view.analyzed()
        if shown is not None:
            flow[~shown] = np.nan
        return flow


def network_methods(
    name: str, runtime: Runtime, record: CheckpointRecord, correction: CorrectionConfig
) -> list[NetworkMethod]:
    """The rows of one checkpoint: as it was predicted, and corrected unless ``correction`` is not enabled."""
    methods = [NetworkMethod(name, runtime, record, correction.model_copy(update={"enabled": False}))]
    if correction.enabled:
        methods.append(NetworkMethod(name, runtime, record, correction))
    return methods
