"""The answer for one image pair: a value, its JSON (schema_version 1.0) and its JSON Schema.

The same object is the body of a ``/detect`` answer, a line of ``detections.jsonl`` and what ``detect --json`` prints.
The same detection gives the same bytes apart from ``timings_ms``: keys have a fixed order and numbers are rounded.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.regions import BoundingBox, Region, RegionLabel

SCHEMA_VERSION = "1.0"
STAGES = ("decode", "inference", "regions", "total")
SCORE_DECIMALS = 4
GRAY_DECIMALS = 3
PIXEL_DECIMALS = 2
EVIDENCE_DECIMALS = 4
MILLISECOND_DECIMALS = 3
STATIC_FLOW_NAMES = ("static_flow_u_px", "static_flow_v_px")
"""In a ROI's evidence: where the static world at its middle goes until the target frame, in source pixels."""
OWN_VELOCITY_NAMES = ("own_velocity_u_px_s", "own_velocity_v_px_s")
"""In a tracked ROI's evidence: what its track moves beyond the static world, in source pixels a second."""

JsonObject = dict[str, Any]
EvidenceValue = float | int | str | bool | None


@dataclass(frozen=True)
class Reason:
    """Why a pair was not judged, or what lowers trust in the answer."""

    code: str
    message: str


@dataclass(frozen=True)
class ModelInfo:
    """Which weights answered."""

    name: str
    version: str
    sha256: str


@dataclass(frozen=True)
class ImageSize:
    """The source image as it was sent, in pixels."""

    width: int
    height: int


@dataclass(frozen=True)
class AnalyzedRegion:
    """The part of the source image that the model saw, in its pixels."""

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True)
class ResidualSummary:
    """Of the residual map inside the analysed region, in gray levels."""

    mean: float
    median: float
    p95: float


@dataclass(frozen=True)
class MaskRle:
    """A mask as COCO's compressed run lengths, column-major: ``size`` is (height, width) of the image."""

    size: tuple[int, int]
    counts: str


@dataclass(frozen=True)
class Roi:
    """One region of interest; coordinates and lengths in source-image pixels, residuals in gray levels.

    ``id`` counts from 1 within a detection; ``track_id`` names the same thing across pairs, None without tracking.
    """

    id: int
    label: RegionLabel
    score: float
    bbox: BoundingBox
    x_extent_px: float
    y_extent_px: float
    area_px: float
    thickness_px: float
    residual_mean: float
    residual_max: float
    evidence: dict[str, EvidenceValue] = field(default_factory=dict)
    track_id: int | None = None
    mask_rle: MaskRle | None = None


@dataclass(frozen=True)
class Detection:
    """What was found in one image pair.

    Attributes:
        status: ``abstained`` when the pair cannot be judged; ``rois`` is then empty.
        reasons: what lowers trust; of an abstained pair, what forbids to judge it comes first.
        rois: highest score first, ties by y then x.
        residual: None when the pair was given up before a residual existed (only when abstained).
        timings_ms: by stage; ``decode``, ``inference``, ``regions`` and ``total`` are always written (0 when absent).
    """

    source_timestamp_ns: int
    target_timestamp_ns: int
    image: ImageSize
    status: Literal["ok", "abstained"]
    reasons: tuple[Reason, ...]
    model: ModelInfo
    rois: tuple[Roi, ...]
    region_analyzed: AnalyzedRegion
    residual: ResidualSummary | None
    timings_ms: dict[str, float] = field(default_factory=dict)
    schema_version: str = SCHEMA_VERSION

    def __post_init__(self) -> None:
        if self.status == "abstained":
            assert not self.rois, "an abstained detection has no regions"
        else:
            assert self.residual is not None, "a judged pair has a residual"


