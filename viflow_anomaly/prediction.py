"""From a network's hypotheses to one flow: choose what explains the target image best, then correct it there."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from viflow_anomaly.config import CorrectionConfig
from viflow_anomaly.correction import Correction, correct_flow, correct_motion
from viflow_anomaly.geometry import Float32Array, cached_pixel_grid, pixel_grid, sample_bilinear
from viflow_anomaly.measured_flow import MeasuredFlow, measure_flow
from viflow_anomaly.model_input import ModelInput
from viflow_anomaly.runtime.interface import Hypotheses, Runtime
from viflow_anomaly.sensor_data import Uint8Array

SELECTION_STRIDE_PX = 4
"""Hypotheses compete on pictures shrunk this far, as in training."""
CHARBONNIER_EPSILON = 0.01
UNKNOWN_ROTATION_SIGMA_RAD = 0.3
"""The prior of the correction where no gyro was seen: none to speak of."""


class PredictedFlow(NamedTuple):
    """Where the static world goes.

    Attributes:
        flow_px: [h, w, 2] float32 in view pixels, on cells of ``stride``.
        stride: view pixels for one cell.
        hypothesis: the winner.
        hypothesis_px: [h, w, 2] its flow as the network predicted it.
        correction: what the target image changed, None with correction off.
        measured: what the correction was made with.
        hypotheses_px: [K, h, w, 2] float32, all that the network predicted.
    """

    flow_px: Float32Array
    stride: int
    hypothesis: int
    hypothesis_px: Float32Array
    correction: Correction | None
    measured: MeasuredFlow | None
    hypotheses_px: Float32Array


def predict_flow(
    runtime: Runtime, model_input: ModelInput, config: CorrectionConfig, *, focal_px: float
) -> PredictedFlow:
    """The flow of the static world in one view.

    Args:
        runtime: of the network.
        model_input: the pair.
        config: of the correction, which starts at the hypothesis that reconstructs the source best. Off: that
            hypothesis stands as the network predicted it (the paper's method).
        focal_px: that the network takes the view for.
    """
    return correct(runtime.predict(model_input), model_input, config, focal_px=focal_px)


def correct(
    hypotheses: Hypotheses, model_input: ModelInput, config: CorrectionConfig, *, focal_px: float
) -> PredictedFlow:
    """Choose a hypothesis and correct it; arguments as in ``predict_flow``."""
    stride = hypotheses.stride
    winner = choose_hypothesis(hypotheses, model_input.source, model_input.target)
    predicted = hypotheses.flow_px[winner]
    if not config.enabled:
        return PredictedFlow(predicted, stride, winner, predicted, None, None, hypotheses.flow_px)
    measured = measure_flow(model_input.source, model_input.target, stride=stride, around=predicted)
    scene = hypotheses.scene
    focal_px = model_input.view.focal_px if scene is None else focal_px  # a scene's flow is in the network's own
    if not model_input.rotation_known:
        config = config.model_copy(update={"rotation_sigma_rad": UNKNOWN_ROTATION_SIGMA_RAD})
    rays = view_rays(*predicted.shape[:2], stride, *model_input.source.shape, focal_px)
    if scene is None:
        correction = correct_flow(rays, hypotheses.flow_px, winner, measured, focal_px, config)
    else:
        correction = correct_motion(rays, scene.inverse_depth, scene.motion(winner), measured, focal_px, config)
    flows_px = (correction.flow_px, stride, winner, predicted)
    return PredictedFlow(*flows_px, correction, measured, hypotheses.flow_px)


@lru_cache(maxsize=16)
def view_rays(rows: int, columns: int, stride: int, height: int, width: int, focal_px: float) -> Float32Array:
    """[rows, columns, 2]: (x, y) of each cell from the middle of a height x width view, in focal lengths."""
    middle = ((width - 1) / 2, (height - 1) / 2)
    cells = (pixel_grid(rows, columns) + np.float32(0.5)) * np.float32(stride) - np.float32(0.5)
    rays = np.asarray((cells - middle) / focal_px, dtype=np.float32)
    rays.setflags(write=False)
    return rays


def choose_hypothesis(hypotheses: Hypotheses, source: Uint8Array, target: Uint8Array) -> int:
    """The hypothesis whose reconstruction of the source fits best [Approach], judged as in training on a coarse grid.

    A pixel whose prediction leaves the target costs what it would had nothing moved, so leaving never pays.
    """
    if len(hypotheses.flow_px) == 1:
        return 0
    return int(np.argmin(reconstruction_errors(hypotheses.flow_px, hypotheses.stride, source, target)))


def reconstruction_errors(flow_px: Float32Array, stride: int, source: Uint8Array, target: Uint8Array) -> Float32Array:
    """[K] mean error of the source rebuilt by each of the flows [K, h, w, 2], on cells of ``stride`` view pixels."""
    shrink = max(stride, SELECTION_STRIDE_PX)
    size = (source.shape[1] // shrink, source.shape[0] // shrink)
    small_source, small_target = (_normalised(image, size, shrink) for image in (source, target))
    at = np.stack([_shrunk(one, size, shrink // stride) for one in flow_px]) * np.float32(1 / shrink)
    at += cached_pixel_grid(size[1], size[0])  # K, h, w, 2
    tall = at.reshape(-1, size[0], 2)
    inside = cv2.inRange(tall, (0.0, 0.0), (size[0] - 1.0, size[1] - 1.0)).reshape(at.shape[:3]) != 0
    sampled = sample_bilinear(small_target, tall).reshape(at.shape[:3])
    difference = np.where(inside, sampled, small_target) - small_source
    errors = np.sqrt(difference * difference + np.float32(CHARBONNIER_EPSILON**2)).mean(axis=(1, 2))
    return np.asarray(errors, dtype=np.float32)


def _normalised(image: Uint8Array, size: tuple[int, int], shrink: int) -> Float32Array:
    """Mean 0 and deviation 1, so that a change of exposure costs nothing; then shrunk by averaging."""
    whole = image[: size[1] * shrink, : size[0] * shrink]
    mean, deviation = cv2.meanStdDev(whole)
    small = cv2.resize(whole, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.asarray((small - np.float32(mean[0, 0])) / np.float32(deviation[0, 0] + 0.02 * 255), dtype=np.float32)


def _shrunk(flow_px: Float32Array, size: tuple[int, int], factor: int) -> Float32Array:
    whole = flow_px[: size[1] * factor, : size[0] * factor]
    return whole if factor == 1 else np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), np.float32)
