"""Events posted to a URL, signed, so that the receiver knows who sent them and which it has already."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import hmac
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from http import HTTPStatus
from typing import Final

import httpx

from viflow_anomaly_service.events.courier import ATTEMPT_SECONDS, DeliveryRefusedError
from viflow_anomaly_service.events.event_record import EventRecord

SIGNATURE_HEADER: Final = "X-Viflow-Signature"
EVENT_ID_HEADER: Final = "X-Viflow-Event-Id"
_READ_BYTES: Final = 64 * 1024
_READ_SECONDS: Final = 1.0


def signature(secret: bytes, body: bytes, time_s: int) -> str:
    """What stands in the header: the time of sending, and that time and the body under the secret."""
    digest = hmac.new(secret, str(time_s).encode() + b"." + body, hashlib.sha256).hexdigest()
    return f"t={time_s},v1={digest}"


def webhook_name(url: str) -> str:
    """The same for the same URL, and tells nothing of it: URLs often hold a token."""
    return f"webhook-{hashlib.sha256(url.encode()).hexdigest()[:12]}"


class WebhookSink:
    """A receiver that has taken an event when it answers 2xx; redirects are not followed.

    Args:
        url: http or https.
        secret: shared with the receiver.
    """

    def __init__(self, url: str, secret: str) -> None:
        self._url = url
        self._secret = secret.encode()

    @property
    def name(self) -> str:
        return webhook_name(self._url)

    @asynccontextmanager
    async def session(self) -> AsyncIterator[WebhookSession]:
        async with httpx.AsyncClient(timeout=ATTEMPT_SECONDS, follow_redirects=False) as client:
            yield WebhookSession(client, self._url, self._secret)


class WebhookSession:
    """A receiver is told one event after the other; every attempt may make a connection of its own."""

    def __init__(self, client: httpx.AsyncClient, url: str, secret: bytes) -> None:
        self._client = client
        self._url = url
        self._secret = secret
        self.broken = asyncio.Event()

    async def send(self, event: EventRecord) -> None:
        body = event.body.encode()
        headers = {
            "Content-Type": "application/json",
            "User-Agent": "viflow-anomaly",
            SIGNATURE_HEADER: signature(self._secret, body, int(time.time())),
            EVENT_ID_HEADER: event.event_id,
        }
        status: int | None = None  # what follows it decides nothing: a body that is cut short, or has no end
        try:
            async with (
                asyncio.timeout(ATTEMPT_SECONDS),
                self._client.stream("POST", self._url, content=body, headers=headers) as answer,
            ):
                status = answer.status_code
                await _read_some(answer)
        except TimeoutError:
            if status is None:
                raise DeliveryRefusedError(f"no answer within {ATTEMPT_SECONDS:g} s") from None
        except (httpx.HTTPError, httpx.InvalidURL) as err:
            if status is None:
                raise DeliveryRefusedError(f"no answer: {type(err).__name__}") from err  # its text may hold the URL
        if status is None or not HTTPStatus.OK <= status < HTTPStatus.MULTIPLE_CHOICES:
            raise DeliveryRefusedError(f"answered {status}")


async def _read_some(answer: httpx.Response) -> None:
    """So that the connection can be kept; one who answers at length, or slowly, loses it."""
    read = 0
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_READ_SECONDS):
            async for part in answer.aiter_raw():
                read += len(part)
                if read > _READ_BYTES:
                    return
