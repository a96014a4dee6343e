"""The client that blocks, and what it shares with the one for asyncio: requests, errors, retries."""

from __future__ import annotations

import importlib
import re
import time
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final, Self
from urllib.parse import urlsplit

from viflow_anomaly.client.answers import body_of, object_of
from viflow_anomaly.client.api_key import require_api_key
from viflow_anomaly.client.encoded_pair import EncodedPair
from viflow_anomaly.client.live_events import EVENTS_PATH, Following, LiveEvent
from viflow_anomaly.client.retry_policy import Attempts, RetryPolicy
from viflow_anomaly.client.service_call import ServiceCall
from viflow_anomaly.client.service_errors import ServiceError, ServiceFaultError, ServiceUnreachableError
from viflow_anomaly.client.streaming import ClientStream, stream_options
from viflow_anomaly.detection import Detection
from viflow_anomaly.detection_reading import detection_from_json
from viflow_anomaly.errors import ConfigError, InvalidInputError, MissingDependencyError
from viflow_anomaly.sensor_data import FramePair, PinholeCamera

if TYPE_CHECKING:
    import httpx

DEFAULT_TIMEOUT_S: Final = 60.0
CONNECT_TIMEOUT_S: Final = 10.0
_LABEL: Final = "[A-Za-z0-9_-]{1,63}"
_HOST: Final = re.compile(rf"{_LABEL}(\.{_LABEL})*\.?|[0-9a-fA-F.]*:[0-9a-fA-F:.]*(%[A-Za-z0-9._-]+)?", re.ASCII)
NO_RETRY: Final = RetryPolicy(attempts=1)


class Calling:
    """What both clients share: where the service is, and what a request and its outcome mean."""

    def __init__(
        self,
        base_url: str,
        *,
        api_key: str | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        retries: RetryPolicy | None = None,
    ) -> None:
        self._httpx = _load_httpx()
        self._base_url = _checked_url(base_url)
        if not 0 < timeout_s < float("inf"):
            raise ConfigError(
                f"timeout_s: expected a finite number above 0, found {timeout_s!r}",
                code="timeout_invalid",
                field="timeout_s",
            )
        self._policy = retries or RetryPolicy()
        headers = {"Accept": "application/json, application/problem+json"}
        if api_key is not None:
            headers["Authorization"] = f"Bearer {require_api_key(api_key, 'api_key')}"
        timeout = self._httpx.Timeout(timeout_s, connect=min(timeout_s, CONNECT_TIMEOUT_S))
        self._options: dict[str, Any] = {"base_url": self._base_url, "headers": headers, "timeout": timeout}

    def _opened(self, make: Callable[..., Any]) -> Any:
        try:
            return make(**self._options)
        except (ValueError, ImportError, self._httpx.InvalidURL) as err:
            raise ConfigError(
                f"expected proxies that can be used in HTTP_PROXY, HTTPS_PROXY and ALL_PROXY, found: {err!s:.200}",
                code="proxy_invalid",
                field="url",
            ) from err

    def _detect_call(
        self, pair: FramePair | EncodedPair, include_masks: bool, regions: Mapping[str, Any] | None
    ) -> ServiceCall:
        encoded = EncodedPair.of(pair) if isinstance(pair, FramePair) else pair
        return ServiceCall("POST", "/detect", encoded.parts(include_masks=include_masks, regions=regions))

    def _body(self, response: httpx.Response) -> bytes:
        return body_of(response.status_code, response.headers, response.content, url=self._base_url)

    def _unreachable(self, err: httpx.RequestError) -> ServiceUnreachableError:
        if isinstance(err, self._httpx.TimeoutException):
            found, code = f"none in time ({type(err).__name__})", "service_timeout"
        else:
            found, code = f"{type(err).__name__}: {err}"[:300], "service_unreachable"
        return ServiceUnreachableError(f"{self._base_url}: expected an answer of the service, found {found}", code=code)

    def _ended(self) -> ServiceUnreachableError:
        detail = f"{self._base_url}: expected events without an end, found that the service ended them"
        return ServiceUnreachableError(detail, code="service_unreachable")

    def _detection(self, body: bytes) -> Detection:
        try:
            return detection_from_json(body)
        except InvalidInputError as err:
            raise ServiceFaultError(
                f"{self._base_url}: {err.message}", code="service_answer_unreadable", status=200
            ) from err

    def _object(self, body: bytes) -> dict[str, Any]:
        return object_of(body, url=self._base_url)


