"""Throughput of ``batch`` with one job and with a job on every core, interleaved; memory against the length.

The recording is the bundled sample, played again and again, or the one that is named. A speed-up is only what free
cores give: each round says how much of them other programs took, and the verdict is left open where that was too much.
Beside the wall clock stands what no other program disturbs: processor seconds of a run with one job over the share of
them that each of N jobs needs ("with free cores": the start of helpers is in it, waiting is not). And "apart": what N
programs reach that share nothing and write nothing, each judging all pairs by itself. No batch can do better there.

    python benchmarks/batch_throughput.py --out benchmarks/results/batch-throughput.json
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import statistics
import tempfile
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read once, when torch loads
os.environ.setdefault("OMP_NUM_THREADS", "1")

from viflow_anomaly.allocator import keep_freed_memory
from viflow_anomaly.batch_job import BatchOptions, run_batch
from viflow_anomaly.batch_workers import Helpers
from viflow_anomaly.benchmarking.machine import (
    QUIET_SHARE,
    Spent,
    circumstances,
    peak_memory_mib,
    spending,
    usable_cores,
)
from viflow_anomaly.benchmarking.made_scene import repeated
from viflow_anomaly.checkpoint_record import write_atomically
from viflow_anomaly.cli.options import load_detector
from viflow_anomaly.config import DetectorConfig, ImageLimits
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.detection import to_json
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
WANTED_SPEED_UP = 1.8
PATIENCE_S = 600.0
MAX_GROWTH_MIB = 24.0
"""Of the largest process from the shortest to the longest recording: what an allocator keeps, and a table of stamps."""


def settings_of(evidence: str) -> Settings:
    return Settings(detector=DetectorConfig(evidence=evidence))  # type: ignore[arg-type]


def run_once(recording: Recording, evidence: str, detector: AnomalyDetector, jobs: int) -> tuple[Spent, list[str]]:
    """One batch run, and its lines without their times."""
    settings = settings_of(evidence)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        helpers = Helpers(jobs - 1, partial(load_detector, settings)) if jobs > 1 else None
        with spending() as spent:
            run_batch(recording, detector, BatchOptions(out_dir=out), helpers=helpers)
        lines = [json.loads(line) for line in (out / "detections.jsonl").read_text().splitlines()]
    return spent, [json.dumps({**line, "timings_ms": None}) for line in lines]


def run_threads(recording: Recording, detector: AnomalyDetector, threads: int) -> Spent:
    """The rival to processes: the same pairs in threads of one process; nothing is written."""
    pairs = RecordingPairs(recording)
    with ThreadPoolExecutor(threads) as pool, spending() as spent:
        for _ in pool.map(lambda index: to_json(detector.analyze(pairs[index]).detection), range(len(pairs))):
            pass
    return spent


def speed_up_apart(folder: Path, evidence: str, *, frames: int, programs: int) -> float:
    """How many times the pairs a second of one program several reach that have nothing to do with each other."""
    alone, together = (_slowest_s(folder, evidence, frames, count) for count in (1, programs))
    return round(programs * alone / together, 3)


def _slowest_s(folder: Path, evidence: str, frames: int, programs: int) -> float:
    context = multiprocessing.get_context("spawn")
    start, answers = context.Barrier(programs), context.Queue()
    started = [
        context.Process(target=_judge_all, args=(folder, evidence, frames, start, answers)) for _ in range(programs)
    ]
    for one in started:
        one.start()
    seconds = [answers.get(timeout=PATIENCE_S) for _ in started]
    for one in started:
        one.join()
    return float(max(seconds))


def _judge_all(folder: Path, evidence: str, frames: int, start: Any, answers: Any) -> None:
    keep_freed_memory()
    recording = repeated(open_recording(folder, limits=ImageLimits()), frames)
    detector = load_detector(settings_of(evidence))
    run_threads(recording, detector, 1)  # warm-up
    start.wait(PATIENCE_S)
    answers.put(run_threads(recording, detector, 1).wall_s)


def compare(recording: Recording, evidence: str, *, jobs: int, rounds: int) -> dict[str, Any]:
    detector = load_detector(settings_of(evidence))
    run_threads(recording, detector, 1)  # warm-up: networks compiled, files in the page cache
    spent: dict[str, list[Spent]] = {"one_job": [], "jobs": [], "threads": []}
    lines: dict[str, list[str]] = {}
    for number in range(rounds):
        for name in spent if number % 2 else reversed(spent):
            if name == "threads":
                spent[name].append(run_threads(recording, detector, jobs))
            else:
                one, lines[name] = run_once(recording, evidence, detector, jobs if name == "jobs" else 1)
                spent[name].append(one)
    pairs = len(recording) - 1
    medians = {name: statistics.median(one.wall_s for one in all_of) for name, all_of in spent.items()}
    cpu = {name: statistics.median(one.cpu_s for one in all_of) for name, all_of in spent.items()}
    return {
        "evidence": evidence,
        "pairs": pairs,
        "jobs": jobs,
        "pairs_per_s": {name: round(pairs / seconds, 1) for name, seconds in medians.items()},
        "wall_s": {name: [round(one.wall_s, 3) for one in all_of] for name, all_of in spent.items()},
        "cpu_ms_a_pair": {name: round(1e3 * seconds / pairs, 2) for name, seconds in cpu.items()},
        "others_share": {name: [_rounded(one.others_share) for one in all_of] for name, all_of in spent.items()},
        "speed_up": round(medians["one_job"] / medians["jobs"], 3),
        "speed_up_of_threads": round(medians["one_job"] / medians["threads"], 3),
        "speed_up_with_free_cores": round(jobs * cpu["one_job"] / cpu["jobs"], 3),
        "identical": lines["one_job"] == lines["jobs"],
        "undisturbed": all(one.undisturbed for all_of in spent.values() for one in all_of),
    }


def _rounded(share: float | None) -> float | None:
    return None if share is None else round(share, 3)


def verdict(one: dict[str, Any]) -> str:
    """Disturbed times may miss the goal without saying anything."""
    if not one["identical"]:
        return "missed: the results differ"
    if one["speed_up"] >= WANTED_SPEED_UP:
        return "met"
    return "missed" if one["undisturbed"] else "open: other programs took part of the cores"


def memory_of(folder: Path, frames: int, jobs: int) -> dict[str, float]:
    """Peaks of one run, in a process of its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        own, helpers = pool.submit(_peaks, folder, frames, jobs).result()
    return {"frames": frames, "jobs": jobs, "process_mib": round(own, 1), "largest_helper_mib": round(helpers, 1)}


