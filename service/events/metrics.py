"""What Prometheus is told of events and their deliveries."""

from __future__ import annotations

from collections.abc import Iterable

from prometheus_client import Counter, Gauge

from viflow_anomaly_service.events.event_record import EventRecord
from viflow_anomaly_service.metrics import ServiceMetrics


class EventMetrics:
    """The instruments; counts by ``labels(...)``, in the order that the constructor shows."""

    def __init__(self, metrics: ServiceMetrics) -> None:
        registry = metrics.registry
        self.events = Counter("viflow_events", "Events of streams", ("kind",), registry=registry)
        self.held_back = Counter(
            "viflow_events_held_back", "Tracks whose event the cool-down kept from beginning", registry=registry
        )
        self.readers = metrics.gauge("viflow_event_readers", "Connections that read events live")
        self.deliveries = Counter(
            "viflow_event_deliveries", "Attempts to tell a sink", ("sink", "result"), registry=registry
        )
        self.pending, self.dead, self.oldest_s = (
            # Of the store, which all processes share: whoever looked last is right.
            Gauge(name, help_text, ("sink",), registry=registry, multiprocess_mode="livemostrecent")
            for name, help_text in (
                ("viflow_event_deliveries_pending", "Events that wait for a sink"),
                ("viflow_event_deliveries_dead", "Events that a sink did not take, given up"),
                ("viflow_event_deliveries_oldest_seconds", "Age of what waits longest for a sink"),
            )
        )
        for kind in ("start", "update", "end"):
            self.events.labels(kind)

    def count(self, events: Iterable[EventRecord]) -> None:
        for event in events:
            self.events.labels(event.kind).inc()
