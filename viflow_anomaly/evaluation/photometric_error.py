"""How well a flow rebuilds the source image from the target, beside standing still: where there is no ground truth."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from viflow_anomaly.geometry import Float32Array, pixel_grid
from viflow_anomaly.residual import photometric_residual, reconstruct
from viflow_anomaly.sensor_data import FramePair


class PhotometricError(NamedTuple):
    """Means in gray levels over the pixels that the flow knows and that stay in the target image."""

    residual_gray: float
    frame_difference_gray: float


def photometric_error(pair: FramePair, flow_px: Float32Array) -> PhotometricError:
    """Of a flow [H, W, 2] in source pixels, NaN where it knows nothing."""
    known = np.asarray(np.isfinite(flow_px).all(axis=-1))
    at_px = np.where(known[..., None], flow_px, 0).astype(np.float32) + pixel_grid(*known.shape)
    reconstruction, inside = reconstruct(pair.target.image, at_px)
    judged = inside & known
    residual = photometric_residual(pair.source.image, reconstruction, judged)[judged]
    difference = cv2.absdiff(pair.source.image, pair.target.image)[judged]
    return PhotometricError(float(residual.mean()), float(difference.mean()))
