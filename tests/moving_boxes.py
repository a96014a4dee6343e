"""Detections without pictures: boxes that move over a world that moves, for tests of tracking."""

from __future__ import annotations

from collections.abc import Sequence

from viflow_anomaly.detection import (
    STATIC_FLOW_NAMES,
    AnalyzedRegion,
    Detection,
    EvidenceValue,
    ImageSize,
    ModelInfo,
    ResidualSummary,
    Roi,
)
from viflow_anomaly.regions import BoundingBox, RegionLabel

FRAME_NS = 50_000_000
START_NS = 1_500_000_000_000_000_000
IMAGE = ImageSize(640, 480)


def roi(
    x: float,
    y: float,
    width: int = 30,
    height: int = 40,
    *,
    score: float = 0.7,
    label: RegionLabel = "independent_motion",
    static: tuple[float, float] | None = (0.0, 0.0),
    number: int = 1,
) -> Roi:
    """A region; ``static`` is the flow of the static world in its middle."""
    evidence: dict[str, EvidenceValue] = {"rule": "extended_in_x_and_y"}
    if static is not None:
        evidence |= dict(zip(STATIC_FLOW_NAMES, static, strict=True))
    box = BoundingBox(round(x), round(y), width, height)
    return Roi(number, label, score, box, width, height, width * height, 20.0, 30.0, 60.0, evidence)


def detection(
    frame: float, rois: Sequence[Roi] = (), *, abstained: bool = False, ahead: int = 1, image: ImageSize = IMAGE
) -> Detection:
    """Of the pair (frame, frame + ahead); regions are put in the answer's order and numbered."""
    ordered = sorted(rois, key=lambda one: (-one.score, one.bbox.y, one.bbox.x))
    numbered = tuple(Roi(**{**vars(one), "id": number}) for number, one in enumerate(ordered, start=1))
    source_ns = START_NS + round(frame * FRAME_NS)
    return Detection(
        source_timestamp_ns=source_ns,
        target_timestamp_ns=source_ns + ahead * FRAME_NS,
        image=image,
        status="abstained" if abstained else "ok",
        reasons=(),
        model=ModelInfo("boxes", "1", "ab" * 32),
        rois=numbered,
        region_analyzed=AnalyzedRegion(0, 0, image.width, image.height),
        residual=ResidualSummary(3.0, 2.0, 9.0),
    )
