"""API keys: made here, kept in a file as hashes, looked up by name, compared in constant time.

A line of the key file is ``NAME SCOPES sha256:HEX`` and, where the defaults do not fit, ``rate=PER_SECOND``,
``burst=REQUESTS`` and ``daily=DETECTIONS``. A key holds 256 random bits that nobody can guess or try, so that a plain
SHA-256 keeps it safe at rest; a slow hash is for secrets that people think up, and would let anybody keep the service
busy with wrong ones.
"""

from __future__ import annotations

import hashlib
import hmac
import logging
import os
import re
import secrets
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, get_args

from viflow_anomaly.errors import ConfigError

logger = logging.getLogger(__name__)

Scope = Literal["detect", "read", "admin"]
SCOPES: Final[tuple[str, ...]] = get_args(Scope)
MAX_KEYS: Final = 10_000
MAX_FILE_BYTES: Final = 4 * 1024 * 1024
RECHECK_SECONDS: Final = 1.0
_PREFIX: Final = "vfa"
_SECRET_BYTES: Final = 32
_NAME: Final = re.compile(r"[a-z0-9][a-z0-9-]{0,31}", re.ASCII)
_HASH: Final = re.compile(r"sha256:([0-9a-f]{64})", re.ASCII)
_LIMIT: Final = re.compile(r"(rate|burst|daily)=(\d{1,9}(?:\.\d{1,6})?)", re.ASCII)
_NOBODY: Final = bytes(32)
"""Compared where a name is unknown, so that the time does not tell which names exist."""


@dataclass(frozen=True)
class ApiKey:
    """One line of the key file.

    Args:
        name: who uses it; stands in the log.
        scopes: what it may do; ``admin`` may do everything.
        digest: SHA-256 of the whole key.
        rate_per_s: requests a second, over a longer time; None: the service's default.
        burst: requests at once; None: the service's default.
        daily: detections a day; None: the service's default.
    """

    name: str
    scopes: frozenset[str]
    digest: bytes
    rate_per_s: float | None = None
    burst: int | None = None
    daily: int | None = None

    def may(self, scope: Scope | None) -> bool:
        """Whether it reaches ``scope``; None: any key does."""
        return scope is None or scope in self.scopes or "admin" in self.scopes


def new_key(name: str, scopes: Iterable[str]) -> tuple[str, str]:
    """A fresh key, to be shown once, and the line for the key file.

    Raises:
        ConfigError: ``key_name_invalid``, ``key_scope_unknown``.
    """
    wanted = list(dict.fromkeys(scopes))
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"--name: expected up to 32 of a-z, 0-9 and '-', found {name!r:.80}", code="key_name_invalid", field="name"
        )
    _require_scopes(wanted, "--scope")
    key = f"{_PREFIX}_{name}_{secrets.token_urlsafe(_SECRET_BYTES)}"
    return key, f"{name} {','.join(wanted)} sha256:{_digest(key).hex()}"


def _digest(key: str) -> bytes:
    return hashlib.sha256(key.encode("utf-8", "surrogateescape")).digest()


def _require_scopes(scopes: list[str], where: str) -> None:
    if not scopes or not set(scopes) <= set(SCOPES):
        raise ConfigError(
            f"{where}: expected one or more of {', '.join(SCOPES)}, found {','.join(scopes)!r:.80}",
            code="key_scope_unknown",
            field="scope",
        )


