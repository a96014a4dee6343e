"""The HTTP service under load on one machine: throughput, latency, overload, memory; the load shares its cores.

Each part's numbers come from one run, as ratios: throughput of 16 clients over the pipeline without a service (rounds
alternate), the slowest answers over the median at half of saturation, memory late over early. The pairs are the bundled
sample as JPEG, resized, posted as multipart/form-data or JSON.

    python benchmarks/service_load.py --out benchmarks/results/service-load.json
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
from load_bodies import BODIES, head, request_parts

from viflow_anomaly.allocator import keep_freed_memory
from viflow_anomaly.checkpoint_record import source_commit, write_atomically
from viflow_anomaly.detection import to_json
from viflow_anomaly.evaluation.flow_report import cpu_model
from viflow_anomaly_service.detection_request import read_pair
from viflow_anomaly_service.detector_loading import load_bundled_or_configured
from viflow_anomaly_service.metrics import resident_bytes
from viflow_anomaly_service.models.table import LoadedModel, ModelSet
from viflow_anomaly_service.settings import load_settings

ROOT = Path(__file__).resolve().parents[1]
CLIENT = Path(__file__).with_name("load_client.py")
EARLY_REQUESTS = 500
WARM_UP_REQUESTS = 40
OVERLOAD_CLIENTS = 120
HEALTH_RATE = 10.0
RECOVERY_LIMIT_S = 30.0


@dataclass(frozen=True)
class Service:
    """A running service.

    Args:
        port: on the loopback interface.
        process: the server, or the parent of its processes.
        folder: for requests.
    """

    port: int
    process: subprocess.Popen[bytes]
    folder: Path

    def load(self, name: str, **options: float | bool) -> dict[str, Any]:
        """What ``load_client`` says after sending the request in file ``name``."""
        process = self.begin(name, **options)
        output, _ = process.communicate()
        if process.returncode:
            raise SystemExit(f"error: the load client ended with status {process.returncode}")
        answer: dict[str, Any] = json.loads(output)
        return answer

    def begin(self, name: str, **options: float | bool) -> subprocess.Popen[bytes]:
        flags = []
        for key, value in options.items():
            flags += [f"--{key}"] if value is True else [f"--{key}", str(value)]
        command = [sys.executable, str(CLIENT), str(self.port), str(self.folder / name), *flags]
        return subprocess.Popen(command, stdout=subprocess.PIPE)

    def pids(self) -> list[int]:
        """Of the processes that serve."""
        children = (
            Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text(encoding="ascii").split()
        )
        return [int(pid) for pid in children] or [self.process.pid]

    def resident_mib(self) -> float:
        """Memory of the service's processes together; pages that they share count in each."""
        return sum(resident_bytes(pid) or 0 for pid in self.pids()) / 2**20


