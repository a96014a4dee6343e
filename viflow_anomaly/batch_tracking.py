"""Tracking of a batch run: a pass over the lines of its journal, in time order.

It is a function of the lines alone: an interrupted and resumed run ends with the tracks of an uninterrupted one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from viflow_anomaly.detection import to_json
from viflow_anomaly.detection_reading import detection_from_json
from viflow_anomaly.tracking import Tracker, TrackingState


def tracked_lines(lines: Iterable[bytes], tracker: Tracker | None) -> Iterator[bytes]:
    """The lines with their tracks; as they are without a tracker."""
    if tracker is None:
        yield from lines
        return
    state = TrackingState()
    for line in lines:
        state, detection = tracker.update(state, detection_from_json(line))
        yield to_json(detection).encode() + b"\n"
