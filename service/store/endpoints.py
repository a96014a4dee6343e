"""``GET /detections``, ``GET /detections.ndjson``, ``GET /detections/{id}`` and its thumbnail."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fastapi import FastAPI, Request, Response
from fastapi.responses import StreamingResponse

from viflow_anomaly_service.paging import Page
from viflow_anomaly_service.paging_openapi import NDJSON_MEDIA_TYPE
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.service_core import ServiceCore
from viflow_anomaly_service.store.openapi import (
    EXPORT_OPERATION,
    GET_OPERATION,
    PAGE_OPERATION,
    THUMBNAIL_OPERATION,
    add_store_openapi,
)
from viflow_anomaly_service.store.query import (
    detection_not_found,
    read_filter,
    read_page,
    require_detection_id,
    thumbnail_not_found,
)
from viflow_anomaly_service.thumbnails import THUMBNAIL_MEDIA_TYPE

if TYPE_CHECKING:
    from viflow_anomaly_service.store.keeper import ResultKeeper

EXPORT_ROWS: Final = 200
KEPT_BY_BROWSERS: Final = "private, max-age=31536000, immutable"
"""A thumbnail never changes, and belongs to whoever had a key for it."""


def add_detections(app: FastAPI, core: ServiceCore) -> None:
    """Add the endpoints; without a store they answer 501."""

    def require_keeper() -> ResultKeeper:
        if core.keeper is None:
            raise Problem(501, code="store_not_configured", detail="expected a store (VIFLOW_STORE_URL), found none")
        return core.keeper

    @app.get("/detections", operation_id="listDetections", tags=["detections"], **PAGE_OPERATION)
    async def list_detections(request: Request) -> Response:
        """Stored detections, newest first, a page at a time."""
        keeper, page = require_keeper(), read_page(request.query_params.multi_items())
        found, cursor = await keeper.page(page)
        listed = ",".join(one.to_json() for one in found)
        quoted = "null" if cursor is None else f'"{cursor}"'
        return Response(f'{{"detections":[{listed}],"next_cursor":{quoted}}}', media_type="application/json")

    @app.get("/detections.ndjson", operation_id="exportDetections", tags=["detections"], **EXPORT_OPERATION)
    async def export_detections(request: Request) -> Response:
        """All stored detections that pass the filters, one JSON object a line."""
        keeper, chosen = require_keeper(), read_filter(request.query_params.multi_items())
        first, _ = await keeper.page(Page(chosen, EXPORT_ROWS))
        return StreamingResponse(keeper.export(chosen, first, rows=EXPORT_ROWS), media_type=NDJSON_MEDIA_TYPE)

    @app.get("/detections/{detection_id}", operation_id="getDetection", tags=["detections"], **GET_OPERATION)
    async def get_detection(detection_id: str) -> Response:
        """One stored detection."""
        keeper = require_keeper()
        found = await keeper.get(require_detection_id(detection_id))
        if found is None:
            raise detection_not_found(detection_id)
        return Response(found.to_json(), media_type="application/json")

    @app.get(
        "/detections/{detection_id}/thumbnail",
        operation_id="getThumbnail",
        tags=["detections"],
        response_class=Response,
        **THUMBNAIL_OPERATION,
    )
    async def get_thumbnail(request: Request, detection_id: str) -> Response:
        """A small picture of one stored detection: the source image with its regions."""
        keeper = require_keeper()
        image = await keeper.thumbnail(require_detection_id(detection_id))
        if image is None:
            raise thumbnail_not_found(detection_id)
        headers = {"ETag": f'"{detection_id}"', "Cache-Control": KEPT_BY_BROWSERS}
        if request.headers.get("if-none-match") == headers["ETag"]:
            return Response(status_code=304, headers=headers)
        return Response(image, media_type=THUMBNAIL_MEDIA_TYPE, headers=headers)

    add_store_openapi(app)
