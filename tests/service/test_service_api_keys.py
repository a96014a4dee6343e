"""Keys, their file, rate limits and the table of scopes, each alone."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from viflow_anomaly.errors import ConfigError
from viflow_anomaly_service import api_keys
from viflow_anomaly_service.access_rules import (
    is_direct_from_here,
    is_foreign_page,
    is_loopback,
    require_keys_or_loopback,
    required_scope,
)
from viflow_anomaly_service.api_keys import KeyRing, new_key, read_key_file
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.rate_limits import DAY_SECONDS, Allowance, RateLimiter
from viflow_anomaly_service.settings import ServiceSettings

HASH = "sha256:" + "0" * 64


def key_file(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "keys.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_new_key_is_found_and_its_file_does_not_hold_it(tmp_path: Path) -> None:
    key, line = new_key("drone7", ["detect", "read", "detect"])
    path = key_file(tmp_path, "# ours", "", line + " rate=2.5 burst=3 daily=100")
    found = KeyRing(path).find(key)
    assert found is not None
    assert (found.name, found.scopes) == ("drone7", {"detect", "read"})
    assert (found.rate_per_s, found.burst, found.daily) == (2.5, 3, 100)
    assert key.split("_", 2)[2] not in path.read_text()
    assert len(key.split("_", 2)[2]) == 43, "256 bits"


def test_two_keys_differ() -> None:
    assert new_key("a", ["read"])[0] != new_key("a", ["read"])[0]


@given(shown=st.text(max_size=80))
def test_no_other_text_is_a_key(tmp_path_factory: pytest.TempPathFactory, shown: str) -> None:
    key, line = new_key("a", ["read"])
    ring = KeyRing(key_file(tmp_path_factory.mktemp("keys"), line))
    for text in (shown, "vfa_a_" + shown, key + shown if shown else "", key[:-1], key.upper(), "vfa_b_" + key[6:]):
        assert ring.find(text) is None
    assert ring.find(key) is not None


def test_admin_may_do_everything_and_others_what_they_are_for(tmp_path: Path) -> None:
    keys = read_key_file(key_file(tmp_path, f"a admin {HASH}", f"b read {HASH}"))
    assert all(keys["a"].may(scope) for scope in ("detect", "read", "admin", None))
    assert [keys["b"].may(scope) for scope in ("detect", "read", "admin", None)] == [False, True, False, True]


@pytest.mark.parametrize(
    ("lines", "code", "words"),
    [
        (["a detect"], "key_file_invalid", "keys.txt:1: expected NAME SCOPES sha256:HEX, found 2 words"),
        (["", f"A! read {HASH}"], "key_file_invalid", "keys.txt:2: expected a name"),
        ([f"a write {HASH}"], "key_scope_unknown", "keys.txt:1: expected one or more of detect, read, admin"),
        ([f"a read,write {HASH}"], "key_scope_unknown", "found 'read,write'"),
        (["a read vfa_a_geheim"], "key_file_invalid", "found a third word of 12 characters"),
        (["a read sha256:00"], "key_file_invalid", "64 hexadecimal digits"),
        ([f"a read {HASH}", f"a detect {HASH}"], "key_file_invalid", "keys.txt:2: expected a name for each key"),
        ([f"a read {HASH} rate=0"], "key_file_invalid", "'rate=0'"),
        ([f"a read {HASH} rate=1 rate=2"], "key_file_invalid", "each once"),
        ([f"a read {HASH} burst=1.5"], "key_file_invalid", "'burst=1.5'"),
        ([f"a read {HASH} monthly=1"], "key_file_invalid", "'monthly=1'"),
        (["# nothing"], "key_file_invalid", "expected 1 to 10000 keys"),
    ],
)
def test_a_wrong_file_is_named_with_its_line(tmp_path: Path, lines: list[str], code: str, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_key_file(key_file(tmp_path, *lines))
    assert caught.value.code == code
    assert words in caught.value.message
    assert "geheim" not in caught.value.message, "a key put there by mistake must not reach a log"


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "binary").write_bytes(b"a read \xff")
    (tmp_path / "huge").write_bytes(b"#" * (api_keys.MAX_FILE_BYTES + 1))
    for path, code in ((tmp_path / "no", "key_file_unreadable"), (tmp_path, "key_file_unreadable")):
        with pytest.raises(ConfigError, match=str(path)) as caught:
            read_key_file(path)
        assert caught.value.code == code
    for name in ("binary", "huge"):
        with pytest.raises(ConfigError) as caught:
            read_key_file(tmp_path / name)
        assert caught.value.code == "key_file_invalid"


@pytest.mark.parametrize(
    ("name", "scopes", "code"),
    [
        ("Drone", ["read"], "key_name_invalid"),
        ("", ["read"], "key_name_invalid"),
        ("a_b", ["read"], "key_name_invalid"),
        ("a", ["write"], "key_scope_unknown"),
        ("a", [], "key_scope_unknown"),
    ],
)
def test_a_key_has_a_usable_name_and_known_scopes(name: str, scopes: list[str], code: str) -> None:
    with pytest.raises(ConfigError) as caught:
        new_key(name, scopes)
    assert caught.value.code == code


def test_a_changed_file_is_taken_and_a_broken_one_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api_keys, "RECHECK_SECONDS", 0.0)
    (old, old_line), (new, new_line) = new_key("old", ["read"]), new_key("new", ["read"])
    path = key_file(tmp_path, old_line)
    ring = KeyRing(path)

    def rewrite(text: str, stamp: int) -> None:
        path.write_text(text)
        os.utime(path, (stamp, stamp))

    rewrite(new_line, 1_000_000)
    assert (ring.find(old), ring.find(new) is not None) == (None, True)
    rewrite("broken", 2_000_000)
    assert ring.find(new) is not None
    path.unlink()
    assert ring.find(new) is not None
    rewrite(old_line, 3_000_000)
    assert (ring.find(old) is not None, ring.find(new)) == (True, None)


# --- limits


class Clock:
    def __init__(self) -> None:
        self.now = 10.0 * DAY_SECONDS

    def __call__(self) -> float:
        return self.now


def refusal(limiter: RateLimiter, allowance: Allowance, *, detection: bool = True) -> tuple[str, int | None] | None:
    try:
        limiter.charge("a", allowance, detection=detection)
    except Problem as problem:
        return problem.code, problem.retry_after_s
    return None


def test_a_bucket_gives_its_burst_and_then_its_rate() -> None:
    clock = Clock()
    limiter, allowance = RateLimiter(clock), Allowance(rate_per_s=0.5, burst=3, daily=None)
    assert [refusal(limiter, allowance) for _ in range(4)] == [None, None, None, ("rate_limited", 2)]
    with pytest.raises(Problem) as caught:
        limiter.charge("a", allowance, detection=True)
    assert caught.value.status == 429
    clock.now += 2.0
    assert [refusal(limiter, allowance) for _ in range(2)] == [None, ("rate_limited", 2)]
    clock.now += 1000.0
    assert [refusal(limiter, allowance) for _ in range(4)] == [None, None, None, ("rate_limited", 2)]


def test_what_retry_after_says_is_enough() -> None:
    clock = Clock()
    limiter, allowance = RateLimiter(clock), Allowance(rate_per_s=0.3, burst=1, daily=None)
    for _ in range(20):
        assert refusal(limiter, allowance) is None
        refused = refusal(limiter, allowance)
        assert refused is not None
        clock.now += refused[1] or 0


def test_a_quota_ends_with_the_day_and_counts_detections_alone() -> None:
    clock = Clock()
    limiter, allowance = RateLimiter(clock), Allowance(rate_per_s=None, burst=1, daily=2)
    clock.now += DAY_SECONDS - 30.0
    assert [refusal(limiter, allowance) for _ in range(3)] == [None, None, ("quota_exhausted", 30)]
    assert refusal(limiter, allowance, detection=False) is None
    clock.now += 30.0
    assert [refusal(limiter, allowance) for _ in range(3)] == [None, None, ("quota_exhausted", DAY_SECONDS)]


def test_a_clock_that_steps_back_gives_nothing_away() -> None:
    clock = Clock()
    limiter, allowance = RateLimiter(clock), Allowance(rate_per_s=1.0, burst=1, daily=1)
    assert refusal(limiter, allowance) is None
    clock.now -= 2 * DAY_SECONDS
    assert refusal(limiter, allowance) == ("rate_limited", 1)
    clock.now += 1.0
    assert refusal(limiter, allowance) is not None, "the quota of that day was spent"


def test_memory_is_bounded() -> None:
    limiter = RateLimiter(Clock(), max_clients=100)
    for number in range(1000):
        limiter.charge(str(number), Allowance(1.0, 1, None), detection=True)
    assert len(limiter) == 100
    limiter = RateLimiter(Clock())
    limiter.charge("a", Allowance(None, 1, None), detection=True)
    assert len(limiter) == 0, "without limits nobody is remembered"


# --- rules


@pytest.mark.parametrize(
    ("method", "path", "scope"),
    [
        ("POST", "/detect", "detect"),
        ("GET", "/metrics", "read"),
        ("GET", "/models", "read"),
        ("POST", "/models/day/load", "admin"),
        ("PUT", "/models/default", "admin"),
        ("DELETE", "/models/day", "admin"),
        ("GET", "/detections", "read"),
        ("HEAD", "/detections/7", "read"),
        ("POST", "/streams", "detect"),
        ("DELETE", "/streams/7", "detect"),
        ("DELETE", "/detections/7", "admin"),
        ("POST", "/detector", "admin"),
        ("PUT", "/whatever", "admin"),
        ("BREW", "/", "admin"),
        ("GET", "/version", None),
        ("GET", "/versions", "read"),
        ("GET", "/schemas/detection-1.0.json", None),
        ("OPTIONS", "/detect", None),
    ],
)
def test_what_each_request_needs(method: str, path: str, scope: str | None) -> None:
    assert required_scope(method, path) == scope


@pytest.mark.parametrize(
    ("host", "here"),
    [
        ("127.0.0.1", True),
        ("127.9.9.9", True),
        ("::1", True),
        ("[::1]", True),
        ("::ffff:127.0.0.1", True),
        ("localhost", True),
        ("LOCALHOST.", True),
        ("0.0.0.0", False),  # noqa: S104
        ("::", False),
        ("192.168.0.1", False),
        ("::ffff:8.8.8.8", False),
        ("localhost.example", False),
        ("", False),
    ],
)
def test_what_is_loopback(host: str, here: bool) -> None:
    assert is_loopback(host) is here
    settings = ServiceSettings(host=host)
    if here:
        require_keys_or_loopback(settings)
    else:
        with pytest.raises(ConfigError, match=re.escape("viflow-anomaly keys new")) as caught:
            require_keys_or_loopback(settings)
        assert (caught.value.code, caught.value.field) == ("keys_missing", "key_file")
        require_keys_or_loopback(ServiceSettings(host=host, insecure_no_keys=True))
        require_keys_or_loopback(ServiceSettings(host=host, key_file=Path("keys.txt")))


def test_a_proxy_on_this_machine_asks_for_somebody_else() -> None:
    assert is_direct_from_here("127.0.0.1", {})
    assert not is_direct_from_here("10.0.0.1", {})
    for name in ("forwarded", "x-forwarded-for", "x-real-ip"):
        assert not is_direct_from_here("127.0.0.1", {name: "127.0.0.1"})


@pytest.mark.parametrize(
    ("origin", "foreign"),
    [
        (None, False),
        ("http://localhost:3000", False),
        ("http://127.0.0.1:8000", False),
        ("https://dashboard.example", False),
        ("https://other.example", True),
        ("https://dashboard.example.other", True),
        ("null", True),
        ("http://[", True),
    ],
)
def test_which_pages_are_foreign(origin: str | None, foreign: bool) -> None:
    headers = {} if origin is None else {"origin": origin}
    assert is_foreign_page(headers, ("https://dashboard.example",)) is foreign
