"""How long each fault of docs/reliability.md is felt: seconds from its end until the service is itself again.

Real processes on this machine, with a detector that answers by rule (a process of the real model needs its own start,
see ``startup.py``). PostgreSQL is left out where it is not installed.

    python benchmarks/fault_recovery.py --out benchmarks/results/fault-recovery.json
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "service"))

import httpx
from postgres_server import find_program, postgres_server
from service_world import json_request, wait_until
from serving_process import serving_process

from viflow_anomaly.benchmarking.machine import circumstances
from viflow_anomaly.checkpoint_record import write_atomically

ROOT = Path(__file__).resolve().parents[1]
LONGEST_S = 60.0


def is_ready(client: httpx.Client) -> bool:
    return client.get("/readyz").status_code == 200


def until(condition: Callable[[], bool]) -> float:
    """Seconds until it holds."""
    started = time.perf_counter()
    wait_until(condition, seconds=LONGEST_S)
    return round(time.perf_counter() - started, 2)


def judged(client: httpx.Client) -> httpx.Response:
    return client.post("/detect", json=json_request())


def stored(client: httpx.Client) -> int:
    return len(client.get("/detections.ndjson").text.splitlines())


def full_disk(folder: Path) -> dict[str, Any]:
    """A limit on the size of files stands for the disk."""
    with serving_process(store_url=str(folder / "full.db")) as serving, serving.client() as client:
        until(lambda: is_ready(client))
        acknowledged = sum(judged(client).status_code == 200 for _ in range(5))
        pid = serving.process.pid
        unlimited = resource.prlimit(pid, resource.RLIMIT_FSIZE)
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (8192, unlimited[1]))
        noticed = until(lambda: judged(client).status_code == 503)
        seen = judged(client).json()["code"]
        resource.prlimit(pid, resource.RLIMIT_FSIZE, unlimited)
        recovered = until(lambda: is_ready(client) and judged(client).status_code == 200)
        return report(seen, noticed, recovered, lost=acknowledged + 1 - stored(client))


def database_gone(folder: Path) -> dict[str, Any]:
    with (
        postgres_server() as postgres,
        serving_process(store_url=postgres.new_database()) as serving,
        serving.client() as client,
    ):
        until(lambda: is_ready(client))
        acknowledged = sum(judged(client).status_code == 200 for _ in range(5))
        postgres.stop()
        noticed = until(lambda: judged(client).status_code == 503)
        seen = judged(client).json()["code"]
        postgres.start()
        recovered = until(lambda: is_ready(client) and judged(client).status_code == 200)
        return report(seen, noticed, recovered, lost=acknowledged + 1 - stored(client))


def killed_worker(folder: Path) -> dict[str, Any]:
    """One of two; the other answers on."""
    with serving_process(workers=2, store_url=str(folder / "worker.db")) as serving, serving.client() as client:
        until(lambda: is_ready(client))
        acknowledged = sum(judged(client).status_code == 200 for _ in range(5))
        os.kill(serving.events("worker_started")[0]["worker"], signal.SIGKILL)
        noticed = until(lambda: bool(serving.events("worker_died")))
        recovered = until(lambda: len(serving.events("model_loaded")) == 3)
    with serving_process(store_url=str(folder / "worker.db")) as serving, serving.client() as client:
        until(lambda: is_ready(client))
        return report("connection broken", noticed, recovered, lost=acknowledged - stored(client))


def report(seen: str, noticed_s: float, recovered_s: float, *, lost: int) -> dict[str, Any]:
    return {"seen": seen, "noticed_s": noticed_s, "recovered_s": recovered_s, "acknowledged_and_lost": lost}


def main() -> None:
    parser = argparse.ArgumentParser(description="How long each fault is felt.")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "fault-recovery.json")
    arguments = parser.parse_args()
    faults: dict[str, Callable[[Path], dict[str, Any]]] = {"full disk": full_disk, "killed worker": killed_worker}
    if find_program("initdb") is not None:
        faults["database gone"] = database_gone
    found: dict[str, Any] = {**circumstances(), "goal": "acknowledged_and_lost 0", "faults": {}}
    for name, fault in faults.items():
        with tempfile.TemporaryDirectory() as folder:
            found["faults"][name] = fault(Path(folder))
        print(name, found["faults"][name], flush=True)
    write_atomically(arguments.out, (json.dumps(found, indent=2) + "\n").encode())


if __name__ == "__main__":
    main()