def rois_from_regions(
    regions: Sequence[Region],
    image: ImageSize,
    *,
    include_masks: bool = False,
    offset: tuple[int, int] = (0, 0),
    target_coordinates: Float32Array | None = None,
    step_px: tuple[float, float] = (1.0, 1.0),
) -> tuple[Roi, ...]:
    """Number the regions from 1 in their order.

    Args:
        regions: of one residual map.
        image: what they lie in.
        include_masks: write each region's mask.
        offset: (x, y) where the residual map begins in the image.
        target_coordinates: [H, W, 2] (u, v) where the static world at each pixel of the map is in the target image; the
            ROIs' evidence then says the static flow at their middle.
        step_px: (x, y) pixels of the regions for one of ``target_coordinates``, which may be of a smaller picture.
    """
    static = [
        {} if target_coordinates is None else _static_flow(region, target_coordinates, step_px) for region in regions
    ]
    return tuple(
        _roi(number, region, image, include_masks, offset, flow)
        for number, (region, flow) in enumerate(zip(regions, static, strict=True), start=1)
    )


def _static_flow(
    region: Region, target_coordinates: Float32Array, step_px: tuple[float, float]
) -> dict[str, EvidenceValue]:
    """At the pixel in the middle of the box; rounded here, so that tracking a value and its JSON is the same."""
    u, v = (int((int(middle) + 0.5) / step) for middle, step in zip(region.bbox.middle_px, step_px, strict=True))
    target = target_coordinates[v, u].tolist()
    return {
        name: round((there - here) * step, PIXEL_DECIMALS) + 0.0 if np.isfinite(there) else None
        for name, there, here, step in zip(STATIC_FLOW_NAMES, target, (u, v), step_px, strict=True)
    }


def _roi(
    number: int,
    region: Region,
    image: ImageSize,
    include_mask: bool,
    offset: tuple[int, int],
    static_flow: dict[str, EvidenceValue],
) -> Roi:
    x, y = region.bbox.x + offset[0], region.bbox.y + offset[1]
    return Roi(
        id=number,
        label=region.label,
        score=region.score,
        bbox=BoundingBox(x, y, region.bbox.width, region.bbox.height),
        x_extent_px=region.x_extent_px,
        y_extent_px=region.y_extent_px,
        area_px=region.area_px,
        thickness_px=region.thickness_px,
        residual_mean=region.residual_mean,
        residual_max=region.residual_max,
        evidence={**region.evidence, **static_flow},
        mask_rle=encode_mask_rle(region.mask, image=image, offset=(x, y)) if include_mask else None,
    )


def to_json_dict(detection: Detection) -> JsonObject:
    """Plain Python values in the contract's order, numbers rounded; ``mask_rle`` only where there is a mask."""
    image, part, model, residual = detection.image, detection.region_analyzed, detection.model, detection.residual
    timings_ms = dict.fromkeys(STAGES, 0.0) | detection.timings_ms
    return {
        "schema_version": detection.schema_version,
        "source_timestamp_ns": detection.source_timestamp_ns,
        "target_timestamp_ns": detection.target_timestamp_ns,
        "image": {"width": image.width, "height": image.height},
        "status": detection.status,
        "reasons": [{"code": reason.code, "message": reason.message} for reason in detection.reasons],
        "model": {"name": model.name, "version": model.version, "sha256": model.sha256},
        "rois": [_roi_json(roi) for roi in detection.rois],
        "region_analyzed": {"x": part.x, "y": part.y, "width": part.width, "height": part.height},
        "residual": residual
        and {
            "mean": _rounded(residual.mean, GRAY_DECIMALS),
            "median": _rounded(residual.median, GRAY_DECIMALS),
            "p95": _rounded(residual.p95, GRAY_DECIMALS),
        },
        "timings_ms": {stage: _rounded(spent, MILLISECOND_DECIMALS) for stage, spent in timings_ms.items()},
    }


