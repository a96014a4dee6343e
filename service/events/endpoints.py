"""``/events``: what happened, what happens, and who has been told of it."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse, StreamingResponse

from viflow_anomaly_service.events.openapi import (
    DELIVERIES_OPERATION,
    EVENT_EXPORT_OPERATION,
    EVENT_PAGE_OPERATION,
    LIVE_OPERATION,
    RETRY_OPERATION,
    add_events_openapi,
)
from viflow_anomaly_service.events.query import (
    delivery_not_found,
    read_delivery_page,
    read_event_filter,
    read_event_page,
    read_last_event_id,
    read_live_stream,
    require_delivery_id,
)
from viflow_anomaly_service.live_response import LiveResponse
from viflow_anomaly_service.paging import Page, cursor_of
from viflow_anomaly_service.paging_openapi import NDJSON_MEDIA_TYPE
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.service_core import ServiceCore
from viflow_anomaly_service.store.record import stored_at_ns

if TYPE_CHECKING:
    from viflow_anomaly_service.events.attach import StoredEvents
    from viflow_anomaly_service.events.delivery_store import Delivery
    from viflow_anomaly_service.events.log import LoggedEvent
    from viflow_anomaly_service.events.query import EventFilter
    from viflow_anomaly_service.store.keeper import ResultKeeper

EXPORT_ROWS: Final = 500


def add_events(app: FastAPI, core: ServiceCore) -> None:
    """Add the endpoints; without a store all but ``/events/live`` answer 501."""

    @app.get("/events", operation_id="listEvents", tags=["events"], **EVENT_PAGE_OPERATION)
    async def list_events(request: Request) -> Response:
        """Events, newest first, a page at a time."""
        _require_stored(core)
        page = read_event_page(request.query_params.multi_items())
        found, more = await _page(core, page)
        cursor = json.dumps(cursor_of(page.filter, found[-1].event.event_id) if more else None)
        listed = ",".join(one.event.body for one in found)
        return Response(f'{{"events":[{listed}],"next_cursor":{cursor}}}', media_type="application/json")

    @app.get("/events.ndjson", operation_id="exportEvents", tags=["events"], **EVENT_EXPORT_OPERATION)
    async def export_events(request: Request) -> Response:
        """All events that pass the filters, one JSON object a line."""
        _require_stored(core)
        page = Page(read_event_filter(request.query_params.multi_items()), EXPORT_ROWS)
        return StreamingResponse(_export(core, page, await _page(core, page)), media_type=NDJSON_MEDIA_TYPE)

    @app.get(
        "/events/live", operation_id="liveEvents", tags=["events"], response_class=StreamingResponse, **LIVE_OPERATION
    )
    async def live_events(request: Request) -> Response:
        """Events as they come, as Server-Sent Events."""
        stream_id = read_live_stream(request.query_params.multi_items())
        last_event_id = read_last_event_id(request.headers.get("last-event-id"))
        if core.keeper is None and core.settings.workers > 1:
            detail = f"expected a store or one process (VIFLOW_WORKERS=1), found {core.settings.workers}"
            raise Problem(501, code="streams_need_one_process", detail=detail)
        place = await core.events.readers.begin(last_event_id)
        readers = core.events.readers
        return LiveResponse(readers.read(place, stream_id), leave=readers.leave)

    _add_deliveries(app, core)
    add_events_openapi(app)


def _add_deliveries(app: FastAPI, core: ServiceCore) -> None:
    @app.get("/events/deliveries", operation_id="listDeliveries", tags=["events"], **DELIVERIES_OPERATION)
    async def list_deliveries(request: Request) -> JSONResponse:
        """What waits for webhooks and MQTT, was delivered or given up; the oldest event first."""
        keeper, stored = _require_stored(core)
        page = read_delivery_page(request.query_params.multi_items())
        after = 0
        if page.after is not None:
            after = (await stored.log.place_of(page.after)).seq
        found, more = await keeper.read(partial(stored.deliveries.page, page.filter.state, page.limit, after))
        cursor = cursor_of(page.filter, found[-1].event.event_id) if more else None
        return JSONResponse({"deliveries": [_shown(one) for one in found], "next_cursor": cursor})

    @app.post(
        "/events/deliveries/{delivery_id}/retry", operation_id="retryDelivery", tags=["events"], **RETRY_OPERATION
    )
    async def retry_delivery(delivery_id: str) -> JSONResponse:
        """Send a dead letter again."""
        keeper, stored = _require_stored(core)
        event_id, sink = require_delivery_id(delivery_id)
        found = await keeper.read(partial(stored.deliveries.get, event_id, sink))
        if found is None:
            raise delivery_not_found(delivery_id)
        if not await keeper.change(partial(stored.deliveries.revive, found)):
            detail = f"expected a delivery that is dead, found one that is {found.state}"
            raise Problem(409, code="delivery_not_dead", detail=detail)
        return JSONResponse(_shown(replace(found, state="pending", attempts=0)))


def _require_stored(core: ServiceCore) -> tuple[ResultKeeper, StoredEvents]:
    if core.keeper is None or core.events.stored is None:
        raise Problem(501, code="store_not_configured", detail="expected a store (VIFLOW_STORE_URL), found none")
    return core.keeper, core.events.stored


async def _page(core: ServiceCore, page: Page[EventFilter]) -> tuple[list[LoggedEvent], bool]:
    keeper, stored = _require_stored(core)
    return await keeper.read(partial(stored.events.page, page.filter, page.limit, page.after))


async def _export(
    core: ServiceCore, page: Page[EventFilter], first: tuple[list[LoggedEvent], bool]
) -> AsyncIterator[bytes]:
    found, more = first
    while found:
        yield "".join(f"{one.event.body}\n" for one in found).encode()
        found, more = await _page(core, replace(page, after=found[-1].event.event_id)) if more else ([], False)


def _shown(delivery: Delivery) -> dict[str, Any]:
    """Plain JSON values."""
    return {
        "id": f"{delivery.event.event_id}.{delivery.sink}",
        "sink": delivery.sink,
        "state": delivery.state,
        "attempts": delivery.attempts,
        "next_attempt_ns": delivery.next_attempt_ns if delivery.state == "pending" else None,
        "last_error": delivery.last_error,
        "queued_at_ns": stored_at_ns(delivery.event.event_id),
        "event": json.loads(delivery.event.body),
    }
