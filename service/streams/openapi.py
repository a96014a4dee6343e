"""What the OpenAPI document says of streams."""

from __future__ import annotations

from typing import Any, Final

from fastapi import FastAPI
from pydantic.json_schema import models_json_schema

from viflow_anomaly_service.examples import (
    EXAMPLE_CAMERA,
    EXAMPLE_DETECTION,
    EXAMPLE_FAULTS,
    INTERVAL_NS,
    SOURCE_NS,
    example_imu,
    example_json_request,
)
from viflow_anomaly_service.openapi_parts import (
    COMPONENTS,
    NANOSECONDS,
    OR_NULL,
    Fault,
    JsonObject,
    answer,
    closed_object,
    extend_openapi,
    problems,
    reference,
    set_examples,
)
from viflow_anomaly_service.paging_openapi import ITEM_ID_SCHEMA, STREAM_ID_SCHEMA
from viflow_anomaly_service.store.openapi import EXAMPLE_ID
from viflow_anomaly_service.streams.schemas import StampedStreamSamples, StreamRequest, StreamSetup

_TEXT: Final[JsonObject] = {"type": "string"}
_COUNT: Final[JsonObject] = {"type": "integer", "minimum": 0}
_NANOSECONDS_OR_NULL: Final[JsonObject] = {"anyOf": [NANOSECONDS, OR_NULL]}
_SESSION: Final[JsonObject] = {
    "type": "string",
    "description": "new whenever a stream begins; track_ids of one session name the same things",
}
_FAULT: Final = closed_object(
    {"code": {"type": "string"}, "message": {"type": "string"}},
    description="What was left out, and why; or a pair that could not be judged",
)
ANSWER_SCHEMA: Final = closed_object(
    {
        "stream_id": STREAM_ID_SCHEMA,
        "session_id": _SESSION,
        "begun": {"type": "boolean", "description": "this call began the stream: nothing of before is remembered"},
        "waiting_frames": {**_COUNT, "description": "frames whose pair waits for IMU samples"},
        "faults": {"type": "array", "items": _FAULT},
        "detection_ids": {
            "anyOf": [{"type": "array", "items": ITEM_ID_SCHEMA}, OR_NULL],
            "description": "under which the detections are stored, in their order; null without a store",
        },
        "detections": {
            "type": "array",
            "items": reference("Detection"),
            "description": "of the pairs that could be judged now, in time order",
        },
    },
    description="What one call came to",
)
STATUS_SCHEMA: Final = closed_object(
    {
        "stream_id": STREAM_ID_SCHEMA,
        "session_id": _SESSION,
        "begun_at_ns": {**NANOSECONDS, "description": "Unix time"},
        "model": closed_object({"name": _TEXT, "version": _TEXT}, description="that judges it"),
        "idle_s": {"type": "number", "minimum": 0},
        "received_frames": _COUNT,
        "received_imu_samples": _COUNT,
        "judged_pairs": _COUNT,
        "faults": {"type": "object", "additionalProperties": _COUNT, "description": "how often, by code"},
        "newest_frame_ns": _NANOSECONDS_OR_NULL,
        "newest_imu_ns": _NANOSECONDS_OR_NULL,
        "kept_frames": _COUNT,
        "kept_imu_samples": _COUNT,
        "state_bytes": _COUNT,
    },
    description="What a stream has received and remembers",
)
LIST_SCHEMA: Final = closed_object(
    {"streams": {"type": "array", "items": reference("StreamStatus")}}, description="All streams, by name"
)
_SESSION_ID: Final = "6b1f0c8ee3a34a0f9d51c1d2f0b7a955"
EXAMPLE_ANSWER: Final[JsonObject] = {
    "stream_id": "drone7",
    "session_id": _SESSION_ID,
    "begun": False,
    "waiting_frames": 0,
    "faults": [],
    "detection_ids": [EXAMPLE_ID],
    "detections": [EXAMPLE_DETECTION],
}
EXAMPLE_STATUS: Final[JsonObject] = {
    "stream_id": "drone7",
    "session_id": _SESSION_ID,
    "begun_at_ns": SOURCE_NS,
    "model": {"name": "default", "version": "2"},
    "idle_s": 0.04,
    "received_frames": 2,
    "received_imu_samples": 41,
    "judged_pairs": 1,
    "faults": {"imu_duplicate": 1},
    "newest_frame_ns": SOURCE_NS + INTERVAL_NS,
    "newest_imu_ns": None,
    "kept_frames": 1,
    "kept_imu_samples": 0,
    "state_bytes": 6144,
}
_IMAGE: Final = {"type": "string", "format": "binary", "description": "PNG or JPEG"}
_FORM_SCHEMA: Final[JsonObject] = {
    "type": "object",
    "properties": {"frame": _IMAGE, "imu": reference("StampedStreamSamples"), "request": reference("StreamSetup")},
    "additionalProperties": False,
}
_ONE_PROCESS: Final[Fault] = (
    "streams_need_one_process",
    "expected a service of one process (VIFLOW_WORKERS=1), found 4: a stream's frames would reach different ones",
    None,
)
_NO_STREAM: Final[Fault] = (
    "stream_not_found",
    "expected a stream that was begun and is not forgotten, found 'drone8'",
    None,
)
_CHANGED: Final[Fault] = (
    "stream_setup_changed",
    "camera: expected none, or the one that the stream was begun with, found another one",
    "camera",
)


