"""What the OpenAPI document says of looking on."""

from __future__ import annotations

from typing import Any, Final

from fastapi import FastAPI, Response
from pydantic.json_schema import models_json_schema

from viflow_anomaly_service.examples import EXAMPLE_DETECTION, EXAMPLE_FAULTS, SOURCE_NS
from viflow_anomaly_service.live.inspection_work import InspectRequest
from viflow_anomaly_service.live.pictures import PICTURES
from viflow_anomaly_service.openapi import detect_operation
from viflow_anomaly_service.openapi_parts import (
    COMPONENTS,
    NANOSECONDS,
    OR_NULL,
    Fault,
    JsonObject,
    answer,
    closed_object,
    extend_openapi,
    parameter,
    problems,
    reference,
    set_examples,
)

_COUNT: Final[JsonObject] = {"type": "integer", "minimum": 0}
_TEXT: Final[JsonObject] = {"type": "string"}
_NUMBER: Final[JsonObject] = {"type": "number"}
_NUMBER_OR_NULL: Final[JsonObject] = {"anyOf": [_NUMBER, OR_NULL]}
_PAIR_NUMBER: Final[JsonObject] = {
    "type": "integer",
    "minimum": 0,
    "description": "grows from pair to pair over all streams",
}
_SIGNS: Final = closed_object(
    dict.fromkeys(("imu_rate_hz", "imu_largest_gap_ms", "inlier_share", "turn_error_rad_s"), _NUMBER_OR_NULL),
    description="What the pair shows of its IMU, and how far the corrected rotation is from the gyro's",
)
PAIR_SCHEMA: Final = closed_object(
    {
        "number": _PAIR_NUMBER,
        "stream_id": _TEXT,
        "session_id": _TEXT,
        "received_at_ns": {**NANOSECONDS, "description": "Unix time"},
        "detection_id": {"anyOf": [_TEXT, OR_NULL], "description": "under which it is stored"},
        "rig": {"anyOf": [{"type": "object"}, OR_NULL], "description": "the stream's estimate, as in run.json"},
        "signs": reference("PairSigns"),
        "detection": reference("Detection"),
    },
    description="A pair that was judged a moment ago",
)
STREAM_SCHEMA: Final = closed_object(
    {
        "stream_id": _TEXT,
        "session_id": _TEXT,
        "active": {"type": "boolean", "description": "the stream is not forgotten yet"},
        "newest_number": _PAIR_NUMBER,
        "newest_at_ns": NANOSECONDS,
        "remembered_pairs": _COUNT,
        "judged_pairs": _COUNT,
        "abstained_pairs": _COUNT,
        "footage_s": {**_NUMBER, "description": "of the judged pairs"},
        "alarms": {**_COUNT, "description": "regions labelled as motion, counted for each pair"},
        "alarms_per_hour": {**_NUMBER_OR_NULL, "description": "of judged footage, as `calibrate` counts"},
        "faults": {"type": "object", "additionalProperties": _COUNT},
    },
    description="A stream of which pairs are remembered",
)
LIVE_SCHEMA: Final = closed_object(
    {"newest_number": _PAIR_NUMBER, "streams": {"type": "array", "items": reference("RememberedStream")}}
)
_INSPECTED: Final[JsonObject] = {
    "detection": reference("Detection"),
    "signs": reference("PairSigns"),
    "hypotheses": closed_object(
        {
            "errors": {
                "type": "array",
                "items": _NUMBER_OR_NULL,
                "description": "of the rebuilt source, in standard deviations of its brightness; smaller is better",
            },
            "winner": {**_COUNT, "description": "index of the chosen one"},
            "corrected_error": {**_NUMBER_OR_NULL, "description": "of the flow after the correction"},
        }
    ),
    "flow_arrows": {
        "type": "array",
        "description": "x, y and the static world's flow there, in source pixels",
        "items": {"type": "array", "items": _NUMBER, "minItems": 4, "maxItems": 4},
    },
    "changed": {
        "type": "array",
        "items": closed_object({"name": _TEXT, "before": {}, "after": {}}),
        "description": "settings that differ from those the pair was judged under",
    },
    "configuration": closed_object(
        {"toml": _TEXT, "environment": _TEXT}, description="the changed settings, to copy into a file or a shell"
    ),
}
TUNED_SCHEMA: Final = closed_object(_INSPECTED, optional=("hypotheses", "flow_arrows"))
INSPECTED_SCHEMA: Final = closed_object({"stream_id": _TEXT, "number": _PAIR_NUMBER, **_INSPECTED})
DETECTOR_SCHEMA: Final = closed_object(
    {
        "model": {"type": "object"},
        "configuration": {"type": "object", "description": "DetectorConfig"},
        "region_settings": {"type": "object", "description": "JSON Schema of each setting of detector.regions"},
        "calibration": {"anyOf": [{"type": "object"}, OR_NULL], "description": "of `viflow-anomaly calibrate`"},
        "cards": {"type": "array", "items": closed_object({"name": _TEXT, "markdown": _TEXT})},
    }
)

