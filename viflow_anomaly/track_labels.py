"""How tracking reads a detection and writes into it; what it writes can be taken out again.

A ROI's evidence says where the static world at its centre goes (``static_flow_u_px``, ``static_flow_v_px``: source
pixels from the source to the target frame). A ROI that a confirmed track takes gets the track's number and, in its
evidence, its own velocity (``own_velocity_u_px_s``, ``own_velocity_v_px_s``).

Where persistence is required, a ROI of independent motion that no confirmed track supports becomes ``model_error``, its
score sinks by 0.5, and ``two_frame_score`` in its evidence keeps what two frames alone said.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

from viflow_anomaly.detection import (
    OWN_VELOCITY_NAMES,
    PIXEL_DECIMALS,
    SCORE_DECIMALS,
    STATIC_FLOW_NAMES,
    Detection,
    EvidenceValue,
    Roi,
)

TWO_FRAME_SCORE = "two_frame_score"
MOTION_SCORE = 0.5
"""Scores of independent motion begin here, those of model error end here."""


def static_flow_px(roi: Roi) -> tuple[float, float] | None:
    """(du, dv) of the static world at the ROI's centre; None where the detection does not say."""
    u, v = (_number(roi.evidence.get(name)) for name in STATIC_FLOW_NAMES)
    return None if u is None or v is None else (u, v)


class TrackLabel(NamedTuple):
    """What a ROI is told of its confirmed track: its number, and its own velocity (u, v) in px/s."""

    track_id: int
    own_velocity_px_s: tuple[float, float]


def with_tracks(detection: Detection, labels: Mapping[int, TrackLabel], *, require_persistence: bool) -> Detection:
    """The detection with what is known of its tracks.

    Args:
        detection: an untracked one.
        labels: ROI id -> its confirmed track.
        require_persistence: whether independent motion without a number becomes model error; ROIs are then put in
            order and numbered anew.
    """
    rois = [_labelled(roi, labels[roi.id]) if roi.id in labels else roi for roi in detection.rois]
    if not require_persistence:
        return replace(detection, rois=tuple(rois))
    return replace(detection, rois=_in_order(map(_demoted, rois)))


def untracked(detection: Detection) -> Detection:
    """The detection as it was before any tracking."""
    if not any(roi.track_id is not None or TWO_FRAME_SCORE in roi.evidence for roi in detection.rois):
        return detection
    return replace(detection, rois=_in_order(map(_restored, detection.rois)))


def _labelled(roi: Roi, label: TrackLabel) -> Roi:
    velocity = (round(value, PIXEL_DECIMALS) + 0.0 for value in label.own_velocity_px_s)
    evidence = {**roi.evidence, **dict(zip(OWN_VELOCITY_NAMES, velocity, strict=True))}
    return replace(roi, track_id=label.track_id, evidence=evidence)


def _demoted(roi: Roi) -> Roi:
    if roi.track_id is not None or roi.label != "independent_motion":
        return roi
    score = round(roi.score - MOTION_SCORE, SCORE_DECIMALS)
    return replace(roi, label="model_error", score=score, evidence={**roi.evidence, TWO_FRAME_SCORE: roi.score})


def _restored(roi: Roi) -> Roi:
    written = (TWO_FRAME_SCORE, *OWN_VELOCITY_NAMES)
    evidence = {name: value for name, value in roi.evidence.items() if name not in written}
    score = _number(roi.evidence.get(TWO_FRAME_SCORE))
    if score is None:
        return replace(roi, evidence=evidence, track_id=None)
    return replace(roi, label="independent_motion", score=score, evidence=evidence, track_id=None)


def _number(value: EvidenceValue) -> float | None:
    """JSON's true and false are no numbers."""
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None


def _in_order(rois: Iterable[Roi]) -> tuple[Roi, ...]:
    """Highest score first, ties by y then x, numbered from 1."""
    ordered = sorted(rois, key=lambda roi: (-roi.score, roi.bbox.y, roi.bbox.x))
    return tuple(replace(roi, id=number) for number, roi in enumerate(ordered, start=1))
