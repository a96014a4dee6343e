"""How often a client may ask: a bucket of tokens that fills at its rate, and a number of detections a day."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from viflow_anomaly_service.problems import Problem

DAY_SECONDS: Final = 86_400
MAX_CLIENTS: Final = 10_000
"""Clients remembered at once; the one that asked longest ago is forgotten first."""


@dataclass(frozen=True)
class Allowance:
    """What one client may ask for; None: without end.

    Args:
        rate_per_s: requests a second, over a longer time.
        burst: requests at once.
        daily: detections a day (UTC).
    """

    rate_per_s: float | None
    burst: int
    daily: int | None


class _Account:
    def __init__(self, tokens: float, now: float) -> None:
        self.tokens = tokens
        self.filled = now
        self.day = 0
        self.detections = 0


class RateLimiter:
    """Counts in the memory of this process, for at most ``max_clients`` clients.

    Args:
        clock: seconds since 1970, which say the day; a step back of less than a week gives and takes nothing.
        max_clients: see ``MAX_CLIENTS``.
    """

    def __init__(self, clock: Callable[[], float], *, max_clients: int = MAX_CLIENTS) -> None:
        self._clock = clock
        self._max_clients = max_clients
        self._accounts: OrderedDict[str, _Account] = OrderedDict()

    def __len__(self) -> int:
        return len(self._accounts)

    def charge(self, client: str, allowance: Allowance, *, detection: bool) -> None:
        """Count one request.

        Raises:
            Problem: 429 ``rate_limited`` or ``quota_exhausted``, with ``Retry-After``; the request is not counted.
        """
        if allowance.rate_per_s is None and allowance.daily is None:
            return
        now = self._clock()
        account = self._account(client, allowance, now)
        if allowance.rate_per_s is not None:
            self._require_token(account, allowance.rate_per_s, allowance.burst, now)
        if detection and allowance.daily is not None:
            self._require_quota(account, allowance.daily, now)
            account.detections += 1
        account.tokens -= 1.0

    def _account(self, client: str, allowance: Allowance, now: float) -> _Account:
        account = self._accounts.get(client)
        if account is None:
            account = self._accounts[client] = _Account(float(allowance.burst), now)
            if len(self._accounts) > self._max_clients:
                self._accounts.popitem(last=False)
        self._accounts.move_to_end(client)
        return account

    @staticmethod
    def _require_token(account: _Account, rate_per_s: float, burst: int, now: float) -> None:
        gained = max(0.0, now - account.filled) * rate_per_s
        account.tokens = min(float(burst), account.tokens + gained)
        account.filled = now
        if account.tokens < 1.0:
            wait_s = max(1, math.ceil((1.0 - account.tokens) / rate_per_s))
            detail = f"expected at most {rate_per_s:g} requests a second ({burst} at once), found more"
            raise Problem(429, code="rate_limited", detail=detail, retry_after_s=wait_s)

    @staticmethod
    def _require_quota(account: _Account, daily: int, now: float) -> None:
        day = int(now // DAY_SECONDS)
        if day > account.day or day < account.day - 7:  # a clock that was far ahead, and was set right
            account.day, account.detections = day, 0
        if account.detections >= daily:
            wait_s = max(1, math.ceil((day + 1) * DAY_SECONDS - now))
            detail = f"expected at most {daily} detections a day (UTC), found more"
            raise Problem(429, code="quota_exhausted", detail=detail, retry_after_s=wait_s)