def example_call() -> JsonObject:
    """A whole call in JSON that begins a stream and is answered with 200."""
    return {
        "frame": example_json_request()["source"],
        "imu": example_imu(stamped=False),
        "camera": EXAMPLE_CAMERA,
        "options": {"include_masks": False},
    }


def _example_form() -> JsonObject:
    imu = {"frame_timestamp_ns": SOURCE_NS, **example_imu(stamped=False)}
    return {"frame": "(bytes of frame.png)", "imu": imu, "request": {"camera": EXAMPLE_CAMERA}}


def _frames_operation() -> dict[str, Any]:
    json_encoding = {"contentType": "application/json"}
    form = {
        "schema": _FORM_SCHEMA,
        "encoding": {"frame": {"contentType": "image/png, image/jpeg"}, "imu": json_encoding, "request": json_encoding},
        "example": _example_form(),
    }
    whole = {"schema": reference("StreamRequest"), "example": example_call()}
    content = {"multipart/form-data": form, "application/json": whole}
    faults = {**EXAMPLE_FAULTS, 409: _CHANGED, 501: _ONE_PROCESS}
    return {
        "responses": {
            200: answer("Detections and faults", reference("StreamAnswer"), EXAMPLE_ANSWER),
            **problems(dict(sorted(faults.items()))),
        },
        "openapi_extra": {"requestBody": {"required": True, "content": content}},
    }


_GET_FAULTS: Final = {404: _NO_STREAM, 500: EXAMPLE_FAULTS[500], 501: _ONE_PROCESS}
FRAMES_OPERATION: Final = _frames_operation()
LIST_OPERATION: Final[dict[str, Any]] = {
    "responses": {
        200: answer("The streams", reference("StreamList"), {"streams": [EXAMPLE_STATUS]}),
        **problems({500: EXAMPLE_FAULTS[500], 501: _ONE_PROCESS}),
    }
}
STATUS_OPERATION: Final[dict[str, Any]] = {
    "responses": {200: answer("The stream", reference("StreamStatus"), EXAMPLE_STATUS), **problems(_GET_FAULTS)}
}
DELETE_OPERATION: Final[dict[str, Any]] = {"responses": {204: {"description": "Forgotten"}, **problems(_GET_FAULTS)}}


def add_streams_openapi(app: FastAPI) -> None:
    """The components, the examples whole, and the name's pattern."""

    def change(document: JsonObject) -> None:
        shapes = [(shape, "validation") for shape in (StreamRequest, StampedStreamSamples, StreamSetup)]
        _, requests = models_json_schema(shapes, ref_template=COMPONENTS + "{model}")  # type: ignore[arg-type]
        document["components"]["schemas"] |= {
            **requests["$defs"],
            "StreamAnswer": ANSWER_SCHEMA,
            "StreamStatus": STATUS_SCHEMA,
            "StreamList": LIST_SCHEMA,
        }
        paths = document["paths"]
        set_examples(
            paths,
            ("/streams", "get", {"streams": [EXAMPLE_STATUS]}),
            ("/streams/{stream_id}", "get", EXAMPLE_STATUS),
            ("/streams/{stream_id}/frames", "post", EXAMPLE_ANSWER),
        )
        for path in ("/streams/{stream_id}", "/streams/{stream_id}/frames"):
            for operation in paths[path].values():
                (name,) = operation["parameters"]
                name["schema"] = STREAM_ID_SCHEMA

    extend_openapi(app, change)
