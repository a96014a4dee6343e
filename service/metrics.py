"""What Prometheus is told: counts, times by stage and state of this process, or of all workers of one service.

With several worker processes every one of them keeps its numbers in files that all can read, and whichever is asked
answers for all (prometheus-client's multiprocess mode). That mode is chosen by a variable of the environment when the
client library is first imported, so that nothing may import this module before ``supervisor`` has set it.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final, Literal

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector
from prometheus_client.exposition import choose_encoder
from prometheus_client.multiprocess import MultiProcessCollector

from viflow_anomaly.detection import SCHEMA_VERSION, Detection, ModelInfo

MULTIPROCESS_VARIABLE: Final = "PROMETHEUS_MULTIPROC_DIR"
ShedReason = Literal["queue_full", "deadline", "shutting_down", "not_ready"]
Stage = Literal["upload", "queue", "decode", "detect", "encode", "store"]
SECONDS: Final = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
_METHODS: Final = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS", "MESSAGE"})
"""``MESSAGE``: of a WebSocket."""
_OTHER_IMU_FAULTS: Final = frozenset({"interval_too_long", "mounting_unknown", "no_accelerometer"})
"""Codes of the IMU's faults that do not say so in their name."""


class ServiceMetrics:
    """The instruments of one application; counts by ``labels(...)``, in the order that the constructor shows."""

    def __init__(self) -> None:
        self._registry = registry = CollectorRegistry()
        self._shared = MULTIPROCESS_VARIABLE in os.environ
        if not self._shared:
            ProcessCollector(registry=registry)
        self.requests = Counter(
            "viflow_requests", "Answered requests", ("route", "method", "status"), registry=registry
        )
        self.problems = Counter("viflow_problems", "Error answers by their code", ("code",), registry=registry)
        self.shed = Counter("viflow_shed_requests", "Requests refused with 503", ("reason",), registry=registry)
        self.clients_gone = Counter("viflow_clients_gone", "Clients that left before their answer", registry=registry)
        self.stage_seconds = Histogram(
            "viflow_stage_seconds", "Time of one request in a stage", ("stage",), buckets=SECONDS, registry=registry
        )
        self.request_seconds = Histogram(
            "viflow_request_seconds",
            "From request head to answer",
            ("route",),
            buckets=SECONDS,
            registry=registry,
        )
        self.detections = Counter("viflow_detections", "Judged pairs", ("model", "status"), registry=registry)
        self.regions = Counter("viflow_regions", "Regions in the answers", ("label",), registry=registry)
        self.reasons = Counter(
            "viflow_reasons",
            "What was said against judged pairs",
            ("code",),
            registry=registry,
        )
        self.imu_faults = Counter(
            "viflow_imu_faults",
            "Faults of IMU samples, judged or refused",
            ("kind",),
            registry=registry,
        )
        # Of live processes only: what a process that ended had in hand is gone with it.
        self.queue_depth = self.gauge("viflow_queue_depth", "Requests that wait for a worker thread")
        self.in_flight = self.gauge("viflow_requests_in_flight", "Requests inside: uploading, waiting, being judged")
        self.workers_busy = self.gauge("viflow_workers_busy", "Worker threads that judge a pair")
        self.workers = self.gauge("viflow_workers", "Worker threads")
        self.ready = self.gauge("viflow_ready_processes", "Processes whose model is loaded")
        self._resident = Gauge(
            "viflow_resident_memory_bytes",
            "Memory of a process, pages it shares with others included",
            registry=registry,
            multiprocess_mode="liveall",
        )
        self._model = Gauge(
            "viflow_model_info",
            "1; which weights answer",
            ("served_as", "name", "version", "sha256", "schema_version"),
            registry=registry,
            multiprocess_mode="livemax",
        )

    @property
    def registry(self) -> CollectorRegistry:
        """For the instruments of a part that not every service has."""
        return self._registry

    def gauge(self, name: str, help_text: str) -> Gauge:
        return Gauge(name, help_text, registry=self._registry, multiprocess_mode="livesum")

    def observe_stage(self, stage: Stage, seconds: float) -> None:
        self.stage_seconds.labels(stage).observe(seconds)

    def observe_request(self, *, route: str, method: str, status: int, seconds: float) -> None:
        """One answered request; an unknown method is called ``other``, or clients could make names without end."""
        self.requests.labels(route, method if method in _METHODS else "other", str(status)).inc()
        self.request_seconds.labels(route).observe(seconds)

    def observe_detection(self, detection: Detection, model: str) -> None:
        """One judged pair; ``model``: the name that the model is served as."""
        self.detections.labels(model, detection.status).inc()
        for roi in detection.rois:
            self.regions.labels(roi.label).inc()
        for reason in detection.reasons:
            self.reasons.labels(reason.code).inc()
            self._observe_imu_fault(reason.code)

    def observe_problem(self, code: str) -> None:
        self.problems.labels(code).inc()
        self._observe_imu_fault(code)

    def _observe_imu_fault(self, code: str) -> None:
        if code.startswith("imu_") or code in _OTHER_IMU_FAULTS:
            self.imu_faults.labels(code).inc()

    def observe_model(self, served_as: str, model: ModelInfo) -> None:
        self._model.labels(served_as, model.name, model.version, model.sha256, SCHEMA_VERSION).set(1)

    def forget_model(self, served_as: str, model: ModelInfo) -> None:
        """It is not loaded any more; in one process only, where its names could become many."""
        self._model.remove(served_as, model.name, model.version, model.sha256, SCHEMA_VERSION)

    def observe_memory(self) -> None:
        """Called now and then: with several workers, one that is not asked must have said it before."""
        if (resident := resident_bytes()) is not None:
            self._resident.set(resident)

    def exposition(self, accept: str) -> tuple[bytes, str]:
        """The text that a Prometheus server reads, and its media type.

        Args:
            accept: the request's header.
        """
        encode, media_type = choose_encoder(accept)
        self.observe_memory()
        registry = self._registry
        if self._shared:
            registry = CollectorRegistry()
            MultiProcessCollector(registry)  # type: ignore[no-untyped-call]
        return encode(registry), media_type


def resident_bytes(pid: int | Literal["self"] = "self") -> int | None:
    """Resident memory of a process; None where there is no ``/proc``."""
    try:
        pages = Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]
    except OSError:
        return None
    return int(pages) * os.sysconf("SC_PAGE_SIZE")
