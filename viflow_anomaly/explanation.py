"""How much of the source image a predicted flow explains: rebuild it from the target, and compare the two."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.config import DetectorConfig
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.model_input import ModelInput
from viflow_anomaly.prediction import PredictedFlow
from viflow_anomaly.residual import (
    compensate_exposure,
    half_range_gray,
    photometric_residual,
    reconstruct,
    texture_normalised,
)
from viflow_anomaly.sensor_data import FramePair, Uint8Array


class Explanation(NamedTuple):
    """A pair after prediction and reconstruction, before anything is judged; maps are [H, W] of the source image.

    Attributes:
        source: uint8.
        model_input, predicted: what it was explained with.
        target_coordinates: [H, W, 2] float32 where each source pixel is predicted in the target image.
        reconstruction: float32 source rebuilt from the target, in the source's exposure.
        inside: analysed pixels that are still in the target image.
        residual: float32 gray levels.
        half_range: float32, of the source (``half_range_gray``).
        normalised: float32, the residual normalised by it.
    """

    source: Uint8Array
    model_input: ModelInput
    predicted: PredictedFlow
    target_coordinates: Float32Array
    reconstruction: Float32Array
    inside: NDArray[np.bool_]
    residual: Float32Array
    half_range: Float32Array
    normalised: Float32Array


def explain(
    pair: FramePair,
    model_input: ModelInput,
    predicted: PredictedFlow,
    config: DetectorConfig,
    *,
    coordinates: Float32Array | None = None,
) -> Explanation:
    """Compare a pair under a predicted flow.

    Args:
        pair: the images.
        model_input: how the network saw them.
        predicted: the flow of the static world.
        config: which residual, and whether an exposure is compensated.
        coordinates: [H, W, 2] of every source pixel in the target image; None: as predicted.
    """
    source, view = pair.source.image, model_input.view
    if coordinates is None:
        coordinates = view.target_coordinates(predicted.flow_px, predicted.stride)
    reconstruction, inside = reconstruct(pair.target.image, coordinates)
    if (analyzed := view.analyzed()) is not None:
        inside &= analyzed
    if config.photometric_compensation:
        reconstruction = compensate_exposure(reconstruction, source, inside)
    residual = photometric_residual(source, reconstruction, inside)
    for flow_px in predicted.hypotheses_px if config.residual == "minimum" else ():
        rebuilt, reached = reconstruct(pair.target.image, view.target_coordinates(flow_px, predicted.stride))
        both = inside & reached
        if config.photometric_compensation:
            rebuilt = compensate_exposure(rebuilt, source, both)
        np.minimum(residual, photometric_residual(source, rebuilt, both), out=residual, where=both)
    half_range = half_range_gray(source)
    normalised = texture_normalised(residual, half_range, config.regions.texture_softening_gray)
    return Explanation(
        source, model_input, predicted, coordinates, reconstruction, inside, residual, half_range, normalised
    )
