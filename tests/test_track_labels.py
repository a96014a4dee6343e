"""What tracking writes into a detection, and that it can be taken out again."""

from __future__ import annotations

import json
from dataclasses import replace

import jsonschema
import pytest
from moving_boxes import detection, roi

from viflow_anomaly.detection import EvidenceValue, load_detection_schema, to_json
from viflow_anomaly.detection_reading import detection_from_json
from viflow_anomaly.track_labels import TrackLabel, static_flow_px, untracked, with_tracks

FOUND = detection(
    0,
    [
        roi(10, 10, score=0.9),
        roi(200, 10, score=0.8),
        roi(300, 90, score=0.52),
        roi(400, 10, score=0.2, label="model_error"),
    ],
)

SEVEN = TrackLabel(7, (12.345678, -0.001))


def test_numbers_go_to_their_rois_and_nothing_else_changes() -> None:
    tracked = with_tracks(FOUND, {2: SEVEN}, require_persistence=False)
    assert [one.track_id for one in tracked.rois] == [None, 7, None, None]
    told = {"own_velocity_u_px_s": 12.35, "own_velocity_v_px_s": 0.0}
    assert tracked.rois[1] == replace(FOUND.rois[1], track_id=7, evidence=FOUND.rois[1].evidence | told)
    assert [*tracked.rois[:1], *tracked.rois[2:]] == [*FOUND.rois[:1], *FOUND.rois[2:]]


def test_unsupported_motion_becomes_model_error_below_the_supported_and_nothing_is_lost() -> None:
    tracked = with_tracks(FOUND, {2: SEVEN}, require_persistence=True)
    found = [(one.id, one.track_id, one.label, one.score, one.bbox.x) for one in tracked.rois]
    assert found == [
        (1, 7, "independent_motion", 0.8, 200),
        (2, None, "model_error", 0.4, 10),
        (3, None, "model_error", 0.2, 400),
        (4, None, "model_error", 0.02, 300),
    ]
    assert [one.evidence.get("two_frame_score") for one in tracked.rois] == [None, 0.9, None, 0.52]
    jsonschema.validate(json.loads(to_json(tracked)), load_detection_schema())


@pytest.mark.parametrize("persistence", [False, True])
def test_what_was_written_can_be_taken_out_again(persistence: bool) -> None:
    tracked = with_tracks(FOUND, {2: SEVEN, 4: TrackLabel(3, (0.0, 0.0))}, require_persistence=persistence)
    assert untracked(tracked) == FOUND
    assert untracked(detection_from_json(to_json(tracked))) == untracked(detection_from_json(to_json(FOUND)))


def test_an_untracked_detection_stays_itself() -> None:
    assert untracked(FOUND) is FOUND


def test_static_flow_is_read_from_the_evidence() -> None:
    assert static_flow_px(roi(1, 1, static=(3.5, -2))) == (3.5, -2.0)
    assert static_flow_px(roi(1, 1, static=None)) is None


@pytest.mark.parametrize("value", [None, "fast", True])
@pytest.mark.parametrize("name", ["static_flow_u_px", "static_flow_v_px"])
def test_static_flow_that_is_no_number_is_none(name: str, value: EvidenceValue) -> None:
    told = roi(1, 1)
    assert static_flow_px(replace(told, evidence={**told.evidence, name: value})) is None
