"""Who judges the pairs of a batch run: this process alone, or helpers beside it as well, one pair each at a time.

Processes, because a pair's steps are many short calls that hold Python's lock for a fifth (evidence head) to two fifths
(residual) of their time (docs/benchmarks.md). Started anew (spawn): a fork of a process with threads may hang. This
process judges pairs, too, so that nothing stands still while helpers start, and writing is done beside their work.

Answers come in the order of the tasks. Only so many are under way that memory does not grow with the recording.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from multiprocessing.connection import wait
from statistics import median
from typing import TypeVar

from viflow_anomaly.allocator import keep_freed_memory
from viflow_anomaly.batch_pairs import JudgedPair, PairAnalyzer, PairAnswer, PairJudge, PairTask
from viflow_anomaly.config import RigEstimateConfig
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.errors import ViflowError

Made = TypeVar("Made")

QUEUED_PER_HELPER = 3
"""One that is judged, and enough behind it that no helper waits while this process is busy with a pair of its own."""
PAIRS_BEFORE = 6
"""Judged alone to see how long a pair takes; the first ones load and compile what later ones find ready."""
UNKNOWN_PAIR_S = 0.05
"""Where none of them could be judged."""
WORTH_S = 4.0
"""Work that is left for each helper, alone, below which to start one (two seconds) is not worth it."""


@dataclass(frozen=True)
class Helpers:
    """Other processes that judge pairs.

    Attributes:
        count: at most so many.
        make_detector: as the run's own; called there, so it must be a function of a module with plain values.
        worth_s: of work for each of them; with less there are fewer.
    """

    count: int
    make_detector: Callable[[], PairAnalyzer]
    worth_s: float = WORTH_S


def answers_in_order(
    tasks: Iterable[PairTask], pairs: int, judge: PairJudge, helpers: Helpers | None
) -> Generator[PairAnswer, None, None]:
    """The answer to every task, in order. Close it to end the helpers.

    Args:
        tasks: taken one by one; with helpers some ahead of the answers.
        pairs: how many tasks there are at most.
        judge: of this process.
        helpers: None: this process alone.

    Raises:
        ViflowError: ``batch_helper_died``.
    """
    remaining = iter(tasks)
    if helpers is None or helpers.count < 1:
        yield from map(judge, remaining)
        return
    judged_s = []
    for task in islice(remaining, PAIRS_BEFORE):
        started = time.perf_counter()
        answer = judge(task)
        if isinstance(answer, JudgedPair) and answer.status == "ok":  # what cannot be judged takes hardly any time
            judged_s.append(time.perf_counter() - started)
        yield answer
    typical_s = median(judged_s) if judged_s else UNKNOWN_PAIR_S
    left = max(0, pairs - PAIRS_BEFORE)
    count = min(helpers.count, left)
    if left and helpers.worth_s > 0:
        count = min(count, int(typical_s * left / helpers.worth_s))
    if count < 1:
        yield from map(judge, remaining)
        return
    try:
        with _pool(count, judge, helpers.make_detector) as pool:
            yield from _shared(remaining, judge, pool, [_submit(pool, _load) for _ in range(count)])
    except BrokenProcessPool as err:
        raise ViflowError(
            "expected every helper process to answer, found that one ended before its pair was judged (killed, out of "
            "memory, or a crash in native code); what is done is kept: go on with --resume, with --jobs 1 if memory is "
            "short",
            code="batch_helper_died",
            field="jobs",
        ) from err


def _shared(
    tasks: Iterator[PairTask], judge: PairJudge, pool: ProcessPoolExecutor, loaded: list[Future[None]]
) -> Iterator[PairAnswer]:
    """Feed the helpers that are ready, hand out what is answered, and judge a pair here where neither is to be done."""
    under_way: deque[PairAnswer | Future[PairAnswer]] = deque()
    most = QUEUED_PER_HELPER * len(loaded) + 4
    while True:
        ready = sum(_finished(future) for future in loaded)
        waiting = sum(isinstance(one, Future) and not one.done() for one in under_way)
        room = min(QUEUED_PER_HELPER * ready - waiting, most - len(under_way))
        for task in islice(tasks, max(0, room)):
            under_way.append(_submit(pool, _judge, task))
        if under_way and _is_answered(under_way[0]):
            yield _answer(under_way.popleft())
        elif len(under_way) < most and (here := next(tasks, None)) is not None:
            under_way.append(judge(here))
        elif under_way:
            yield _answer(under_way.popleft())
        else:
            return


def _finished(loading: Future[None]) -> bool:
    """Whether a helper has loaded; raises what kept it from that."""
    return loading.done() and loading.result() is None


def _is_answered(one: PairAnswer | Future[PairAnswer]) -> bool:
    return not isinstance(one, Future) or one.done()


def _answer(one: PairAnswer | Future[PairAnswer]) -> PairAnswer:
    return one.result() if isinstance(one, Future) else one


@contextmanager
def _pool(count: int, judge: PairJudge, make_detector: Callable[[], PairAnalyzer]) -> Iterator[ProcessPoolExecutor]:
    """A pool that ends with its block: what nobody has begun is dropped, what is being judged is waited for."""
    pool = ProcessPoolExecutor(
        count,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start,
        initargs=(partial(_made_judge, judge.pairs, make_detector, judge.rig),),
    )
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _submit(pool: ProcessPoolExecutor, function: Callable[..., Made], *arguments: object) -> Future[Made]:
    """Ctrl-C reaches every process of a terminal: helpers are born deaf to it, this process ends them in good order."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return pool.submit(function, *arguments)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


# --- in a helper


def _made_judge(pairs: RecordingPairs, make_detector: Callable[[], PairAnalyzer], rig: RigEstimateConfig) -> PairJudge:
    return PairJudge(pairs, make_detector(), rig)


_make_judge: Callable[[], PairJudge] | None = None
_own_judge: PairJudge | None = None


def _start(make_judge: Callable[[], PairJudge]) -> None:
    global _make_judge  # noqa: PLW0603  # the one way in which a pool's process keeps something
    _make_judge = make_judge
    threading.Thread(target=_end_with_parent, daemon=True).start()
    keep_freed_memory()


def _end_with_parent() -> None:
    """A killed parent cannot tell its helpers that nobody waits for them."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _load() -> None:
    global _own_judge  # noqa: PLW0603
    if _own_judge is None and _make_judge is not None:
        _own_judge = _make_judge()


def _judge(task: PairTask) -> PairAnswer:
    _load()
    assert _own_judge is not None
    return _own_judge(task)
