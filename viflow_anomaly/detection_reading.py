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
        InvalidInputError: ``detection_unreadable``: no JSON object, or a part is missing; ``schema_version_unknown``.
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
    return found


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
