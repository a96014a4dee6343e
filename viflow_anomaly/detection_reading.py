"""A detection from its JSON: the way back from ``detection.to_json``."""

from __future__ import annotations

import json

from viflow_anomaly.detection import (
    SCHEMA_VERSION,
    AnalyzedRegion,
    Detection,
    ImageSize,
    JsonObject,
    MaskRle,
    ModelInfo,
    Reason,
    ResidualSummary,
    Roi,
)
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.regions import BoundingBox


def detection_from_json(text: str | bytes) -> Detection:
    """Read one line of ``detections.jsonl`` or the body of a ``/detect`` answer.

    ``to_json`` of the result is the same text; the JSON Schema says what it may hold, and is not checked here.

    Raises:
        InvalidInputError: ``detection_unreadable``: no JSON object, or a part is missing; ``schema_version_unknown``;
            ``target_not_later``, ``detection_box_empty``: numbers that contradict themselves.
    """
    try:
        values = json.loads(text)
        version = values["schema_version"]
        found = _detection(values) if version == SCHEMA_VERSION else None
    except (ValueError, KeyError, TypeError, AttributeError) as err:
        raise InvalidInputError(
            f"detection: expected a JSON object of schema_version {SCHEMA_VERSION}, "
            f"found a text of {len(text)} characters with a fault: {type(err).__name__}: {err}",
            code="detection_unreadable",
            field="detection",
        ) from err
    if found is None:
        raise InvalidInputError(
            f"detection: expected schema_version {SCHEMA_VERSION}, found {version!r:.40}",
            code="schema_version_unknown",
            field="schema_version",
        )
    _refuse_contradictions(found)
    return found


def _refuse_contradictions(detection: Detection) -> None:
    """What the schema cannot say, or what arithmetic would stumble over."""
    source_ns, target_ns = detection.source_timestamp_ns, detection.target_timestamp_ns
    if target_ns <= source_ns:
        raise InvalidInputError(
            f"detection: expected a target later than its source at {source_ns} ns, found {target_ns} ns",
            code="target_not_later",
            field="target_timestamp_ns",
        )
    for roi in detection.rois:
        if roi.bbox.width < 1 or roi.bbox.height < 1:
            raise InvalidInputError(
                f"detection: expected boxes at least a pixel wide and high, found {roi.bbox.width}x{roi.bbox.height} "
                f"in the region {roi.id}",
                code="detection_box_empty",
                field="rois.bbox",
            )


def _detection(values: JsonObject) -> Detection:
    return Detection(
        source_timestamp_ns=values["source_timestamp_ns"],
        target_timestamp_ns=values["target_timestamp_ns"],
        image=ImageSize(**values["image"]),
        status=values["status"],
        reasons=tuple(Reason(**reason) for reason in values["reasons"]),
        model=ModelInfo(**values["model"]),
        rois=tuple(_roi(roi) for roi in values["rois"]),
        region_analyzed=AnalyzedRegion(**values["region_analyzed"]),
        residual=None if values["residual"] is None else ResidualSummary(**values["residual"]),
        timings_ms=dict(values["timings_ms"]),
    )


def _roi(values: JsonObject) -> Roi:
    mask = values.get("mask_rle")
    plain = {name: value for name, value in values.items() if name not in ("bbox", "mask_rle")}
    return Roi(
        **plain,
        bbox=BoundingBox(**values["bbox"]),
        mask_rle=None if mask is None else MaskRle(size=tuple(mask["size"]), counts=mask["counts"]),
    )
