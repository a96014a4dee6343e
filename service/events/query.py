"""What a client may ask of events, and the place where a live stream goes on."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, get_args

from viflow_anomaly_service.events.event_rules import EventKind
from viflow_anomaly_service.paging import ITEM_ID, PAGE_PARAMETERS, Page, page_of
from viflow_anomaly_service.parameters import (
    Order,
    choice_parameter,
    order_parameter,
    parameters_once,
    stream_parameter,
    time_parameters,
    wrong_parameter,
)
from viflow_anomaly_service.problems import Problem

KINDS: Final[tuple[str, ...]] = get_args(EventKind)
EVENT_FILTER_NAMES: Final = ("stream", "kind", "from_ns", "to_ns", "order")
DELIVERY_STATES: Final = ("pending", "delivered", "dead")
DELIVERY_ID: Final = re.compile(r"(?P<event>[0-9a-f]{32})\.(?P<sink>mqtt|webhook-[0-9a-f]{12})", re.ASCII)


@dataclass(frozen=True)
class EventFilter:
    """Which events, in which order; None does not filter.

    Attributes:
        from_ns, to_ns: source frame at or after, and before, in camera time.
        order: as they were kept, newest ("desc") or oldest first.
    """

    stream_id: str | None = None
    kind: str | None = None
    from_ns: int | None = None
    to_ns: int | None = None
    order: Order = "desc"


@dataclass(frozen=True)
class DeliveryFilter:
    """Which deliveries; None does not filter."""

    state: str | None = None


def read_event_filter(parameters: list[tuple[str, str]]) -> EventFilter:
    """The filter of an export.

    Raises:
        Problem: 422 with the parameter at fault.
    """
    return _filter(parameters_once(parameters, EVENT_FILTER_NAMES))


def read_event_page(parameters: list[tuple[str, str]]) -> Page[EventFilter]:
    """A page's filter, size and place.

    Raises:
        Problem: 422 with the parameter at fault; ``cursor_invalid`` also for a cursor of another filter.
    """
    given = parameters_once(parameters, (*EVENT_FILTER_NAMES, *PAGE_PARAMETERS))
    return page_of(given, _filter(given))


def read_delivery_page(parameters: list[tuple[str, str]]) -> Page[DeliveryFilter]:
    """A page of deliveries, oldest event first; its limit and place are those of their events.

    Raises:
        Problem: 422 with the parameter at fault.
    """
    given = parameters_once(parameters, ("state", *PAGE_PARAMETERS))
    return page_of(given, DeliveryFilter(choice_parameter(given, "state", DELIVERY_STATES)))


def read_live_stream(parameters: list[tuple[str, str]]) -> str | None:
    """The stream whose events are wanted; None: of all.

    Raises:
        Problem: 422 with the parameter at fault.
    """
    return stream_parameter(parameters_once(parameters, ("stream",)), "stream")


def read_last_event_id(text: str | None) -> str | None:
    """The id behind which to go on; None: with what comes now.

    Raises:
        Problem: 422 ``parameter_invalid``.
    """
    if not text:
        return None
    if ITEM_ID.fullmatch(text) is None:
        raise wrong_parameter("Last-Event-ID", "the id of an event", text)
    return text


def require_delivery_id(text: str) -> tuple[str, str]:
    """Event and sink.

    Raises:
        Problem: 404 ``delivery_not_found`` for what cannot be one.
    """
    found = DELIVERY_ID.fullmatch(text)
    if found is None:
        raise delivery_not_found(text)
    return found["event"], found["sink"]


def delivery_not_found(text: str) -> Problem:
    return Problem(404, code="delivery_not_found", detail=f"expected the id of a delivery, found {text!r:.80}")


def _filter(given: dict[str, str]) -> EventFilter:
    from_ns, to_ns = time_parameters(given)
    return EventFilter(
        stream_id=stream_parameter(given, "stream"),
        kind=choice_parameter(given, "kind", KINDS),
        from_ns=from_ns,
        to_ns=to_ns,
        order=order_parameter(given),
    )