def _peaks(folder: Path, frames: int, jobs: int) -> tuple[float, float]:
    keep_freed_memory()
    recording = repeated(open_recording(folder, limits=ImageLimits()), frames)
    detector, ended, helpers = load_detector(settings_of("auto")), threading.Event(), [0.0]

    def watch() -> None:
        while not ended.wait(0.05):
            helpers.extend(peak_memory_mib(child.pid) for child in multiprocessing.active_children())

    watcher = threading.Thread(target=watch)
    watcher.start()
    run_once(recording, "auto", detector, jobs)
    ended.set()
    watcher.join()
    return peak_memory_mib(), max(helpers) if jobs > 1 else 0.0


def markdown(results: Sequence[dict[str, Any]], memory: Sequence[dict[str, float]]) -> str:
    lines = [
        "| evidence | pairs/s, 1 job | N jobs | N threads | speed-up | with free cores | apart | identical | verdict |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for one in results:
        rate = one["pairs_per_s"]
        lines.append(
            f"| {one['evidence']} | {rate['one_job']} | {rate['jobs']} | {rate['threads']} | {one['speed_up']:.2f} | "
            f"{one['speed_up_with_free_cores']:.2f} | {one['speed_up_apart']:.2f} | {one['identical']} | "
            f"{one['verdict']} |"
        )
    lines += ["", "| frames | jobs | process, MiB | largest helper, MiB |", "|---|---|---|---|"]
    lines += [
        f"| {one['frames']:.0f} | {one['jobs']:.0f} | {one['process_mib']:.0f} | {one['largest_helper_mib']:.0f} |"
        for one in memory
    ]
    return "\n".join(lines)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Throughput of batch: one job against one on every core.")
    parser.add_argument(
        "--recording", type=Path, default=ROOT / "samples" / "drone", help="default: the bundled sample"
    )
    parser.add_argument("--frames", type=int, default=1000, help="of the repeated recording (default 1000)")
    parser.add_argument("--jobs", type=int, default=min(usable_cores(), 2), help="default: 2, or the cores there are")
    parser.add_argument("--rounds", type=int, default=3, help="of each kind, alternating (default 3)")
    parser.add_argument("--lengths", default="200,800", help="frames of the runs whose memory is measured; empty: none")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "batch-throughput.json")
    arguments = parser.parse_args()
    if arguments.jobs < 2 or arguments.rounds < 1 or arguments.frames < 2:
        parser.error("expected at least 2 jobs, 1 round and 2 frames")
    return arguments


def main() -> None:
    arguments = parse_arguments()
    keep_freed_memory()  # as the command line does
    about, started = circumstances(), time.monotonic()
    recording = repeated(open_recording(arguments.recording, limits=ImageLimits()), arguments.frames)
    results = [
        compare(recording, evidence, jobs=arguments.jobs, rounds=arguments.rounds) for evidence in ("auto", "residual")
    ]
    for one in results:
        loops = {"frames": min(arguments.frames, 200), "programs": arguments.jobs}
        one["speed_up_apart"] = speed_up_apart(arguments.recording, one["evidence"], **loops)
        one["verdict"] = verdict(one)
    lengths = [int(length) for length in arguments.lengths.split(",") if length]
    memory = [memory_of(arguments.recording, length, jobs) for jobs in (1, arguments.jobs) for length in lengths]
    report = {
        **about,
        "recording": arguments.recording.name,
        "rounds": arguments.rounds,
        "wanted_speed_up": WANTED_SPEED_UP,
        "undisturbed_below_share": QUIET_SHARE,
        "took_s": round(time.monotonic() - started, 1),
        "results": results,
        "memory": memory,
        "memory_flat": _is_flat(memory),
    }
    write_atomically(arguments.out, (json.dumps(report, indent=2) + "\n").encode())
    print(f"{about['cpu']}, {about['cores']} cores, load {about['load_1min']} before the run\n")
    print(markdown(results, memory))


def _is_flat(memory: Sequence[dict[str, float]]) -> bool | None:
    """Whether no process grew with the recording; None where fewer than two lengths were measured."""
    sizes: dict[float, list[float]] = {}
    for one in memory:
        sizes.setdefault(one["jobs"], []).append(max(one["process_mib"], one["largest_helper_mib"]))
    if not all(len(of_jobs) > 1 for of_jobs in sizes.values()) or not sizes:
        return None
    return all(max(of_jobs) - min(of_jobs) <= MAX_GROWTH_MIB for of_jobs in sizes.values())


if __name__ == "__main__":
    main()
