"""The cache that counts bytes."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest

from viflow_anomaly.array_cache import CACHE_ENTRY_BYTES, ArrayCache


def cached(cache: ArrayCache[bytes], key: str, kibibytes: int = 1) -> bytes:
    return cache.get(key, lambda: bytes(1024 * kibibytes), len)


def cache_for(entries: int) -> ArrayCache[bytes]:
    """Of as many entries of 1 KiB as said."""
    return ArrayCache(entries * (1024 + CACHE_ENTRY_BYTES))


def test_the_least_recently_used_value_goes_first() -> None:
    cache = cache_for(2)
    a, b = cached(cache, "a"), cached(cache, "b")
    assert cached(cache, "a") is a
    cached(cache, "c")
    assert cached(cache, "a") is a
    assert cached(cache, "b") is not b


@pytest.mark.parametrize("kibibytes", [1, 5, 10, 11, 40])
def test_a_cache_never_holds_more_than_its_limit(kibibytes: int) -> None:
    cache = cache_for(3)
    for key in "abcabdeaf":
        assert len(cached(cache, key, kibibytes)) == 1024 * kibibytes
        assert cache.held_bytes <= cache.max_bytes


def test_a_value_beyond_the_limit_drives_no_other_out() -> None:
    cache = cache_for(2)
    a = cached(cache, "a")
    assert cached(cache, "large", 100) is not cached(cache, "large", 100)
    assert cached(cache, "a") is a


def test_threads_that_make_the_same_value_get_the_same_one() -> None:
    cache, together = cache_for(4), Barrier(4, timeout=30)

    def make() -> bytes:
        together.wait()  # all four have looked before any has made it
        return bytes(1024)

    with ThreadPoolExecutor(4) as threads:
        values = list(threads.map(lambda _: cache.get("a", make, len), range(4)))
    assert len({id(value) for value in values}) == 1
    assert cache.held_bytes == 1024 + CACHE_ENTRY_BYTES


def test_what_fails_is_not_held() -> None:
    cache = cache_for(2)
    with pytest.raises(ZeroDivisionError):
        cache.get("a", lambda: bytes(1 // 0), len)
    assert cache.held_bytes == 0
    assert cached(cache, "a") == bytes(1024)
