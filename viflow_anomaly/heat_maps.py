"""Maps of one pair as pictures of their own, [H, W, 3] BGR uint8: residual, evidence, the static world's flow."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.drawing import HEAT_MAX_GRAY, Picture
from viflow_anomaly.geometry import Float32Array

UNKNOWN_GRAY = 128
FLOW_PERCENTILE = 95.0
"""The colours of a flow are full at this percentile of its length."""


def draw_residual(residual: Float32Array) -> Picture:
    """[H, W] gray levels: black is none, full colour from ``HEAT_MAX_GRAY`` on in every picture."""
    return _heat(residual / np.float32(HEAT_MAX_GRAY), cv2.COLORMAP_INFERNO)


def draw_evidence(evidence: Float32Array, *, learned: bool) -> Picture:
    """[H, W] what regions are found in: probabilities 0..1 of the evidence head, or a normalised residual."""
    return _heat(evidence if learned else evidence / np.float32(HEAT_MAX_GRAY), cv2.COLORMAP_VIRIDIS)


def draw_flow(flow_px: Float32Array) -> Picture:
    """[H, W, 2]: hue is the direction (red: right), white is no motion, gray where it is not finite."""
    known: NDArray[np.bool_] = np.asarray(np.isfinite(flow_px).all(axis=-1))
    flow = np.where(known[..., None], flow_px, 0).astype(np.float32)
    length = np.linalg.norm(flow, axis=-1)
    full_px = float(np.percentile(length[known], FLOW_PERCENTILE)) if known.any() else 1.0
    strength = np.minimum(length / max(full_px, 1e-6), 1.0)
    hue = np.degrees(np.arctan2(flow[..., 1], flow[..., 0])) % 360.0
    hsv = np.stack([hue, strength, 1 - 0.15 * strength], axis=-1).astype(np.float32)
    picture = np.asarray(np.rint(255 * cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)), dtype=np.uint8)
    picture[~known] = UNKNOWN_GRAY
    return picture


def _heat(shares: Float32Array, colours: int) -> Picture:
    levels = (np.clip(np.nan_to_num(shares), 0, 1) * 255).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(levels, colours), dtype=np.uint8)
