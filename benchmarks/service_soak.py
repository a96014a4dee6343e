"""The HTTP service for hours: steady load below saturation, then far above it, then calm; what grows, and what answers.

Arrivals are open loop (random gaps, the same ones every minute). Every minute: latencies, refusals, memory, handles and
threads of the service, and the disk that its store takes; a result is written each time, so that a run that is ended
early has one, too. The load is made on the same cores as the answers, which is part of every time here.

    python benchmarks/service_soak.py --minutes 120 --overload-minutes 10
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from load_bodies import BODIES, head, request_parts
from service_load import OVERLOAD_CLIENTS, Service, answered, running_service

from viflow_anomaly.benchmarking.machine import circumstances
from viflow_anomaly.checkpoint_record import write_atomically

ROOT = Path(__file__).resolve().parents[1]
CLIENTS = 64
PROBES = ("health", "ready")
PROBE_RATE = 10.0
EARLY_REQUESTS = 500
LATE_REQUESTS = 20_000
RECOVERY_LIMIT_S = 30.0
NOTE = "the load generator runs on the same cores as the service"
GOALS = {
    "steady": "no answer but 200; p99, memory and handles of the last quarter as of the first",
    "memory": "after 20,000 requests over after 500: <= 1.05",
    "overload": "200, 429 and 503 only; /healthz and /readyz 200 within 100 ms",
    "recovery": "within 5 s",
}


@dataclass
class Soak:
    """A run so far.

    Attributes:
        service: under load.
        out: where the result goes, with every minute.
        report: that result.
        store: the folder of the service's store.
        requests: sent so far.
        early_mib: memory after ``EARLY_REQUESTS``.
    """

    service: Service
    out: Path
    report: dict[str, Any]
    store: Path
    requests: int = 0
    early_mib: float = 0.0
    minutes: list[dict[str, Any]] = field(default_factory=list)

    def saturate(self, seconds: float) -> float:
        """Pairs a second of sixteen clients that never wait, and the memory after the first requests."""
        early = self.service.load("detect", clients=4, requests=EARLY_REQUESTS)
        self.early_mib = self.service.resident_mib()
        run = self.service.load("detect", clients=16, seconds=seconds)
        self.requests = len(early["answers"]) + len(run["answers"])
        self.report["saturation_pairs_s"] = round(answered(run), 2)
        self.report["memory"] = {f"after_{EARLY_REQUESTS}_mib": round(self.early_mib, 1)}
        self.write()
        return answered(run)

    def minute(self, phase: str, *, rate: float, seconds: float, clients: int) -> dict[str, Any]:
        """Load for some seconds, probed meanwhile where it is overload; noted and written."""
        probes = {}
        if phase == "overload":
            probes = {
                name: self.service.begin(name, clients=4, rate=PROBE_RATE, seconds=seconds, reconnect=True)
                for name in PROBES
            }
        run = self.service.load("detect", clients=clients, rate=rate, seconds=seconds)
        row = {"phase": phase, "rate_s": round(rate, 2), **latencies(run), **self.state()}
        for name, process in probes.items():
            row[name] = probed(process, seconds)
        self.requests += len(run["answers"])
        row["requests_so_far"] = self.requests
        if self.requests >= LATE_REQUESTS and "ratio" not in self.report["memory"]:
            late = row["resident_mib"]
            self.report["memory"] |= {
                "requests": self.requests,
                "after_all_mib": late,
                "ratio": round(late / self.early_mib, 4),
            }
        self.minutes.append(row)
        self.write()
        print(json.dumps(row), flush=True)
        return row

    def recover(self, calm_ms: float) -> None:
        """Seconds until one request is answered as fast as before, twice its median at most."""
        ended, recovered = time.perf_counter(), None
        while recovered is None and (passed := time.perf_counter() - ended) < RECOVERY_LIMIT_S:
            ((_, taken, status),) = self.service.load("detect", clients=1, requests=1)["answers"]
            recovered = passed + taken if status == 200 and taken * 1e3 <= 2 * calm_ms else None
        self.report["recovered_s"] = None if recovered is None else round(recovered, 2)
        self.write()

    def state(self) -> dict[str, Any]:
        """What the service's processes hold."""
        pids = self.service.pids()
        store = sum(file.stat().st_size for file in self.store.glob("soak.db*"))
        return {
            "resident_mib": round(self.service.resident_mib(), 1),
            "handles": sum(len(list(Path(f"/proc/{pid}/fd").iterdir())) for pid in pids),
            "threads": sum(len(list(Path(f"/proc/{pid}/task").iterdir())) for pid in pids),
            "store_mib": round(store / 2**20, 1),
        }

    def write(self) -> None:
        report = self.report | summary(self.minutes) | {"minutes": self.minutes}
        write_atomically(self.out, (json.dumps(report, indent=2) + "\n").encode())
        write_atomically(self.out.with_suffix(".md"), table(report).encode())


def latencies(run: dict[str, Any]) -> dict[str, Any]:
    """Of what was judged; and how fast others were refused."""
    judged = np.array([taken for _, taken, status in run["answers"] if status == 200] or [np.nan]) * 1e3
    refused = np.array([taken for _, taken, status in run["answers"] if status in (429, 503)] or [np.nan]) * 1e3
    p50, p99 = np.percentile(judged, (50, 99))
    return {
        "statuses": run["statuses"],
        "p50_ms": _rounded(p50),
        "p99_ms": _rounded(p99),
        "max_ms": _rounded(judged.max()),
        "refusal_p99_ms": _rounded(np.percentile(refused, 99)),
    }


def _rounded(value: float) -> float | None:
    return None if np.isnan(value) else round(float(value), 1)


