"""At least 100,000 wrong inputs against the service: no fault of ours (5xx), no hang, no leak; answers are counted.

Every input is made from its own seed, so that one that is found can be made again (``--first SEED --inputs 1``). Most
go to the application in this process (ASGI, no sockets) with a detector that answers by rule and a store; a share goes
through the bundled model, and a share is sent as damaged bytes over sockets, through the server's own HTTP parser.

    python benchmarks/fuzz_inputs.py --out benchmarks/results/fuzz-inputs.json
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import json
import logging
import os
import random
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Coroutine
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "service"))

import cv2
from fastapi import FastAPI
from fuzzing.requests import bad_request
from fuzzing.wire import WireServer, ask_wire, damaged_wire
from rule_detector import RuleDetector

from viflow_anomaly.allocator import keep_freed_memory
from viflow_anomaly.benchmarking.machine import circumstances
from viflow_anomaly.checkpoint_record import write_atomically
from viflow_anomaly.detection import Detection
from viflow_anomaly.sensor_data import FramePair
from viflow_anomaly_service.app import create_app
from viflow_anomaly_service.detector_loading import load_bundled_or_configured, preload
from viflow_anomaly_service.metrics import resident_bytes
from viflow_anomaly_service.settings import ServiceSettings

ROOT = Path(__file__).resolve().parents[1]
HANG_S = 30.0
AT_ONCE = 4
CONNECTIONS = 16
HEALTH = b"GET /healthz HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n"
LOOKS = 20
"""How often memory and handles are looked at in each part."""
SHOWN_FAULTS = 50
LIMITS: dict[str, Any] = {
    "max_image_pixels": 1_000_000,
    "max_image_bytes": 1_000_000,
    "max_imu_samples": 1000,
    "max_streams": 8,
}
GOAL = "no faults, no hangs; memory_ratio <= 1.05, handles and threads at the end as after a fifth"


@dataclass(frozen=True)
class Answer:
    """Of one input: its status (or what came instead), its problem code, and what is wrong with it."""

    status: str
    code: str
    fault: str
    seconds: float


@dataclass
class Part:
    """What came of one part of the inputs.

    Attributes:
        statuses: answers by status; "closed" where a connection ended without one, "left" where the client did.
        kinds: inputs by the rule that they were made by.
        codes: error answers by their code.
        faults: answers that should not be, and answers that did not come.
        longest_s: until an answer, and the seed of that input.
        looks: inputs so far, resident MiB, open handles, threads.
    """

    inputs: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    kinds: Counter[str] = field(default_factory=Counter)
    codes: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    longest_s: tuple[float, int] = (0.0, -1)
    looks: list[dict[str, float]] = field(default_factory=list)

    def note(self, seed: int, kind: str, answer: Answer) -> None:
        self.inputs += 1
        self.statuses[answer.status] += 1
        self.kinds[kind] += 1
        self.longest_s = max(self.longest_s, (answer.seconds, seed))
        if answer.code:
            self.codes[answer.code] += 1
        if answer.fault:
            self.faults.append(f"seed {seed} ({kind}): {answer.fault}"[:300])

    def look(self) -> None:
        gc.collect()
        handles = len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - names alone
        memory = round((resident_bytes() or 0) / 2**20, 1)
        self.looks.append(
            {"inputs": self.inputs, "mib": memory, "handles": handles, "threads": threading.active_count()}
        )

    def report(self) -> dict[str, Any]:
        early, late = self.looks[len(self.looks) // 5], self.looks[-1]
        seconds, seed = self.longest_s
        return {
            **{name: value for name, value in asdict(self).items() if isinstance(value, int)},
            "statuses": dict(sorted(self.statuses.items())),
            "codes": dict(self.codes.most_common()),
            "kinds": dict(self.kinds.most_common()),
            "faults": len(self.faults),
            "first_faults": self.faults[:SHOWN_FAULTS],
            "longest_ms": round(seconds * 1e3, 1),
            "longest_seed": seed,
            "memory_ratio": round(late["mib"] / early["mib"], 4),
            "looks": self.looks,
        }


class ForgetfulDetector(RuleDetector):
    """What it was asked is of interest to tests alone, and would look like a leak here."""

    def detect(self, pair: FramePair, *, decode_ms: float = 0.0) -> Detection:
        found = super().detect(pair, decode_ms=decode_ms)
        self.calls.clear()
        return found


async def ask_app(app: FastAPI, seed: int) -> tuple[str, Answer]:
    """Send input ``seed`` straight to the application: its rule, and the answer."""
    rng = random.Random(seed)
    request = bad_request(rng)
    path, _, query = request.path.partition(b"?")
    chunks = _chunks(rng, request.body)
    leaves = rng.random() < 0.01
    sent: list[Any] = []

    async def receive() -> dict[str, Any]:
        if chunks:
            more = len(chunks) > 1
            return {"type": "http.request", "body": chunks.pop(0), "more_body": more or leaves}
        if not leaves:
            await asyncio.sleep(HANG_S)  # a connection that stays; cancelled with the answer
        return {"type": "http.disconnect"}

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {
        "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": request.method, "scheme": "http",
        "path": _decoded(path), "raw_path": path, "query_string": query, "root_path": "", "headers": request.headers,
        "client": ("127.0.0.1", 50000), "server": ("127.0.0.1", 8000), "state": {},
    }  # fmt: skip
    started = time.perf_counter()
    try:
        async with asyncio.timeout(HANG_S):
            await app(scope, receive, send)
    except TimeoutError:
        return request.kind, Answer("none", "", f"no answer within {HANG_S:g} s", HANG_S)
    except Exception as err:
        return request.kind, Answer("none", "", f"{type(err).__name__}: {err}", time.perf_counter() - started)
    return request.kind, _judged(sent, time.perf_counter() - started, head=request.method == "HEAD", left=leaves)


def _judged(sent: list[Any], seconds: float, *, head: bool, left: bool) -> Answer:
    if not sent:
        return Answer("left", "", "" if left else "no answer", seconds)
    status, headers = int(sent[0]["status"]), dict(sent[0]["headers"])
    body = b"".join(message.get("body", b"") for message in sent[1:])
    if status < 400:
        return Answer(str(status), "", "", seconds)
    try:
        code = "" if head else str(json.loads(body)["code"])
    except (ValueError, KeyError, TypeError):
        return Answer(str(status), "", f"{status} without a problem: {body[:100]!r}", seconds)
    return Answer(str(status), code, fault_of(status, code, has_retry=b"retry-after" in headers), seconds)


def fault_of(status: int, code: str, *, has_retry: bool) -> str:
    """What is wrong with an error answer: 5xx is, but for 503 with Retry-After, and 501 for what this service lacks."""
    fine = status < 500 or (status == 503 and has_retry) or status == 501
    return "" if fine else f"{status} {code}"


def _chunks(rng: random.Random, body: bytes) -> list[bytes]:
    if rng.random() < 0.8 or len(body) < 2:
        return [body]
    cut = rng.randrange(1, len(body))
    return [body[:cut], b"", body[cut:]]


def _decoded(path: bytes) -> str:
    """As a server does it."""
    return unquote(path.decode("ascii", "replace"))


async def in_process(app: FastAPI, seeds: range) -> Part:
    """Some inputs at once, in the order of their seeds."""
    part, left = Part(), iter(seeds)
    every = max(1, len(seeds) // LOOKS)

    async def client() -> None:
        for seed in left:
            try:
                part.note(seed, *await ask_app(app, seed))
            except Exception as err:  # of the generator: one input is not worth the run
                part.note(seed, "not made", Answer("none", "", f"{type(err).__name__}: {err}", 0.0))
            if part.inputs % every == 0:
                part.look()

    async with app.router.lifespan_context(app):
        while app.state.core.slot.detector is None or not _is_usable(app):
            await asyncio.sleep(0.05)
        await asyncio.gather(*(client() for _ in range(AT_ONCE)))
    part.look()
    return part


def _is_usable(app: FastAPI) -> bool:
    keeper = app.state.core.keeper
    try:
        if keeper is not None:
            keeper.require_usable()
    except Exception:
        return False
    return True


async def over_sockets(settings: ServiceSettings, seeds: range) -> Part:
    """Damaged bytes through the server's own parser; now and then the server must still be in good health."""
    part, left = Part(), iter(seeds)
    every = max(1, len(seeds) // LOOKS)

    async def client(port: int) -> None:
        for seed in left:
            try:
                kind, data = damaged_wire(random.Random(seed))
                part.note(seed, kind, Answer(*await asyncio.to_thread(ask_wire, port, data, HANG_S)))
            except Exception as err:  # as above
                part.note(seed, "not made", Answer("none", "", f"{type(err).__name__}: {err}", 0.0))
            if part.inputs % every == 0:
                part.look()
                status, *_ = await asyncio.to_thread(ask_wire, port, HEALTH, HANG_S)
                if status != "200":
                    part.faults.append(f"seed {seed}: afterwards /healthz answered {status}")

    with WireServer(create_app(settings, load_detector=lambda _: ForgetfulDetector()), settings) as server:
        await asyncio.gather(*(client(server.port) for _ in range(CONNECTIONS)))
    part.look()
    return part


def run(part: Coroutine[Any, Any, Part], name: str) -> dict[str, Any]:
    started = time.perf_counter()
    report = asyncio.run(part).report()
    report["seconds"] = round(time.perf_counter() - started, 1)
    print(f"{name}: {report['inputs']} inputs, {report['faults']} faults, {report['statuses']}", flush=True)
    return report


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Wrong inputs against the service.")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "fuzz-inputs.json")
    parser.add_argument("--inputs", type=int, default=92_000, help="with the detector that answers by rule")
    parser.add_argument("--model-inputs", type=int, default=4_000, help="through the bundled model; 0: none")
    parser.add_argument("--wire-inputs", type=int, default=4_000, help="over sockets; 0: none")
    parser.add_argument("--first", type=int, default=0, help="seed of the first input (default 0)")
    return parser.parse_args()


def main() -> None:
    arguments = parse_arguments()
    logging.disable(logging.CRITICAL)  # a line a request; faults are in the result
    keep_freed_memory()  # as the service does
    preload()
    cv2.setNumThreads(1)
    report: dict[str, Any] = {**circumstances(), "first_seed": arguments.first, "goal": GOAL, "parts": {}}
    counts = {"rule": arguments.inputs, "model": arguments.model_inputs, "wire": arguments.wire_inputs}
    seeds = {name: range(arguments.first, arguments.first + count) for name, count in counts.items() if count}
    with tempfile.TemporaryDirectory() as folder:
        fast = ServiceSettings(
            warm_up=(), max_concurrent=2, store_url=f"{folder}/x.db", store_max_bytes=16 * 2**20, **LIMITS
        )
        slow = ServiceSettings(warm_up=(), max_concurrent=1, **LIMITS)
        hasty = slow.model_copy(update={"body_timeout_s": 1.0, "head_timeout_s": 1.0})
        parts: dict[str, Callable[[range], Coroutine[Any, Any, Part]]] = {
            "rule": lambda chosen: in_process(create_app(fast, load_detector=lambda _: ForgetfulDetector()), chosen),
            "wire": lambda chosen: over_sockets(hasty, chosen),
            "model": lambda chosen: in_process(create_app(slow, load_detector=load_bundled_or_configured), chosen),
        }
        for name, part in parts.items():
            if name in seeds:
                report["parts"][name] = run(part(seeds[name]), name)
    report["inputs"] = sum(part["inputs"] for part in report["parts"].values())
    report["faults"] = sum(part["faults"] for part in report["parts"].values())
    write_atomically(arguments.out, (json.dumps(report, indent=2) + "\n").encode())
    if report["faults"]:
        raise SystemExit(
            f"error: {report['faults']} of {report['inputs']} inputs were answered by a fault: {arguments.out}"
        )


if __name__ == "__main__":
    main()