_EXAMPLE_NUMBER: Final = 1_700_000_000_017
EXAMPLE_SIGNS: Final = {"imu_rate_hz": 200.0, "imu_largest_gap_ms": 5.0, "inlier_share": 0.83, "turn_error_rad_s": 0.01}
EXAMPLE_PAIR: Final[JsonObject] = {
    "number": _EXAMPLE_NUMBER,
    "stream_id": "drone7",
    "session_id": "6b1f0c8ee3a34a0f9d51c1d2f0b7a955",
    "received_at_ns": SOURCE_NS,
    "detection_id": None,
    "rig": None,
    "signs": EXAMPLE_SIGNS,
    "detection": EXAMPLE_DETECTION,
}
EXAMPLE_LIVE: Final[JsonObject] = {
    "newest_number": _EXAMPLE_NUMBER,
    "streams": [
        {
            "stream_id": "drone7",
            "session_id": "6b1f0c8ee3a34a0f9d51c1d2f0b7a955",
            "active": True,
            "newest_number": _EXAMPLE_NUMBER,
            "newest_at_ns": SOURCE_NS,
            "remembered_pairs": 60,
            "judged_pairs": 7200,
            "abstained_pairs": 2,
            "footage_s": 360.0,
            "alarms": 3,
            "alarms_per_hour": 30.0,
            "faults": {},
        }
    ],
}
_CHANGED: Final = {"name": "detector.regions.motion_score", "before": 0.5, "after": 0.7}
EXAMPLE_TUNED: Final[JsonObject] = {
    "detection": EXAMPLE_DETECTION,
    "signs": EXAMPLE_SIGNS,
    "hypotheses": {"errors": [0.21, 0.18], "winner": 1, "corrected_error": 0.12},
    "flow_arrows": [[8, 8, 1.5, -0.25]],
    "changed": [_CHANGED],
    "configuration": {
        "toml": "[detector.regions]\nmotion_score = 0.7\n",
        "environment": "VIFLOW_DETECTOR__REGIONS__MOTION_SCORE=0.7\n",
    },
}
EXAMPLE_INSPECTED: Final[JsonObject] = {"stream_id": "~uploads", "number": _EXAMPLE_NUMBER, **EXAMPLE_TUNED}
EXAMPLE_DETECTOR: Final[JsonObject] = {
    "model": EXAMPLE_DETECTION["model"],
    "configuration": {"regions": {"motion_score": 0.5}},
    "region_settings": {"motion_score": {"type": "number", "minimum": 0.5, "maximum": 1.01}},
    "calibration": None,
    "cards": [{"name": "viflow-calibrated", "markdown": "# Model card"}],
}

_OFF: Final[Fault] = ("live_off", "expected a service that remembers pairs, found VIFLOW_LIVE_PAIRS=0", None)
_NO_STREAM: Final[Fault] = ("stream_not_found", "expected a stream of which pairs are remembered, found 'd8'", None)
_NO_PAIR: Final[Fault] = ("pair_not_found", "expected the number of a pair that is still remembered, found '7'", None)
_WRONG: Final[Fault] = ("parameter_invalid", "after: expected the number of a pair, found 'x'", "after")
_FULL: Final[Fault] = ("live_full", "expected at most 64 followers at once, found one more", None)
_INTERNAL: Final = EXAMPLE_FAULTS[500]
_BUSY: Final = EXAMPLE_FAULTS[503]
_AFTER: Final = parameter("after", _PAIR_NUMBER, "the number last seen; also as header Last-Event-ID")
_EVENTS: Final[JsonObject] = {
    "description": "Events `pair`, whose id is the pair's number and whose data is a RememberedPair; comments between",
    "content": {"text/event-stream": {"schema": _TEXT}},
}
_EVENT_FAULTS: Final = {422: _WRONG, 500: _INTERNAL, 501: _OFF, 503: _FULL}
_PICTURE: Final[JsonObject] = {
    "description": "The picture",
    "content": {kind: {"schema": {"type": "string", "format": "binary"}} for kind in ("image/png", "image/jpeg")},
}

