"""When a request is worth another try, and how long to wait before it."""

from __future__ import annotations

import random
import time
from dataclasses import dataclass
from typing import Final

from viflow_anomaly.client.service_errors import ServiceError, ServiceUnreachableError
from viflow_anomaly.errors import ConfigError

RETRIED_STATUSES: Final = frozenset({408, 429, 502, 503, 504})
_BY_A_PROXY: Final = frozenset({502, 504})
FINAL_CODES: Final = frozenset({"model_load_failed"})
"""Of answers that another try cannot change, whatever their status."""


@dataclass(frozen=True)
class RetryPolicy:
    """A detection changes nothing in the service, and a stream knows a frame that it has: asking twice does no harm.

    Args:
        attempts: at most, the first included.
        first_wait_s: before the second one; doubled for each further one, then taken to 50 to 100 % at random.
        longest_wait_s: between two attempts; a service that asks for more patience (``Retry-After``) gets none.
        total_s: no attempt begins later than this after the first one.

    Raises:
        ConfigError: ``retry_policy_invalid``.
    """

    attempts: int = 5
    first_wait_s: float = 0.2
    longest_wait_s: float = 30.0
    total_s: float = 120.0

    def __post_init__(self) -> None:
        for name, least in (("attempts", 1), ("first_wait_s", 0), ("longest_wait_s", 0), ("total_s", 0)):
            value = getattr(self, name)
            if not least <= value < float("inf"):
                raise ConfigError(
                    f"{name}: expected a finite number of at least {least}, found {value!r}",
                    code="retry_policy_invalid",
                    field=name,
                )


class Attempts:
    """The attempts of one request.

    Attributes:
        answer_uncertain: one of them may have been taken although no answer of the service came.
    """

    def __init__(self, policy: RetryPolicy) -> None:
        self.answer_uncertain = False
        self._policy = policy
        self._started = time.monotonic()
        self._made = 0

    def wait_after(self, error: ServiceError) -> float:
        """Seconds to wait before the next attempt.

        Raises:
            ServiceError: ``error`` itself: another attempt is not worth it, or none is left.
        """
        self._made += 1
        self.answer_uncertain |= isinstance(error, ServiceUnreachableError) or error.status in _BY_A_PROXY
        policy = self._policy
        may_pass = isinstance(error, ServiceUnreachableError) or error.status in RETRIED_STATUSES
        if not may_pass or error.code in FINAL_CODES or self._made >= policy.attempts:
            raise error
        backoff = min(policy.first_wait_s * 2.0 ** min(self._made - 1, 60), policy.longest_wait_s)
        wait_s = max(backoff * random.uniform(0.5, 1.0), error.retry_after_s or 0.0)  # noqa: S311 - spreads clients
        if wait_s > policy.longest_wait_s or time.monotonic() - self._started + wait_s > policy.total_s:
            raise error
        return wait_s