def probed(process: subprocess.Popen[bytes], seconds: float) -> dict[str, Any]:
    """What asking for its state came to while the load lasted."""
    run = json.loads(process.communicate()[0])
    waits = np.array([taken for due, taken, _ in run["answers"] if due <= seconds] or [np.nan]) * 1e3
    p99 = _rounded(np.percentile(waits, 99))
    over = int((waits > 100).sum())
    return {"statuses": run["statuses"], "p99_ms": p99, "max_ms": _rounded(waits.max()), "over_100_ms": over}


def summary(minutes: list[dict[str, Any]]) -> dict[str, Any]:
    """The first and the last quarter of the steady part beside each other, and the overload as a whole."""
    found: dict[str, Any] = {}
    steady = [row for row in minutes if row["phase"] == "steady"]
    if steady:
        quarter = max(1, len(steady) // 4)
        found["steady"] = {"statuses": _statuses(steady)} | {
            name: {"first_quarter": _median(steady[:quarter], name), "last_quarter": _median(steady[-quarter:], name)}
            for name in ("p50_ms", "p99_ms", "resident_mib", "handles", "threads")
        }
    overload = [row for row in minutes if row["phase"] == "overload"]
    if overload:
        found["overload"] = {"statuses": _statuses(overload)} | {
            name: {
                "statuses": _statuses([row[name] for row in overload]),
                "max_ms": max(row[name]["max_ms"] or 0.0 for row in overload),
                "over_100_ms": sum(row[name]["over_100_ms"] for row in overload),
            }
            for name in PROBES
        }
    return found


def _statuses(rows: list[dict[str, Any]]) -> dict[str, int]:
    return dict(sum((Counter(row["statuses"]) for row in rows), Counter()))


def _median(rows: list[dict[str, Any]], name: str) -> float:
    return round(float(np.median([row[name] for row in rows if row[name] is not None] or [np.nan])), 1)


def table(report: dict[str, Any]) -> str:
    """The minutes as Markdown, of a long run every fifth."""
    minutes = report["minutes"]
    every = 5 if len(minutes) > 40 else 1
    lines = [
        f"Saturation {report.get('saturation_pairs_s')} pairs/s at {report['width']}x{report['height']}; {NOTE}.",
        "",
        "| minute | phase | rate/s | statuses | p50 ms | p99 ms | memory MiB | handles | threads |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for number, row in enumerate(minutes, 1):
        if number % every == 0 or row["phase"] != "steady" or number == 1:
            statuses = ", ".join(f"{status}: {count}" for status, count in sorted(row["statuses"].items()))
            cells = (number, row["phase"], row["rate_s"], statuses, *(row[name] for name in SHOWN))
            lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    return "\n".join(lines) + "\n"


SHOWN = ("p50_ms", "p99_ms", "resident_mib", "handles", "threads")


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="The HTTP service under load for hours.")
    parser.add_argument("--sample", type=Path, default=ROOT / "samples" / "drone", help="a pair as in samples/drone")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "service-soak.json")
    parser.add_argument("--size", default="720x480", help="WIDTHxHEIGHT of the pairs (default 720x480)")
    parser.add_argument("--body", choices=sorted(BODIES), default="form", help="how the pairs are sent (default form)")
    parser.add_argument("--workers", type=int, default=1, help="processes of the service (default 1)")
    parser.add_argument("--no-store", action="store_true", help="keep no detections (default: in SQLite)")
    parser.add_argument("--minutes", type=float, default=120.0, help="of steady load (default 120)")
    parser.add_argument("--fraction", type=float, default=0.7, help="of the saturation (default 0.7)")
    parser.add_argument("--overload-minutes", type=float, default=10.0, help="0 leaves it out (default 10)")
    parser.add_argument("--factor", type=float, default=3.0, help="of overload over saturation (default 3)")
    parser.add_argument("--saturation-seconds", type=float, default=30.0, help="of measuring it (default 30)")
    parser.add_argument("--step-seconds", type=float, default=60.0, help="between two looks (default 60)")
    return parser.parse_args()


def main() -> None:
    arguments = parse_arguments()
    width, height = (int(side) for side in arguments.size.split("x"))
    content_type, make_body = BODIES[arguments.body]
    body = make_body(*request_parts(arguments.sample, width, height))
    asked = {name: value for name, value in vars(arguments).items() if name not in ("sample", "out")}
    report = circumstances() | {"note": NOTE, "goals": GOALS, "asked": asked, "width": width, "height": height}
    with tempfile.TemporaryDirectory() as folder:
        variables = {} if arguments.no_store else {"VIFLOW_STORE_URL": f"{folder}/soak.db"}
        with running_service(arguments.workers, **variables) as service:
            (service.folder / "detect").write_bytes(head(content_type, body) + body)
            run(Soak(service, arguments.out, report, Path(folder)), arguments)
    print(arguments.out.with_suffix(".md").read_text(encoding="utf-8"), file=sys.stderr)


def run(soak: Soak, arguments: argparse.Namespace) -> None:
    """Saturation, the steady hours, the overload, and how soon the service is itself again."""
    step = arguments.step_seconds
    saturation = soak.saturate(arguments.saturation_seconds)
    for _ in range(round(arguments.minutes * 60 / step)):
        soak.minute("steady", rate=arguments.fraction * saturation, seconds=step, clients=CLIENTS)
    calm_ms = _median(soak.minutes, "p50_ms")
    for _ in range(round(arguments.overload_minutes * 60 / step)):
        soak.minute("overload", rate=arguments.factor * saturation, seconds=step, clients=OVERLOAD_CLIENTS)
    if arguments.overload_minutes:
        soak.recover(calm_ms)
        soak.minute("after", rate=arguments.fraction * saturation, seconds=step, clients=CLIENTS)


if __name__ == "__main__":
    main()