@contextlib.contextmanager
def running_service(workers: int, **variables: str) -> Iterator[Service]:
    """The service as a user starts it, on a free port, with more ``variables``; its log goes to a file."""
    with tempfile.TemporaryDirectory() as folder, (Path(folder) / "log").open("wb") as log:
        environment = {name: value for name, value in os.environ.items() if not name.startswith("VIFLOW_")}
        process = subprocess.Popen(
            [sys.executable, "-m", "viflow_anomaly_service"],
            env=environment | {"VIFLOW_PORT": "0", "VIFLOW_WORKERS": str(workers)} | variables,
            stderr=log,
        )
        try:
            service = Service(_port(Path(log.name), process), process, Path(folder))
            (service.folder / "ready").write_bytes(b"GET /readyz HTTP/1.1\r\nHost: x\r\n\r\n")
            (service.folder / "health").write_bytes(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
            while service.load("ready", clients=1, requests=1)["statuses"] != {"200": 1}:
                time.sleep(0.2)
            yield service
        finally:
            process.terminate()
            process.wait(60)


def _port(log: Path, process: subprocess.Popen[bytes]) -> int:
    while process.poll() is None:
        for line in log.read_text(encoding="utf-8").splitlines():
            with contextlib.suppress(ValueError):
                if (record := json.loads(line)).get("event") == "listening":
                    return int(record["port"])
        time.sleep(0.05)
    raise SystemExit(f"error: the service ended with status {process.returncode}: {log.read_text(encoding='utf-8')}")


class Pipeline:
    """The same work without a service: body -> pair -> detection -> JSON, in as many threads as the service has."""

    def __init__(self, content_type: str, body: bytes) -> None:
        self._settings = load_settings()
        model = LoadedModel("default", load_bundled_or_configured(self._settings))
        self._models = ModelSet((model,))
        self._body = body
        self._content_type = content_type
        self._threads = len(os.sched_getaffinity(0))

    def once(self) -> str:
        pair, model, config, _ = read_pair(self._models, self._body, self._content_type, self._settings)
        return to_json(model.detector.with_config(config).detect(pair))

    def latencies(self, seconds: float) -> list[float]:
        """Seconds of one pair after the other, in one thread."""
        times, until = [], time.perf_counter() + seconds
        while (started := time.perf_counter()) < until:
            self.once()
            times.append(time.perf_counter() - started)
        return times

    def rate(self, seconds: float) -> float:
        """Pairs a second."""
        until = time.perf_counter() + seconds

        def work(_: int) -> int:
            count = 0
            while time.perf_counter() < until:
                self.once()
                count += 1
            return count

        started = time.perf_counter()
        with ThreadPoolExecutor(self._threads) as threads:
            count = sum(threads.map(work, range(self._threads)))
        return count / (time.perf_counter() - started)


def answered(run: dict[str, Any]) -> float:
    """Pairs a second that were judged."""
    return float(run["statuses"].get("200", 0) / run["seconds"])


def throughput(service: Service, pipeline: Pipeline, *, rounds: int, seconds: float) -> dict[str, Any]:
    """Rounds of both, alternating."""
    pipeline.rate(1.0)
    service.load("detect", clients=4, requests=WARM_UP_REQUESTS)
    pairs = [
        (answered(service.load("detect", clients=16, seconds=seconds)), pipeline.rate(seconds)) for _ in range(rounds)
    ]
    served, alone = (float(np.median(rates)) for rates in zip(*pairs, strict=True))
    ratio = float(np.median([one / other for one, other in pairs]))
    return {
        "served_pairs_s": round(served, 2),
        "in_process_pairs_s": round(alone, 2),
        "rounds": [[round(one, 2), round(other, 2)] for one, other in pairs],
        "ratio": round(ratio, 3),
        "goal": "ratio >= 0.8",
    }


def half_load(service: Service, pipeline: Pipeline, saturation: float, seconds: float) -> dict[str, Any]:
    """Latencies at half of saturation, arrivals at random; beside them the pipeline's own, pair after pair, alone.

    The latter is what the machine's other work makes of one and the same computation.
    """
    alone = np.percentile(pipeline.latencies(seconds / 4), (50, 99))
    run = service.load("detect", clients=32, rate=saturation / 2, seconds=seconds)
    times = np.array([taken for _, taken, status in run["answers"] if status == 200]) * 1e3
    p50, p90, p99 = (float(value) for value in np.percentile(times, (50, 90, 99)))
    return {
        "rate_s": round(saturation / 2, 2),
        "requests": len(run["answers"]),
        "statuses": run["statuses"],
        "p50_ms": round(p50, 1),
        "p90_ms": round(p90, 1),
        "p99_ms": round(p99, 1),
        "p99_over_p50": round(p99 / p50, 2),
        "alone_p99_over_p50": round(float(alone[1] / alone[0]), 2),
        "goal": "p99_over_p50 <= 3",
    }


def overload(service: Service, saturation: float, seconds: float, calm_ms: float) -> dict[str, Any]:
    """Three times what it can do: who is refused, whether its health answers meanwhile, how soon it is itself again."""
    probe = service.begin("health", clients=4, rate=HEALTH_RATE, seconds=seconds, reconnect=True)
    run = service.load("detect", clients=OVERLOAD_CLIENTS, rate=3 * saturation, seconds=seconds)
    ended = time.perf_counter()
    recovered = None
    while recovered is None and (passed := time.perf_counter() - ended) < RECOVERY_LIMIT_S:
        ((_, taken, status),) = service.load("detect", clients=1, requests=1)["answers"]
        recovered = passed + taken if status == 200 and taken * 1e3 <= 2 * calm_ms else None
    health = json.loads(probe.communicate()[0])
    waits = np.array([taken for due, taken, _ in health["answers"] if due <= seconds]) * 1e3
    refused = np.array([taken for _, taken, status in run["answers"] if status == 503] or [np.nan]) * 1e3
    return {
        "offered_s": round(3 * saturation, 2),
        "statuses": run["statuses"],
        "judged_pairs_s": round(answered(run), 2),
        "refusal_median_ms": round(float(np.median(refused)), 1),
        "health_statuses": health["statuses"],
        "health_median_ms": round(float(np.median(waits)), 1),
        "health_p99_ms": round(float(np.percentile(waits, 99)), 1),
        "health_max_ms": round(float(waits.max()), 1),
        "recovered_s": None if recovered is None else round(recovered, 2),
        "goal": "503 and 200 only, health_max_ms <= 100, recovered_s <= 5",
    }


def memory(service: Service, *, requests: int) -> dict[str, Any]:
    """Resident memory late over early, of a service that has done nothing else."""
    early = service.load("detect", clients=4, requests=EARLY_REQUESTS)
    before = service.resident_mib()
    late = service.load("detect", clients=4, requests=requests - EARLY_REQUESTS)
    after = service.resident_mib()
    return {
        "requests": requests,
        "statuses": {name: early["statuses"].get(name, 0) + count for name, count in late["statuses"].items()},
        f"after_{EARLY_REQUESTS}_mib": round(before, 1),
        "after_all_mib": round(after, 1),
        "ratio": round(after / before, 4),
        "goal": "ratio <= 1.05",
    }


def circumstances() -> dict[str, Any]:
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": source_commit(),
        "cpu": cpu_model(),
        "cores": len(os.sched_getaffinity(0)),
        "load_1min_before": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in ("viflow-anomaly", "openvino", "fastapi", "uvicorn")},
    }


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="The HTTP service under load.")
    parser.add_argument("--sample", type=Path, default=ROOT / "samples" / "drone", help="a pair as in samples/drone")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "service-load.json")
    parser.add_argument("--size", default="720x480", help="WIDTHxHEIGHT of the pairs (default 720x480)")
    parser.add_argument("--body", choices=sorted(BODIES), default="form", help="how the pairs are sent (default form)")
    parser.add_argument("--workers", type=int, default=1, help="processes of the service (default 1)")
    parser.add_argument("--rounds", type=int, default=5, help="of throughput, each way (default 5)")
    parser.add_argument("--seconds", type=float, default=10.0, help="of a round (default 10)")
    parser.add_argument("--requests", type=int, default=20_000, help="of the memory part; 0 leaves it out")
    arguments = parser.parse_args()
    if 0 < arguments.requests <= EARLY_REQUESTS:
        parser.error(f"expected more than {EARLY_REQUESTS} requests, or 0")
    return arguments


