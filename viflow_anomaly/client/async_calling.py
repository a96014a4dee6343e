"""The client for asyncio: ``calling.Client`` with every method awaited."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from typing import Any, Self

from viflow_anomaly.client.calling import DEFAULT_TIMEOUT_S, NO_RETRY, Calling
from viflow_anomaly.client.encoded_pair import EncodedPair
from viflow_anomaly.client.live_events import EVENTS_PATH, Following, LiveEvent
from viflow_anomaly.client.retry_policy import Attempts, RetryPolicy
from viflow_anomaly.client.service_call import ServiceCall
from viflow_anomaly.client.service_errors import ServiceError
from viflow_anomaly.client.streaming import AsyncClientStream, stream_options
from viflow_anomaly.detection import Detection
from viflow_anomaly.sensor_data import FramePair, PinholeCamera


class AsyncClient(Calling):
    """``Client`` for asyncio: the same arguments, methods and errors."""

    def __init__(
        self,
        base_url: str,
        *,
        api_key: str | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        retries: RetryPolicy | None = None,
    ) -> None:
        super().__init__(base_url, api_key=api_key, timeout_s=timeout_s, retries=retries)
        self._http = self._opened(self._httpx.AsyncClient)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *failure: object) -> None:
        await self.close()

    async def close(self) -> None:
        """End its connections."""
        await self._http.aclose()

    async def detect(
        self,
        pair: FramePair | EncodedPair,
        *,
        include_masks: bool = False,
        regions: Mapping[str, Any] | None = None,
    ) -> Detection:
        """As ``Client.detect``."""
        return self._detection(await self._ask(self._detect_call(pair, include_masks, regions)))

    async def version(self) -> dict[str, Any]:
        """As ``Client.version``."""
        return self._object(await self._ask(ServiceCall("GET", "/version")))

    async def models(self) -> dict[str, Any]:
        """As ``Client.models``."""
        return self._object(await self._ask(ServiceCall("GET", "/models")))

    def stream(
        self,
        stream_id: str,
        *,
        camera: PinholeCamera | None = None,
        model: str | None = None,
        include_masks: bool = False,
        regions: Mapping[str, Any] | None = None,
        keep: bool = False,
    ) -> AsyncClientStream:
        """As ``Client.stream``, for ``async with``."""
        options = stream_options(model, include_masks, regions)
        return AsyncClientStream(
            self._ask, self._base_url, stream_id, self._policy, keep=keep, camera=camera, options=options
        )

    async def follow_events(
        self, *, after: str | None = None, filters: Mapping[str, str] | None = None
    ) -> AsyncIterator[LiveEvent]:
        """As ``Client.follow_events``, for ``async for``."""
        following = Following(self._base_url, self._policy, after=after, filters=filters)
        while True:
            try:
                async with self._http.stream(
                    "GET", EVENTS_PATH, params=following.parameters, headers=following.headers()
                ) as response:
                    if response.status_code != 200:
                        await response.aread()
                        self._body(response)
                        return
                    following.require_events(response.headers)
                    async for chunk in response.aiter_bytes():
                        for event in following.events_in(chunk):
                            yield event
                wait_s = following.wait_after(self._ended())
            except self._httpx.RequestError as err:
                wait_s = following.wait_after(self._unreachable(err))
            except ServiceError as err:
                wait_s = following.wait_after(err)
            await asyncio.sleep(wait_s)

    async def is_ready(self) -> bool:
        """As ``Client.is_ready``."""
        try:
            await self._ask(ServiceCall("GET", "/readyz"), Attempts(NO_RETRY))
        except ServiceError:
            return False
        return True

    async def _ask(self, call: ServiceCall, attempts: Attempts | None = None) -> bytes:
        attempts = attempts or Attempts(self._policy)
        while True:
            try:
                return self._body(await self._http.request(call.method, call.path, **call.options))
            except self._httpx.RequestError as err:
                wait_s = attempts.wait_after(self._unreachable(err))
            except ServiceError as err:
                wait_s = attempts.wait_after(err)
            await asyncio.sleep(wait_s)
