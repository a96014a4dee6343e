"""What the evidence head looks at: how the reconstruction differs from the source, and what geometry says of it.

None of the cues is the picture itself. The head learns on simulated scenes; what it must not learn is what movers look
like there. All cues are bounded to -1..1, so that nothing unheard of reaches the network from a real camera.

Photometric cues are on every source pixel, geometric ones on blocks of 4x4: flow is smooth, and the measured one is no
finer. Of the flow that is left between source and reconstruction, what one small motion of the camera and whole
neighbourhoods' depth explain is taken off (``alignment``). Of the rest, only what lies *across* the epipolar line is
independent motion for sure; *along* it, a wrong depth looks the same. Lines and parallax are those of a pinhole camera;
a lens bends them a little.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from viflow_anomaly.alignment import HALF_TEXTURE_GRAY2, AlignedPair
from viflow_anomaly.block_geometry import on_blocks
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.motion_refinement import Line

PHOTOMETRIC_CUES = ("difference", "normalised residual", "half range")
GEOMETRIC_CUES = (
    "remaining flow across",
    "remaining flow along",
    "remaining flow",
    "mismatch after it",
    "texture",
    "parallax",
    "depth correction",
    "inverse depth",
    "inside",
    "predicted flow",
    "local flow across",
    "local flow along",
    "remaining depth",
)
CUES_VERSION = 3
"""Raised when a head that was trained before must not judge them; kept cues are made anew then. Delete them after any
smaller change of their arithmetic."""
HALF_GRAY, HALF_NORMALISED_GRAY, HALF_MISMATCH_GRAY = 16.0, 8.0, 8.0
HALF_LOG_DEPTH, SURE_PARALLAX_PX = 0.5, 0.25
HALF_REMAINING_PX, HALF_PARALLAX_PX, HALF_FLOW_PX = 1.0, 4.0, 16.0
"""Values at which a cue is half of its largest: c = v / (|v| + half)."""


class EvidenceCues(NamedTuple):
    """One pair, all values in -1..1. H' and W' are the image's sides, rounded up to multiples of 32.

    Attributes:
        photometric: [3, H', W'] float32, ``PHOTOMETRIC_CUES``.
        geometric: [13, H' / 4, W' / 4] float32, ``GEOMETRIC_CUES``.
    """

    photometric: Float32Array
    geometric: Float32Array


def evidence_cues(aligned: AlignedPair) -> EvidenceCues:
    """The cues of one pair."""
    explained, geometry, remaining = aligned.explained, aligned.geometry, aligned.remaining
    predicted, view = explained.predicted, explained.model_input.view
    photometric = np.empty((len(PHOTOMETRIC_CUES), *aligned.source.shape), dtype=np.float32)
    difference = np.asarray(cv2.subtract(aligned.rebuilt, aligned.source, dtype=cv2.CV_32F), dtype=np.float32)
    _bound(difference, HALF_GRAY, photometric[0])
    _bound_padded(explained.normalised, HALF_NORMALISED_GRAY, photometric[1], outside=True)
    _bound_padded(explained.half_range, HALF_GRAY, photometric[2])

    geometric = np.empty((len(GEOMETRIC_CUES), *geometry.log_ratio.shape), dtype=np.float32)
    _split_along(remaining.flow_px, geometry.line, geometric[0:2])
    _split_along(remaining.local_flow_px, geometry.line, geometric[10:12])
    _bound(_length(remaining.flow_px), HALF_REMAINING_PX, geometric[2])
    _bound(remaining.mismatch_gray, HALF_MISMATCH_GRAY, geometric[3])
    _bound(remaining.texture_gray2, HALF_TEXTURE_GRAY2, geometric[4])
    _bound(geometry.line.parallax_px, HALF_PARALLAX_PX, geometric[5])
    np.clip(geometry.log_ratio, -1, 1, out=geometric[6])
    np.clip(geometry.log_inverse_depth * np.float32(0.5), -1, 1, out=geometric[7])
    geometric[8] = aligned.inside_share
    _bound(aligned.log_depth + _remaining_log_depth(remaining.flow_px, geometry.line), HALF_LOG_DEPTH, geometric[12])
    flow_px = on_blocks(predicted.flow_px, predicted, view) * np.array(view.step_px, dtype=np.float32)
    _bound(_length(flow_px), HALF_FLOW_PX, geometric[9])
    return EvidenceCues(photometric, geometric)


def _bound(values: Float32Array, half: float, out: Float32Array) -> None:
    """v / (|v| + half), in -1..1."""
    np.abs(values, out=out)
    out += np.float32(half)
    np.divide(values, out, out=out)


def _bound_padded(values: Float32Array, half: float, out: Float32Array, *, outside: bool = False) -> None:
    """``_bound`` of ``block_geometry.padded`` values, without the copy that these would be."""
    height, width = values.shape
    _bound(values, half, out[:height, :width])
    if width < out.shape[1]:
        out[:height, width:] = 0 if outside else out[:height, width - 1 : width]
    if height < out.shape[0]:
        out[height:] = 0 if outside else out[height - 1]


def _length(vectors: Float32Array) -> Float32Array:
    """[h, w] of [h, w, 2]; numpy's norm takes ten times as long."""
    return np.asarray(cv2.magnitude(*cv2.split(vectors)), dtype=np.float32)


def _split_along(flow_px: Float32Array, line: Line, out: Float32Array) -> None:
    """[2, h, w]: how far a flow goes across and along the line, bounded."""
    u, v = flow_px[..., 0], flow_px[..., 1]
    _bound(v * line.x - u * line.y, HALF_REMAINING_PX, out[0])
    _bound(u * line.x + v * line.y, HALF_REMAINING_PX, out[1])


def _remaining_log_depth(flow_px: Float32Array, line: Line) -> Float32Array:
    """[h, w] by how much the inverse depth's logarithm had to grow to explain what remains along the line."""
    along = flow_px[..., 0] * line.x + flow_px[..., 1] * line.y
    return np.asarray(along / (line.parallax_px + np.float32(SURE_PARALLAX_PX)), dtype=np.float32)