def main() -> None:
    arguments = parse_arguments()
    keep_freed_memory()  # as the service does
    width, height = (int(side) for side in arguments.size.split("x"))
    content_type, make_body = BODIES[arguments.body]
    body = make_body(*request_parts(arguments.sample, width, height))
    report: dict[str, Any] = circumstances()
    report |= {
        "width": width,
        "height": height,
        "body": arguments.body,
        "body_bytes": len(body),
        "workers": arguments.workers,
    }
    pipeline = Pipeline(content_type, body)
    with running_service(arguments.workers) as service:
        (service.folder / "detect").write_bytes(head(content_type, body) + body)
        twice = 2 * arguments.seconds
        report["throughput"] = throughput(service, pipeline, rounds=arguments.rounds, seconds=arguments.seconds)
        saturation = report["throughput"]["served_pairs_s"]
        report["half_load"] = half_load(service, pipeline, saturation, 2 * twice)
        report["overload"] = overload(service, saturation, twice, report["half_load"]["p50_ms"])
    if arguments.requests:
        with running_service(arguments.workers) as service:
            (service.folder / "detect").write_bytes(head(content_type, body) + body)
            report["memory"] = memory(service, requests=arguments.requests)
    report["load_1min_after"] = round(os.getloadavg()[0], 2)
    write_atomically(arguments.out, (json.dumps(report, indent=2) + "\n").encode())
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