LIVE_OPERATION: Final[dict[str, Any]] = {
    "responses": {
        200: answer("The streams", reference("LiveOverview"), EXAMPLE_LIVE),
        **problems({500: _INTERNAL, 501: _OFF}),
    }
}
EVENTS_OPERATION: Final[dict[str, Any]] = {
    "responses": {200: _EVENTS, **problems(_EVENT_FAULTS)},
    "openapi_extra": {"parameters": [_AFTER]},
    "response_class": Response,
}
STREAM_EVENTS_OPERATION: Final = EVENTS_OPERATION
PAIRS_OPERATION: Final[dict[str, Any]] = {
    "responses": {
        200: answer(
            "The pairs", closed_object({"pairs": {"type": "array", "items": reference("RememberedPair")}}), None
        ),
        **problems({404: _NO_STREAM, 500: _INTERNAL, 501: _OFF}),
    }
}
PICTURE_OPERATION: Final[dict[str, Any]] = {
    "responses": {200: _PICTURE, **problems({404: _NO_PAIR, 500: _INTERNAL, 501: _OFF, 503: _BUSY})}
}
TUNE_OPERATION: Final[dict[str, Any]] = {
    "responses": {
        200: answer("Judged anew", reference("TunedPair"), EXAMPLE_TUNED),
        **problems({**EXAMPLE_FAULTS, 404: _NO_PAIR, 501: _OFF}),
    },
    "openapi_extra": {
        "requestBody": {
            "required": False,
            "content": {
                "application/json": {
                    "schema": reference("InspectRequest"),
                    "example": {"options": {"regions": {"motion_score": 0.7}}, "view": True},
                }
            },
        }
    },
}
INSPECT_OPERATION: Final[dict[str, Any]] = {
    "responses": {
        200: answer("Looked at", reference("InspectedPair"), EXAMPLE_INSPECTED),
        **problems({**EXAMPLE_FAULTS, 501: _OFF}),
    },
    "openapi_extra": detect_operation()["openapi_extra"],
}
DETECTOR_OPERATION: Final[dict[str, Any]] = {
    "responses": {
        200: answer("The detector", reference("DetectorDescription"), EXAMPLE_DETECTOR),
        **problems({500: _INTERNAL, 503: _BUSY}),
    }
}


def add_live_openapi(app: FastAPI) -> None:
    """The components, the examples whole, and the names in the paths."""

    def change(document: JsonObject) -> None:
        _, requests = models_json_schema([(InspectRequest, "validation")], ref_template=COMPONENTS + "{model}")
        document["components"]["schemas"] |= {
            **requests["$defs"],
            "PairSigns": _SIGNS,
            "RememberedPair": PAIR_SCHEMA,
            "RememberedStream": STREAM_SCHEMA,
            "LiveOverview": LIVE_SCHEMA,
            "TunedPair": TUNED_SCHEMA,
            "InspectedPair": INSPECTED_SCHEMA,
            "DetectorDescription": DETECTOR_SCHEMA,
        }
        paths = document["paths"]
        set_examples(
            paths,
            ("/streams/{stream_id}/pairs/{number}/inspect", "post", EXAMPLE_TUNED),
            ("/inspect", "post", EXAMPLE_INSPECTED),
            ("/detector", "get", EXAMPLE_DETECTOR),
        )
        for one in paths["/streams/{stream_id}/pairs/{number}/{picture}"]["get"]["parameters"]:
            if one["name"] == "picture":
                one["schema"] = {"enum": [f"{name}.{suffix}" for name in PICTURES for suffix in ("png", "jpg")]}

    extend_openapi(app, change)