def read_key_file(path: Path) -> dict[str, ApiKey]:
    """The keys of a file by their names; empty lines and lines that start with ``#`` are passed over.

    Raises:
        ConfigError: ``key_file_unreadable``, ``key_file_invalid`` with the line at fault, ``key_scope_unknown``.
    """
    try:
        with path.open("rb") as file:
            text = file.read(MAX_FILE_BYTES + 1)
        lines = text.decode("utf-8").splitlines()
    except OSError as err:
        found = err.strerror or str(err)
        raise ConfigError(
            f"{path}: expected a readable key file, found: {found}", code="key_file_unreadable", field="key_file"
        ) from err
    except UnicodeDecodeError as err:
        raise _invalid(f"{path}", "text in UTF-8", f"byte {err.object[err.start]:#x}") from err
    if len(text) > MAX_FILE_BYTES:
        raise _invalid(f"{path}", f"at most {MAX_FILE_BYTES} bytes", "more")
    keys: dict[str, ApiKey] = {}
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        key = _key_of(line, f"{path}:{number}")
        if key.name in keys:
            raise _invalid(f"{path}:{number}", "a name for each key", f"{key.name!r} a second time")
        keys[key.name] = key
    if not 1 <= len(keys) <= MAX_KEYS:
        raise _invalid(f"{path}", f"1 to {MAX_KEYS} keys (`viflow-anomaly keys new` makes one)", str(len(keys)))
    return keys


def _key_of(line: str, where: str) -> ApiKey:
    words = line.split()
    if len(words) < 3:
        raise _invalid(where, "NAME SCOPES sha256:HEX", f"{len(words)} words")
    name, scopes = words[0], words[1].split(",")
    if not _NAME.fullmatch(name):
        raise _invalid(where, "a name of up to 32 of a-z, 0-9 and '-'", f"{name!r:.40}")
    _require_scopes(scopes, where)
    digest = _HASH.fullmatch(words[2])
    if digest is None:  # not quoted: somebody may have put the key itself there
        raise _invalid(where, "sha256: and 64 hexadecimal digits", f"a third word of {len(words[2])} characters")
    limits = _limits_of(words[3:], where)
    whole = {name: int(value) for name, value in limits.items() if name != "rate"}
    return ApiKey(name, frozenset(scopes), bytes.fromhex(digest[1]), rate_per_s=limits.get("rate"), **whole)


def _limits_of(words: list[str], where: str) -> dict[str, float]:
    limits: dict[str, float] = {}
    for word in words:
        found = _LIMIT.fullmatch(word)
        if found is None or found[1] in limits or float(found[2]) <= 0 or ("." in found[2] and found[1] != "rate"):
            raise _invalid(where, "rate=PER_SECOND, burst=REQUESTS or daily=DETECTIONS, each once", f"{word!r:.40}")
        limits[found[1]] = float(found[2])
    return limits


def _invalid(where: str, expected: str, found: str) -> ConfigError:
    return ConfigError(f"{where}: expected {expected}, found {found}", code="key_file_invalid", field="key_file")


class KeyRing:
    """The keys of a file, read again when it changes: a key is added or taken away without a restart.

    A changed file that cannot be used leaves the keys as they were, and says so in the log.

    Raises:
        ConfigError: as ``read_key_file``, on construction only.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stamp = _stamp_of(path)
        self._keys: Mapping[str, ApiKey] = read_key_file(path)
        self._checked = time.monotonic()

    def find(self, presented: str) -> ApiKey | None:
        """The key that a client showed, or None."""
        self._refresh()
        parts = presented.split("_", 2)
        key = self._keys.get(parts[1]) if len(parts) == 3 else None
        matches = hmac.compare_digest(_digest(presented), _NOBODY if key is None else key.digest)
        return key if matches else None

    def _refresh(self) -> None:
        now = time.monotonic()
        if now - self._checked < RECHECK_SECONDS:
            return
        self._checked = now
        stamp = _stamp_of(self._path)
        if stamp == self._stamp:
            return
        self._stamp = stamp
        try:
            self._keys = read_key_file(self._path)
        except ConfigError as err:
            logger.error("key_file_not_taken", extra={"reason": err.message})  # noqa: TRY400 - ours: no traceback
        else:
            logger.info("key_file_taken", extra={"keys": len(self._keys)})


def _stamp_of(path: Path) -> tuple[int, int, int] | None:
    try:
        status = os.stat(path)  # noqa: PTH116 - Path.stat is the same and slower
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino
