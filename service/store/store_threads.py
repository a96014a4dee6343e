"""Threads for a store's blocking calls, of which one that hangs does not keep the process from ending."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any, ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class StoreThreads(Executor):
    """An executor of daemon threads, first come, first served.

    The interpreter waits at its end for the threads of ``ThreadPoolExecutor``, however long a call takes.

    Args:
        count: of threads; they start with the first call.
        name: of each, with a number behind it.
    """

    def __init__(self, count: int, name: str) -> None:
        self._line: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        self._lock = threading.Lock()
        self._closed = False
        self._running: list[threading.Thread] = []
        self._names = [f"{name}-{number}" for number in range(count)]

    def submit(
        self, fn: Callable[Arguments, Result], /, *args: Arguments.args, **kwargs: Arguments.kwargs
    ) -> Future[Result]:
        """As ``Executor``; RuntimeError once it was shut down."""
        future: Future[Result] = Future()
        with self._lock:
            if self._closed:
                raise RuntimeError("the store is being closed and takes no more calls")
            self._line.put((future, partial(fn, *args, **kwargs)))
            if not self._running:
                self._running = [threading.Thread(target=self._serve, name=name, daemon=True) for name in self._names]
                for thread in self._running:
                    thread.start()
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more calls; ``wait`` for those at work, for as long as they take."""
        with self._lock:
            self._closed = True
            if cancel_futures:
                self._cancel_waiting()
            for _ in self._running:
                self._line.put(None)
        if wait:
            for thread in self._running:
                thread.join()

    def _cancel_waiting(self) -> None:
        with contextlib.suppress(Empty):
            while True:
                if (waiting := self._line.get_nowait()) is not None:
                    waiting[0].cancel()

    def _serve(self) -> None:
        while (taken := self._line.get()) is not None:
            future, call = taken
            if future.set_running_or_notify_cancel():
                try:
                    future.set_result(call())
                except BaseException as err:  # it is the caller's, as with any executor
                    future.set_exception(err)
            del taken, future, call  # what they hold would else be kept until the next one comes
