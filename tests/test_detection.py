"""The answer's JSON: stable bytes, valid against the shipped schema, masks as COCO writes them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from viflow_anomaly.config import RegionConfig
from viflow_anomaly.detection import (
    STATIC_FLOW_NAMES,
    AnalyzedRegion,
    Detection,
    ImageSize,
    MaskRle,
    ModelInfo,
    Reason,
    ResidualSummary,
    Roi,
    decode_mask_rle,
    encode_mask_rle,
    load_detection_schema,
    rois_from_regions,
    to_json,
    to_json_dict,
)
from viflow_anomaly.regions import BoundingBox, find_regions

Json = dict[str, Any]

ROI = Roi(
    id=1,
    label="independent_motion",
    score=0.87654321,
    bbox=BoundingBox(10, 20, 30, 40),
    x_extent_px=30,
    y_extent_px=40,
    area_px=900,
    thickness_px=21.23456,
    residual_mean=33.123456,
    residual_max=88.0,
    evidence={"rule": "extended_in_x_and_y", "contrast": 2.718281828, "tracked": False, "age": 3, "depth": None},
)
DETECTION = Detection(
    source_timestamp_ns=1_403_715_285_262_142_976,
    target_timestamp_ns=1_403_715_285_312_143_104,
    image=ImageSize(width=752, height=480),
    status="ok",
    reasons=(Reason("imu_gap", "The IMU samples have a gap of 31 ms."),),
    model=ModelInfo(name="compact", version="0.1.0", sha256="ab" * 32),
    rois=(ROI,),
    region_analyzed=AnalyzedRegion(0, 0, 752, 480),
    residual=ResidualSummary(mean=4.56789, median=2.0, p95=17.25),
    timings_ms={"inference": 3.14159, "total": 9.5},
)
ABSTAINED = replace(DETECTION, status="abstained", rois=(), residual=None)
VALIDATOR = jsonschema.Draft202012Validator(load_detection_schema())


class TestJson:
    def test_every_field_of_the_contract_in_its_order(self) -> None:
        assert to_json_dict(DETECTION) == {
            "schema_version": "1.0",
            "source_timestamp_ns": 1_403_715_285_262_142_976,
            "target_timestamp_ns": 1_403_715_285_312_143_104,
            "image": {"width": 752, "height": 480},
            "status": "ok",
            "reasons": [{"code": "imu_gap", "message": "The IMU samples have a gap of 31 ms."}],
            "model": {"name": "compact", "version": "0.1.0", "sha256": "ab" * 32},
            "rois": [
                {
                    "id": 1,
                    "track_id": None,
                    "label": "independent_motion",
                    "score": 0.8765,
                    "bbox": {"x": 10, "y": 20, "width": 30, "height": 40},
                    "x_extent_px": 30,
                    "y_extent_px": 40,
                    "area_px": 900,
                    "thickness_px": 21.23,
                    "residual_mean": 33.123,
                    "residual_max": 88.0,
                    "evidence": {
                        "rule": "extended_in_x_and_y",
                        "contrast": 2.7183,
                        "tracked": False,
                        "age": 3,
                        "depth": None,
                    },
                }
            ],
            "region_analyzed": {"x": 0, "y": 0, "width": 752, "height": 480},
            "residual": {"mean": 4.568, "median": 2.0, "p95": 17.25},
            "timings_ms": {"decode": 0.0, "inference": 3.142, "regions": 0.0, "total": 9.5},
        }
        assert list(to_json_dict(DETECTION)) == load_detection_schema()["required"]

    def test_one_compact_line_that_reads_back(self) -> None:
        line = to_json(DETECTION)
        assert "\n" not in line
        assert ": " not in line.replace("The IMU", "")
        assert json.loads(line) == to_json_dict(DETECTION)

    def test_only_the_timings_may_differ(self) -> None:
        slower = replace(DETECTION, timings_ms={"total": 99.0})
        assert to_json(replace(slower, timings_ms={})) == to_json(replace(DETECTION, timings_ms={}))
        assert to_json(slower) != to_json(DETECTION)

    def test_numpy_numbers_and_negative_zero_are_written_plainly(self) -> None:
        residual = ResidualSummary(mean=np.float32(0.1), median=-0.0, p95=np.float64(2.5))  # type: ignore[arg-type]
        assert '"residual":{"mean":0.1,"median":0.0,"p95":2.5}' in to_json(replace(DETECTION, residual=residual))

    @pytest.mark.parametrize("value", [float("nan"), float("inf")])
    def test_what_is_not_a_number_is_never_written(self, value: float) -> None:
        with pytest.raises(ValueError, match="JSON"):
            to_json(replace(DETECTION, residual=ResidualSummary(value, 0.0, 0.0)))

    def test_a_mask_is_written_only_where_there_is_one(self) -> None:
        masked = replace(ROI, mask_rle=MaskRle((480, 752), "234"))
        assert "mask_rle" not in to_json_dict(DETECTION)["rois"][0]
        written = to_json_dict(replace(DETECTION, rois=(masked,)))["rois"][0]
        assert written["mask_rle"] == {"size": [480, 752], "counts": "234"}

    def test_an_abstained_detection_has_no_regions_and_a_judged_one_has_a_residual(self) -> None:
        with pytest.raises(AssertionError):
            replace(DETECTION, status="abstained")
        with pytest.raises(AssertionError):
            replace(DETECTION, residual=None)


class TestSchema:
    @pytest.mark.parametrize(
        "detection",
        [
            DETECTION,
            ABSTAINED,
            replace(ABSTAINED, residual=DETECTION.residual, reasons=()),
            replace(DETECTION, rois=(replace(ROI, track_id=7, mask_rle=encode_mask_rle(np.eye(5, dtype=np.bool_))),)),
        ],
    )
    def test_written_detections_are_valid(self, detection: Detection) -> None:
        VALIDATOR.validate(json.loads(to_json(detection)))

    def test_the_schema_itself_is_valid(self) -> None:
        jsonschema.Draft202012Validator.check_schema(load_detection_schema())

    @pytest.mark.parametrize("name", load_detection_schema()["required"])
    def test_nothing_may_be_missing(self, name: str) -> None:
        values = to_json_dict(DETECTION)
        del values[name]
        assert not VALIDATOR.is_valid(values)

    @pytest.mark.parametrize("name", load_detection_schema()["$defs"]["roi"]["required"])
    def test_nothing_may_be_missing_in_a_roi(self, name: str) -> None:
        values = to_json_dict(DETECTION)
        del values["rois"][0][name]
        assert not VALIDATOR.is_valid(values)

    @pytest.mark.parametrize(
        "spoil",
        [
            lambda v: v.update(extra=1),
            lambda v: v["rois"][0].update(extra=1),
            lambda v: v["image"].update(depth=3),
            lambda v: v["model"].update(author="x"),
            lambda v: v.update(schema_version="2.0"),
            lambda v: v.update(status="maybe"),
            lambda v: v.update(status="abstained"),
            lambda v: v.update(residual=None),
            lambda v: v.update(source_timestamp_ns=1.5),
            lambda v: v.update(source_timestamp_ns=-1),
            lambda v: v.update(source_timestamp_ns=2**63),
            lambda v: v["model"].update(sha256="ABC"),
            lambda v: v["reasons"][0].update(code="Not A Code"),
            lambda v: v["rois"][0].update(id=0),
            lambda v: v["rois"][0].update(label="car"),
            lambda v: v["rois"][0].update(score=1.01),
            lambda v: v["rois"][0].update(track_id="a"),
            lambda v: v["rois"][0]["bbox"].update(x=-1),
            lambda v: v["rois"][0]["bbox"].update(width=0),
            lambda v: v["rois"][0]["bbox"].update(x=1.5),
            lambda v: v["rois"][0].update(residual_max=256),
            lambda v: v["rois"][0]["evidence"].update(nested={}),
            lambda v: v["rois"][0].update(mask_rle={"size": [1, 2, 3], "counts": "1"}),
            lambda v: v["rois"][0].update(mask_rle={"size": [1, 2], "counts": "~"}),
            lambda v: v["timings_ms"].pop("total"),
            lambda v: v["timings_ms"].update(total=-1),
        ],
    )
    def test_contradictions_are_refused(self, spoil: Callable[[Json], object]) -> None:
        values = to_json_dict(DETECTION)
        assert VALIDATOR.is_valid(values)
        spoil(values)
        assert not VALIDATOR.is_valid(values)


class TestRoisFromRegions:
    @staticmethod
    def regions() -> Any:
        residual = np.zeros((80, 120), np.float32)
        residual[10:40, 20:60] = 90
        residual[50:70, 5:30] = 60
        return find_regions(residual, np.ones(residual.shape, np.bool_), RegionConfig(smoothing_fraction=0)).regions

    def test_numbered_in_order_and_moved_by_the_offset(self) -> None:
        rois = rois_from_regions(self.regions(), ImageSize(200, 100), offset=(7, 9))
        assert [roi.id for roi in rois] == [1, 2]
        assert [tuple(roi.bbox) for roi in rois] == [(27, 19, 40, 30), (12, 59, 25, 20)]
        assert all(roi.mask_rle is None and roi.track_id is None for roi in rois)
        assert rois[0].area_px == 1200
        assert rois[0].evidence["rule"] == "extended_in_x_and_y"

    def test_static_flow_is_told_at_the_middle_of_each_box(self) -> None:
        coordinates = np.zeros((80, 120, 2), np.float32)
        coordinates[24, 39] = (42.126, 23.5)  # the middle of the first region; the rest of the map is another story
        coordinates[59, 17] = (np.nan, np.inf)
        first, second = rois_from_regions(
            self.regions(), ImageSize(200, 100), offset=(7, 9), target_coordinates=coordinates
        )
        assert [first.evidence[name] for name in STATIC_FLOW_NAMES] == [3.13, -0.5]
        assert [second.evidence[name] for name in STATIC_FLOW_NAMES] == [None, None]
        untold, _ = rois_from_regions(self.regions(), ImageSize(200, 100))
        assert not set(STATIC_FLOW_NAMES) & untold.evidence.keys()

    def test_masks_cover_the_whole_image(self) -> None:
        first, _ = rois_from_regions(self.regions(), ImageSize(200, 100), include_masks=True, offset=(7, 9))
        assert first.mask_rle is not None
        mask = decode_mask_rle(first.mask_rle)
        expected = np.zeros((100, 200), np.bool_)
        expected[19:49, 27:67] = True
        np.testing.assert_array_equal(mask, expected)


class TestMaskRle:
    @pytest.mark.parametrize(
        ("mask", "counts"),
        [
            (np.zeros((3, 3), np.bool_), "9"),
            (np.ones((3, 3), np.bool_), "09"),
            (np.array([[0, 1, 0], [0, 1, 0], [1, 0, 0]], np.bool_), "234"),
            (np.array([[0, 1, 0], [1, 1, 0], [0, 1, 1]], np.bool_), "11121N"),
            (np.arange(40).reshape(1, 40) >= 16, "`0h0"),
        ],
    )
    def test_known_strings(self, mask: np.ndarray, counts: str) -> None:
        assert encode_mask_rle(mask) == MaskRle(size=mask.shape, counts=counts)

    @given(arrays(np.bool_, array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=70)))
    def test_round_trip(self, mask: np.ndarray) -> None:
        np.testing.assert_array_equal(decode_mask_rle(encode_mask_rle(mask)), mask)

    @given(
        arrays(np.bool_, array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=12)),
        st.tuples(*[st.integers(0, 3)] * 4),
    )
    def test_a_crop_is_written_as_the_whole_image(self, mask: np.ndarray, margins: tuple[int, int, int, int]) -> None:
        left, top, right, bottom = margins
        whole = np.pad(mask, ((top, bottom), (left, right)))
        image = ImageSize(width=whole.shape[1], height=whole.shape[0])
        assert encode_mask_rle(mask, image=image, offset=(left, top)) == encode_mask_rle(whole)

    def test_long_runs(self) -> None:
        mask = np.zeros((2000, 1500), np.bool_)
        mask[:, 700:] = True
        np.testing.assert_array_equal(decode_mask_rle(encode_mask_rle(mask)), mask)
