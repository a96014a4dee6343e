"""From JSON and back is the same text; what is no detection is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest
from test_detection import ABSTAINED, DETECTION, ROI

from viflow_anomaly.detection import Detection, MaskRle, to_json, to_json_dict
from viflow_anomaly.detection_reading import detection_from_json
from viflow_anomaly.errors import InvalidInputError

MASKED = replace(ROI, id=2, track_id=7, mask_rle=MaskRle((480, 752), "234"))


@pytest.mark.parametrize("detection", [DETECTION, ABSTAINED, replace(DETECTION, rois=(ROI, MASKED))])
def test_there_and_back_again(detection: Detection) -> None:
    text = to_json(detection)
    assert to_json(detection_from_json(text)) == text
    assert to_json(detection_from_json(text.encode() + b"\n")) == text


def test_values_are_those_of_the_type() -> None:
    read = detection_from_json(to_json(replace(DETECTION, rois=(MASKED,))))
    assert (read.image, read.reasons, read.region_analyzed) == (
        DETECTION.image,
        DETECTION.reasons,
        DETECTION.region_analyzed,
    )
    (roi,) = read.rois
    assert (roi.bbox, roi.track_id, roi.mask_rle) == (ROI.bbox, 7, MASKED.mask_rle)
    assert roi.bbox.middle_px == (24.5, 39.5)


def without(part: str) -> dict[str, Any]:
    return {name: value for name, value in to_json_dict(DETECTION).items() if name != part}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "7",
        "{}",
        b"\xff\xfe",
        json.dumps(without("rois")),
        json.dumps(to_json_dict(DETECTION) | {"rois": [{"id": 1}]}),
        json.dumps(to_json_dict(DETECTION) | {"rois": [5]}),
        json.dumps(to_json_dict(DETECTION) | {"image": {"width": 3}}),
    ],
)
def test_what_is_no_detection_is_refused(text: str | bytes) -> None:
    with pytest.raises(InvalidInputError, match=r"expected a JSON object of schema_version 1\.0, found") as caught:
        detection_from_json(text)
    assert (caught.value.code, caught.value.field) == ("detection_unreadable", "detection")


def test_another_schema_version_is_refused() -> None:
    text = json.dumps(to_json_dict(DETECTION) | {"schema_version": "9.0"})
    with pytest.raises(InvalidInputError, match=r"expected schema_version 1\.0, found '9\.0'") as caught:
        detection_from_json(text)
    assert caught.value.code == "schema_version_unknown"


@pytest.mark.parametrize("later_ns", [0, -1])
def test_a_target_that_is_not_later_is_refused(later_ns: int) -> None:
    values = to_json_dict(DETECTION)
    values["target_timestamp_ns"] = values["source_timestamp_ns"] + later_ns
    with pytest.raises(InvalidInputError, match="expected a target later than its source") as caught:
        detection_from_json(json.dumps(values))
    assert (caught.value.code, caught.value.field) == ("target_not_later", "target_timestamp_ns")


@pytest.mark.parametrize("side", ["width", "height"])
def test_an_empty_box_is_refused(side: str) -> None:
    values = to_json_dict(DETECTION)
    values["rois"][0]["bbox"][side] = 0
    with pytest.raises(InvalidInputError, match="at least a pixel wide and high, found") as caught:
        detection_from_json(json.dumps(values))
    assert (caught.value.code, caught.value.field) == ("detection_box_empty", "rois.bbox")
