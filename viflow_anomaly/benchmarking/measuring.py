"""Clocks and memory: subjects take turns on one pair, so that a change of clock speed or load meets all of them."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import ParamSpec, TypeVar

import cv2
import numpy as np

from viflow_anomaly.allocator import keep_freed_memory
from viflow_anomaly.benchmarking.machine import peak_memory_mib
from viflow_anomaly.benchmarking.made_scene import make_pair
from viflow_anomaly.benchmarking.subjects import Run, Subject, load_subject
from viflow_anomaly.sensor_data import FramePair

WARM_UP = 3
"""Networks are compiled, caches filled, memory fetched from the system."""
PAIRS_FOR_PEAK = 5

Given = ParamSpec("Given")
Made = TypeVar("Made")


@dataclass(frozen=True)
class Times:
    """Of one subject on one pair; ``least_ms`` is what other programs disturbed least."""

    median_ms: float
    p95_ms: float
    pairs_per_s: float
    least_ms: float

    @classmethod
    def of(cls, samples_ms: list[float]) -> Times:
        median, p95 = np.percentile(samples_ms, (50, 95))
        rate = 1e3 * len(samples_ms) / sum(samples_ms)
        return cls(round(float(median), 3), round(float(p95), 3), round(rate, 2), round(min(samples_ms), 3))


def take_turns(runs: Mapping[Subject, Run], pair: FramePair, *, repeats: int, budget_s: float) -> dict[Subject, Times]:
    """Everyone once, from another one on each time. A subject that used up ``budget_s`` drops out, after two times."""
    names = list(runs)
    for run in runs.values():
        for _ in range(WARM_UP):
            run(pair)
    taken: dict[Subject, list[float]] = {name: [] for name in names}
    for number in range(repeats):
        first = number % len(names)
        for name in names[first:] + names[:first]:
            if len(taken[name]) >= 2 and sum(taken[name]) > budget_s * 1e3:
                continue
            started = time.perf_counter()
            runs[name](pair)
            taken[name].append((time.perf_counter() - started) * 1e3)
    return {name: Times.of(samples) for name, samples in taken.items()}


def in_own_process(function: Callable[Given, Made], *arguments: Given.args, **named: Given.kwargs) -> Made:
    """Call a function of a module in a new process, so that its peak memory is its own; what it raises is raised."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments, **named).result()


def peak_of(subject: Subject, width: int, height: int, threads: int) -> float:
    """MiB that this process held at most: Python, libraries, weights and a few pairs. For a process of its own."""
    cv2.setNumThreads(threads)
    keep_freed_memory()
    run, pair = load_subject(subject, threads), make_pair(width, height)
    for _ in range(PAIRS_FOR_PEAK):
        run(pair)
    return round(peak_memory_mib(), 1)
