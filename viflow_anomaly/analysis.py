"""A detection with the maps that it was made from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.detection import Detection
from viflow_anomaly.explanation import Explanation
from viflow_anomaly.geometry import Float32Array, pixel_grid
from viflow_anomaly.internal_size import InternalSize
from viflow_anomaly.model_input import ModelInput
from viflow_anomaly.prediction import PredictedFlow


@dataclass(frozen=True, eq=False)
class Analysis:
    """A detection with its maps, for pictures and further processing; maps are made when they are asked for.

    Attributes:
        detection: what ``detect`` returns.
        explained: the pair at the size at which it was judged.
        found_in: what regions were found in, at that size.
        learned: this is a pair for the evidence head, so that ``evidence`` are probabilities.
        size: None where the pair was judged at the size it came in.
    """

    detection: Detection
    explained: Explanation
    found_in: Float32Array
    learned: bool
    size: InternalSize | None = None

    @property
    def predicted(self) -> PredictedFlow:
        """The flow that the maps come from, in the network's view, and its correction."""
        return self.explained.predicted

    @property
    def model_input(self) -> ModelInput:
        """How the network saw the pair; its view is of the size at which the pair was judged."""
        return self.explained.model_input

    @cached_property
    def residual(self) -> Float32Array:
        """[H, W] float32 photometric residual in gray levels at the source image's size."""
        return self._map(self.explained.residual)

    @cached_property
    def evidence(self) -> Float32Array:
        """[H, W] float32 what regions are found in: probabilities of motion 0..1 (learned evidence), or the residual,
        normalised by texture. The head does not look at a pair that is not judged: probabilities are 0."""
        return self._map(self.found_in)

    @cached_property
    def reconstruction(self) -> Float32Array:
        """[H, W] float32 source image rebuilt from the target."""
        return self._map(self.explained.reconstruction)

    @cached_property
    def inside(self) -> NDArray[np.bool_]:
        """[H, W] analysed pixels that are still in the target image; elsewhere nothing is found."""
        inside = self.explained.inside
        return inside if self.size is None else self.size.mask(inside)

    @cached_property
    def target_coordinates(self) -> Float32Array:
        """[H, W, 2] float32 where each source pixel is predicted in the target image."""
        coordinates = self.explained.target_coordinates
        return coordinates if self.size is None else self.size.coordinates(coordinates)

    @property
    def flow_px(self) -> Float32Array:
        """[H, W, 2] float32 flow of the static world in source pixels."""
        return self.target_coordinates - pixel_grid(*self.residual.shape)

    def _map(self, values: Float32Array) -> Float32Array:
        return values if self.size is None else self.size.map(values)
