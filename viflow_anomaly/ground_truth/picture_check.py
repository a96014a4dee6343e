"""Whether ground truth agrees with what the pictures show: wrong extrinsics, lens, direction or clock show at once."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from viflow_anomaly.datasets.ground_truth_folder import GroundTruthFolder
from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.geometry import pixel_grid, sample_bilinear

MIN_GRADIENT_GRAY = 60.0
"""Sobel sum from which a pixel has texture enough for its flow to be measured."""


@dataclass(frozen=True)
class PictureCheck:
    """One pair. Over pixels with texture and truth that stay in the picture: median length of the true flow, and median
    distance to the flow that dense inverse search measures. Over all of those with truth: the mean gray difference
    between the frames as they are, and with the target warped by the truth."""

    flow_px: float
    distance_px: float
    identity_gray: float
    warped_gray: float


def check_pair(recording: Recording, truth: GroundTruthFolder, index: int) -> PictureCheck | None:
    """Frame ``index`` and the next one; None where the truth leaves no pixel to judge.

    Raises:
        DatasetError: as ``GroundTruthFolder.static_flow``.
    """
    source, target = recording.frame(index), recording.frame(index + 1)
    flow, valid = truth.static_flow(source.timestamp_ns, target.timestamp_ns)
    height, width = valid.shape
    there = pixel_grid(height, width) + flow
    inside = valid & (there >= 0).all(axis=-1) & (there <= (width - 1, height - 1)).all(axis=-1)
    gray, after = source.image.astype(np.float32), target.image.astype(np.float32)
    gradient = np.abs(cv2.Sobel(gray, cv2.CV_32F, 1, 0)) + np.abs(cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    judged = inside & (gradient > MIN_GRADIENT_GRAY)
    if not judged.any():
        return None
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    measured = search.calc(source.image, target.image, np.zeros_like(flow))
    return PictureCheck(
        flow_px=float(np.median(np.linalg.norm(flow, axis=-1)[judged])),
        distance_px=float(np.median(np.linalg.norm(flow - measured, axis=-1)[judged])),
        identity_gray=float(np.abs(after - gray)[inside].mean()),
        warped_gray=float(np.abs(sample_bilinear(after, there) - gray)[inside].mean()),
    )
