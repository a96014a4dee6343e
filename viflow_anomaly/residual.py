"""Reconstruct the source image from the target, and how far the two differ: |I_r - I_i| in gray levels.

Sampling is bilinear at pixel coordinates (pixel centres at integers), as in the network's training, but at the source
image's own size. Coordinates beyond the target image are answered with ``inside`` False and a residual of 0.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.errors import TooLargeError
from viflow_anomaly.geometry import Float32Array, sample_bilinear
from viflow_anomaly.sensor_data import Uint8Array

MAX_SIDE_PX = 32767
"""cv2.remap addresses pixels with signed 16-bit integers."""
BOUNDARY_TOLERANCE_PX = 1e-3
"""float32 coordinates a thousand pixels from the origin carry errors of 1e-4; such a coordinate is still inside."""


EXPOSURE_SAMPLES = 1_000
MIN_EXPOSURE_SAMPLES = 100
EXPOSURE_ROUNDS = 4
EXPOSURE_TOLERANCE_GRAY = 6.0
EXPOSURE_PRIOR_GRAY = 2.0
"""Deviation of the gray levels below which a gain cannot be told from a bias."""
MAX_GAIN = 2.0


def reconstruct(target: Uint8Array, target_coordinates: Float32Array) -> tuple[Float32Array, NDArray[np.bool_]]:
    """Sample the target image where each source pixel is predicted to have gone.

    Args:
        target: [H, W] uint8 gray image I_i+1.
        target_coordinates: [h, w, 2] float32, (u, v) in target pixels for every source pixel. NaN is outside.

    Returns:
        reconstruction [h, w] float32 in gray levels (0 where outside) and inside [h, w]: the coordinate lies between
        the centres of the target's corner pixels.

    Raises:
        TooLargeError: ``image_too_large``, a side beyond 32767 px (a limit of cv2.remap).
    """
    height, width = target.shape
    longest = max(height, width, *target_coordinates.shape[:2])
    if longest > MAX_SIDE_PX:
        raise TooLargeError(
            f"image: expected sides of at most {MAX_SIDE_PX} px, found {longest} px",
            code="image_too_large",
            field="image",
        )
    low, high = -BOUNDARY_TOLERANCE_PX, BOUNDARY_TOLERANCE_PX
    inside = cv2.inRange(target_coordinates, (low, low), (width - 1 + high, height - 1 + high)) != 0
    # BORDER_REPLICATE: at u = W - 1 bilinear sampling reads the pixel beyond, with weight zero.
    sampled = sample_bilinear(target.astype(np.float32), target_coordinates)
    np.copyto(sampled, 0.0, where=~inside)  # not a product: a NaN coordinate samples NaN
    return np.asarray(sampled, dtype=np.float32), inside


def photometric_residual(source: Uint8Array, reconstruction: Float32Array, inside: NDArray[np.bool_]) -> Float32Array:
    """|reconstruction - source| [H, W] float32 in gray levels, 0 where ``inside`` is False."""
    difference = cv2.absdiff(source.astype(np.float32), reconstruction)
    np.copyto(difference, 0.0, where=~inside)
    return np.asarray(difference, dtype=np.float32)


def compensate_exposure(reconstruction: Float32Array, source: Uint8Array, inside: NDArray[np.bool_]) -> Float32Array:
    """gain * reconstruction + bias, the nearest to the source: a change of exposure is no motion.

    Robust least squares (Cauchy weights, half at ``EXPOSURE_TOLERANCE_GRAY``) on a lattice of the inside pixels, from
    "no change" on, so that movers do not pull. Where too few pixels share a part of the scene, or a gain would be
    beyond ``MAX_GAIN``, nothing is compensated.

    Args:
        reconstruction: [H, W] float32 gray levels.
        source: [H, W] uint8.
        inside: [H, W]; elsewhere the result is the reconstruction.
    """
    stride = max(1, int(np.sqrt(source.size / EXPOSURE_SAMPLES)))
    thin = (slice(None, None, stride),) * 2
    chosen = inside[thin]
    x, y = reconstruction[thin][chosen].astype(np.float64), source[thin][chosen].astype(np.float64)
    if x.size < MIN_EXPOSURE_SAMPLES:
        return reconstruction
    gain, bias = 1.0, float(np.median(y - x))
    for _ in range(EXPOSURE_ROUNDS):
        error = (gain * x + bias - y) * (1 / EXPOSURE_TOLERANCE_GRAY)
        weights = 1 / (1 + error * error)
        total = float(weights.sum())
        middle_x, middle_y = float(weights @ x) / total, float(weights @ y) / total
        from_middle = x - middle_x
        weights *= from_middle
        # A uniform picture says nothing of the gain: the prior keeps it at 1.
        prior = EXPOSURE_PRIOR_GRAY**2 * total
        gain = (float(weights @ (y - middle_y)) + prior) / (float(weights @ from_middle) + prior)
        bias = middle_y - gain * middle_x
    if not 1 / MAX_GAIN <= gain <= MAX_GAIN:
        return reconstruction
    compensated = reconstruction * np.float32(gain)
    compensated += np.float32(bias)
    np.copyto(compensated, reconstruction, where=~inside)
    return compensated


def half_range_gray(source: Uint8Array) -> Float32Array:
    """[H, W] float32: half the gray range of the 3x3 pixels around each, what a misplacement of one pixel leaves."""
    block = np.ones((3, 3), np.uint8)
    span = cv2.subtract(cv2.dilate(source, block), cv2.erode(source, block)).astype(np.float32)
    span *= np.float32(0.5)
    return span


def texture_normalised(residual: Float32Array, half_range: Float32Array, softening_gray: float) -> Float32Array:
    """The residual over what a misplacement of one pixel would leave at the same place.

    Where the source is flat the result is twice the residual, at a half range of ``softening_gray`` it is the residual,
    on strong edges less: errors of the prediction show on edges, things that moved show on plain surfaces, too.

    Args:
        residual: [H, W] float32 gray levels.
        half_range: [H, W] of the source, ``half_range_gray``.
        softening_gray: 0 gives the residual itself (the paper's).
    """
    if softening_gray == 0:
        return residual
    scale = half_range * np.float32(0.5 / softening_gray)
    scale += np.float32(0.5)
    return np.asarray(cv2.divide(residual, scale), dtype=np.float32)
