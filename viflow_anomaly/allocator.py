"""Memory that one pair frees serves the next one: glibc is told not to give it back to the system each time.

A pair takes a few dozen arrays of the image's size. By default glibc returns such blocks to the kernel, and fetching
them anew, page by page, takes a third of a pair's time. Called by programs, never by an import.
"""

from __future__ import annotations

import ctypes
import platform

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
KEPT_BYTES = 256 * 1024 * 1024
"""Freed memory at the heap's end that is kept."""
LARGEST_BLOCK_BYTES = 32 * 1024 * 1024
"""The largest that glibc takes; blocks beyond it still come from the kernel."""


def keep_freed_memory() -> bool:
    """Whether the allocator was told; False where it is not glibc's."""
    if platform.libc_ver()[0] != "glibc":
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    settings = ((M_TRIM_THRESHOLD, KEPT_BYTES), (M_MMAP_THRESHOLD, LARGEST_BLOCK_BYTES))
    return all(mallopt(name, value) == 1 for name, value in settings)
