"""What a client may ask of the stored detections."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, get_args

from viflow_anomaly.regions import RegionLabel
from viflow_anomaly_service.paging import ITEM_ID, PAGE_PARAMETERS, Page, page_of
from viflow_anomaly_service.parameters import (
    Order,
    choice_parameter,
    order_parameter,
    parameters_once,
    share_parameter,
    stream_parameter,
    time_parameters,
)
from viflow_anomaly_service.problems import Problem

LABELS: Final[tuple[str, ...]] = get_args(RegionLabel)
FILTER_NAMES: Final = ("stream", "from_ns", "to_ns", "label", "min_score", "order")


@dataclass(frozen=True)
class DetectionFilter:
    """Which detections, in which order; None does not filter.

    Attributes:
        stream: of this stream.
        from_ns, to_ns: source frame at or after, and before, in camera time.
        label, min_score: with a region of this label, or of any, that has at least this score.
        order: by the time of storing, newest ("desc") or oldest first.
    """

    stream: str | None = None
    from_ns: int | None = None
    to_ns: int | None = None
    label: str | None = None
    min_score: float | None = None
    order: Order = "desc"


def read_filter(parameters: list[tuple[str, str]]) -> DetectionFilter:
    """The filter of an export.

    Raises:
        Problem: 422 with the parameter at fault.
    """
    return _filter(parameters_once(parameters, FILTER_NAMES))


def read_page(parameters: list[tuple[str, str]]) -> Page[DetectionFilter]:
    """A page's filter, size and place.

    Raises:
        Problem: 422 with the parameter at fault; ``cursor_invalid`` also for a cursor of another filter.
    """
    given = parameters_once(parameters, (*FILTER_NAMES, *PAGE_PARAMETERS))
    return page_of(given, _filter(given))


def require_detection_id(text: str) -> str:
    """The id as it is.

    Raises:
        Problem: 404 ``detection_not_found`` for what cannot be one.
    """
    if ITEM_ID.fullmatch(text) is None:
        raise detection_not_found(text)
    return text


def detection_not_found(text: str) -> Problem:
    return Problem(404, code="detection_not_found", detail=f"expected the id of a stored detection, found {text!r:.80}")


def thumbnail_not_found(text: str) -> Problem:
    detail = f"expected the id of a stored detection with a thumbnail, found {text!r:.80}"
    return Problem(404, code="thumbnail_not_found", detail=detail)


def _filter(given: dict[str, str]) -> DetectionFilter:
    from_ns, to_ns = time_parameters(given)
    return DetectionFilter(
        stream=stream_parameter(given, "stream"),
        from_ns=from_ns,
        to_ns=to_ns,
        label=choice_parameter(given, "label", LABELS),
        min_score=share_parameter(given, "min_score"),
        order=order_parameter(given),
    )