class Client(Calling):
    """Asks one service; keeps its connections until ``close`` or the end of a ``with`` block. Threads may share it.

    Args:
        base_url: ``http://127.0.0.1:8000``.
        api_key: sent as a bearer token.
        timeout_s: longest silence in one attempt.
        retries: see ``RetryPolicy``.

    Raises:
        ConfigError: ``service_url_invalid``, ``api_key_invalid``, ``timeout_invalid``, ``proxy_invalid``.
        MissingDependencyError: ``httpx_missing``.
    """

    def __init__(
        self,
        base_url: str,
        *,
        api_key: str | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        retries: RetryPolicy | None = None,
    ) -> None:
        super().__init__(base_url, api_key=api_key, timeout_s=timeout_s, retries=retries)
        self._http = self._opened(self._httpx.Client)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failure: object) -> None:
        self.close()

    def close(self) -> None:
        """End its connections."""
        self._http.close()

    def detect(
        self,
        pair: FramePair | EncodedPair,
        *,
        include_masks: bool = False,
        regions: Mapping[str, Any] | None = None,
    ) -> Detection:
        """What moves by itself in a pair.

        Args:
            pair: arrays (sent as PNG) or files.
            include_masks: add each region's mask.
            regions: settings of ``RegionConfig`` for this pair.

        Raises:
            ServiceError: a child of it.
        """
        return self._detection(self._ask(self._detect_call(pair, include_masks, regions)))

    def version(self) -> dict[str, Any]:
        """Of software, answer and model; raises as ``detect``."""
        return self._object(self._ask(ServiceCall("GET", "/version")))

    def models(self) -> dict[str, Any]:
        """Which weights are loaded, and what computes them; raises as ``detect``."""
        return self._object(self._ask(ServiceCall("GET", "/models")))

    def stream(
        self,
        stream_id: str,
        *,
        camera: PinholeCamera | None = None,
        model: str | None = None,
        include_masks: bool = False,
        regions: Mapping[str, Any] | None = None,
        keep: bool = False,
    ) -> ClientStream:
        """A stream of frames and IMU samples, to be used in a ``with`` block; nothing is sent before its first call.

        Args:
            stream_id: 1 to 64 of ``A-Z a-z 0-9 . _ -``.
            camera: of all frames.
            model: one of ``models()["loaded"]``, as ``name`` or ``name@version``; None: the service's default.
            include_masks, regions: as for ``detect``.
            keep: leave the stream to the service when the block ends, for somebody who goes on with it; one that was
                there before the block is left in any case.
        """
        options = stream_options(model, include_masks, regions)
        return ClientStream(
            self._ask, self._base_url, stream_id, self._policy, keep=keep, camera=camera, options=options
        )

    def follow_events(
        self, *, after: str | None = None, filters: Mapping[str, str] | None = None
    ) -> Iterator[LiveEvent]:
        """Events as they happen, without an end, across broken connections: from the first on none is missed.

        Args:
            after: the id of the last event that is known; None: from now on.
            filters: query parameters of ``GET /events/live``.

        Raises:
            ServiceError: when connections fail as often as ``RetryPolicy`` allows, one after the other.
        """
        following = Following(self._base_url, self._policy, after=after, filters=filters)
        while True:
            try:
                with self._http.stream(
                    "GET", EVENTS_PATH, params=following.parameters, headers=following.headers()
                ) as response:
                    if response.status_code != 200:
                        response.read()
                        self._body(response)
                        return  # 204: no more
                    following.require_events(response.headers)
                    for chunk in response.iter_bytes():
                        yield from following.events_in(chunk)
                wait_s = following.wait_after(self._ended())
            except self._httpx.RequestError as err:
                wait_s = following.wait_after(self._unreachable(err))
            except ServiceError as err:
                wait_s = following.wait_after(err)
            time.sleep(wait_s)

    def is_ready(self) -> bool:
        """Whether it would answer ``detect`` now; one attempt, and False where nothing answers."""
        try:
            self._ask(ServiceCall("GET", "/readyz"), Attempts(NO_RETRY))
        except ServiceError:
            return False
        return True

    def _ask(self, call: ServiceCall, attempts: Attempts | None = None) -> bytes:
        attempts = attempts or Attempts(self._policy)
        while True:
            try:
                return self._body(self._http.request(call.method, call.path, **call.options))
            except self._httpx.RequestError as err:
                wait_s = attempts.wait_after(self._unreachable(err))
            except ServiceError as err:
                wait_s = attempts.wait_after(err)
            time.sleep(wait_s)


def _load_httpx() -> Any:
    try:
        return importlib.import_module("httpx")
    except ImportError as err:
        raise MissingDependencyError(
            "expected the package httpx, found none; install it with: pip install 'viflow-anomaly[client]'",
            code="httpx_missing",
        ) from err


def _checked_url(text: str) -> str:
    try:
        parts = urlsplit(text)
        host, secret, _ = parts.hostname or "", parts.username or parts.password, parts.port
        usable = _HOST.fullmatch(host) is not None and text.isprintable() and " " not in text
    except ValueError:
        secret, usable, parts = None, False, urlsplit("")
    if parts.scheme not in ("http", "https") or not usable or secret or parts.query or parts.fragment:
        shown = "one with a user name or password" if secret else f"{text!r:.200}"
        raise ConfigError(
            f"expected the address of a service such as http://127.0.0.1:8000, found {shown}",
            code="service_url_invalid",
            field="url",
        )
    return text.rstrip("/")