def _roi_json(roi: Roi) -> JsonObject:
    values: JsonObject = {
        "id": roi.id,
        "track_id": roi.track_id,
        "label": roi.label,
        "score": _rounded(roi.score, SCORE_DECIMALS),
        "bbox": roi.bbox._asdict(),
        "x_extent_px": _rounded(roi.x_extent_px, PIXEL_DECIMALS),
        "y_extent_px": _rounded(roi.y_extent_px, PIXEL_DECIMALS),
        "area_px": _rounded(roi.area_px, PIXEL_DECIMALS),
        "thickness_px": _rounded(roi.thickness_px, PIXEL_DECIMALS),
        "residual_mean": _rounded(roi.residual_mean, GRAY_DECIMALS),
        "residual_max": _rounded(roi.residual_max, GRAY_DECIMALS),
        "evidence": {
            name: _rounded(value, EVIDENCE_DECIMALS) if isinstance(value, float) else value
            for name, value in roi.evidence.items()
        },
    }
    if roi.mask_rle is not None:
        values["mask_rle"] = {"size": list(roi.mask_rle.size), "counts": roi.mask_rle.counts}
    return values


def _rounded(value: float, decimals: int) -> float:
    """Rounded Python number; a whole number stays an int, and -0.0 becomes 0.0."""
    return value if isinstance(value, int) else round(float(value), decimals) + 0.0


def to_json(detection: Detection) -> str:
    """One compact line of JSON without a newline. Not-a-number cannot be written: ValueError is a bug of ours."""
    return json.dumps(to_json_dict(detection), separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def load_detection_schema() -> JsonObject:
    """The JSON Schema (2020-12) that every detection validates against."""
    text = (files("viflow_anomaly.schemas") / "detection-1.0.schema.json").read_text(encoding="utf-8")
    schema: JsonObject = json.loads(text)
    return schema


def encode_mask_rle(
    mask: NDArray[np.bool_], *, image: ImageSize | None = None, offset: tuple[int, int] = (0, 0)
) -> MaskRle:
    """Column-major run lengths in COCO's compressed string, as pycocotools writes it.

    Args:
        mask: [h, w] bool, a crop of the image.
        image: size of the whole image; None: the mask is the whole image.
        offset: (x, y) of the mask's left-top pixel in the image.
    """
    height, width = mask.shape if image is None else (image.height, image.width)
    columns = np.zeros((mask.shape[1], mask.shape[0] + 2), dtype=np.int8)
    columns[:, 1:-1] = mask.T
    column, row = np.nonzero(np.diff(columns, axis=1))
    changes = (column + offset[0]) * height + row + offset[1]
    # A run that reaches the image's lower edge goes on at the top of the next column: its end and the next start agree.
    positions, repeats = np.unique(changes, return_counts=True)
    borders = np.concatenate([[0], positions[repeats == 1], [height * width]])
    counts = np.diff(borders).tolist()
    if counts[-1] == 0 and len(counts) > 1:
        counts.pop()
    return MaskRle(size=(height, width), counts=_compress(counts))


def _compress(counts: list[int]) -> str:
    """COCO's variant of LEB128: 5 bits a character from '0' on, counts from the fourth as difference to two before."""
    characters = []
    for index, count in enumerate(counts):
        value = count - counts[index - 2] if index > 2 else count
        more = True
        while more:
            bits = value & 0x1F
            value >>= 5
            more = value != (-1 if bits & 0x10 else 0)
            characters.append(chr(48 + (bits | 0x20 if more else bits)))
    return "".join(characters)


def decode_mask_rle(rle: MaskRle) -> NDArray[np.bool_]:
    """[H, W] bool mask of the whole image."""
    counts: list[int] = []
    value, shift = 0, 0
    for character in rle.counts:
        bits = ord(character) - 48
        value |= (bits & 0x1F) << shift
        shift += 5
        if not bits & 0x20:
            if bits & 0x10:
                value -= 1 << shift
            counts.append(value + counts[-2] if len(counts) > 2 else value)
            value, shift = 0, 0
    height, width = rle.size
    ones = np.arange(len(counts)) % 2 == 1
    return np.repeat(ones, counts).reshape(width, height).T
