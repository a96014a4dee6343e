"""A cache that counts bytes: what it holds never grows with the number of image sizes that were seen."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import Lock
from typing import Generic, TypeVar

MEBIBYTE = 1024 * 1024
CACHE_ENTRY_BYTES = 4096
"""What is counted for a cached value beside its arrays, so that their number is bounded, too."""

Cached = TypeVar("Cached")


class ArrayCache(Generic[Cached]):
    """Values by key; the least recently used ones go while all together take more than ``max_bytes``.

    A value larger than that is made anew each time. Threads may share a cache: values are made outside its lock, and
    where two threads make the same one, both get the first.
    """

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self.held_bytes = 0
        self._entries: OrderedDict[Hashable, tuple[Cached, int]] = OrderedDict()
        self._lock = Lock()

    def get(self, key: Hashable, make: Callable[[], Cached], bytes_of: Callable[[Cached], int]) -> Cached:
        """The value of ``key``: the one that is held, or what ``make`` gives."""
        with self._lock:
            if key in self._entries:
                self._entries.move_to_end(key)
                return self._entries[key][0]
        made = make()
        size = bytes_of(made) + CACHE_ENTRY_BYTES
        with self._lock:
            if key in self._entries:
                return self._entries[key][0]
            if size <= self.max_bytes:
                self._entries[key] = (made, size)
                self.held_bytes += size
            while self.held_bytes > self.max_bytes:
                self.held_bytes -= self._entries.popitem(last=False)[1][1]
        return made
