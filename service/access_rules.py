"""Which endpoint needs which scope, who may come without a key, and where the service may listen without any."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Mapping
from typing import Final, NamedTuple
from urllib.parse import urlsplit

from viflow_anomaly.errors import ConfigError
from viflow_anomaly_service.api_keys import Scope
from viflow_anomaly_service.settings import ServiceSettings

OPEN_PATHS: Final = frozenset({"/healthz", "/readyz"})
_PAGE_FILES: Final = "/dashboard/"
_LOOKING_ON: Final = re.compile(r"/streams/[^/]+/(live|pairs|pairs/[^/]+/[^/]+)")
"""What shows a stream to who may read; the rest below ``/streams`` is for who brings frames."""
SAFE_METHODS: Final = frozenset({"GET", "HEAD", "OPTIONS"})
_FORWARDED: Final = ("forwarded", "x-forwarded-for", "x-real-ip")


class _Rule(NamedTuple):
    methods: frozenset[str] | None
    """None: all."""
    prefix: str
    scope: Scope | None
    """None: any key."""


_READING: Final = frozenset({"GET", "HEAD"})
_POSTING: Final = frozenset({"POST"})
# First match wins. What no line names needs ``admin``, so that a new endpoint is closed until somebody opens it.
_RULES: Final = (
    _Rule(frozenset({"OPTIONS"}), "/", None),
    _Rule(_READING, "/version", None),
    _Rule(_READING, "/schemas", None),
    _Rule(_READING, "/openapi.json", None),
    _Rule(_READING, "/docs", None),
    _Rule(None, "/streams", "detect"),
    _Rule(_POSTING, "/detect", "detect"),
    _Rule(None, "/events/deliveries", "admin"),
    _Rule(_POSTING, "/inspect", "detect"),
    _Rule(_READING, "/", "read"),
)


def is_open(path: str) -> bool:
    """Whether everybody may ask: probes, and the dashboard's files, which hold no data."""
    return path in OPEN_PATHS or path == "/" or path.startswith(_PAGE_FILES)


def required_scope(method: str, path: str) -> Scope | None:
    """The scope that a request needs, or None where any key will do."""
    if method in _READING and _LOOKING_ON.fullmatch(path):
        return "read"
    for rule in _RULES:
        inside = rule.prefix in ("/", path) or path.startswith(rule.prefix + "/")
        if inside and (rule.methods is None or method in rule.methods):
            return rule.scope
    return "admin"


def is_loopback(host: str) -> bool:
    """Whether a name or an address means this machine alone."""
    if host.rstrip(".").lower() in {"localhost", "ip6-localhost"}:
        return True
    try:
        address = ipaddress.ip_address(host.strip("[]").partition("%")[0])
    except ValueError:
        return False
    mapped = getattr(address, "ipv4_mapped", None)
    return bool((mapped or address).is_loopback)


def is_direct_from_here(client: str, headers: Mapping[str, str]) -> bool:
    """Whether a program on this machine asks for itself, and not a proxy for somebody else."""
    return is_loopback(client) and not any(name in headers for name in _FORWARDED)


def is_foreign_page(headers: Mapping[str, str], allowed_origins: tuple[str, ...], method: str = "GET") -> bool:
    """Whether a web page of another site sent the request: a browser would let any page post to this machine.

    What changes something comes with its page's origin, or is at least said to come from another site; what only reads
    may come without either, but its answer is not given to the page.
    """
    origin = headers.get("origin")
    if origin is None:
        return method not in SAFE_METHODS and headers.get("sec-fetch-site") == "cross-site"
    return origin not in allowed_origins and not is_loopback(_host_of(origin))


def is_own_page(headers: Mapping[str, str]) -> bool:
    """Whether the service's own page sent the request, by whatever name its reader knows the service: the browser says
    so (behind a proxy, too), or an old one asks where the page came from."""
    if (site := headers.get("sec-fetch-site")) is not None:
        return site == "same-origin"
    return headers.get("origin", "").partition("://")[2].lower() == headers.get("host", "").lower()


def is_foreign_name(headers: Mapping[str, str], allowed_origins: tuple[str, ...]) -> bool:
    """Whether the request was sent to a name that is neither this machine's nor an allowed origin's.

    Whoever owns a name may let it point here (DNS rebinding): to a browser the service is then that site's own.
    """
    host = headers.get("host")
    if not host:
        return False
    name = _host_of(f"//{host}")
    return not is_loopback(name) and name not in map(_host_of, allowed_origins)


def _host_of(url: str) -> str:
    """The host's name, or nothing where there is none."""
    try:
        return urlsplit(url).hostname or ""
    except ValueError:
        return ""


def require_keys_or_loopback(settings: ServiceSettings) -> None:
    """Nothing, unless other machines could reach a service that asks for no key.

    Raises:
        ConfigError: ``keys_missing``.
    """
    if settings.key_file is not None or settings.insecure_no_keys or is_loopback(settings.host):
        return
    raise ConfigError(
        f"expected API keys where other machines can reach the service ({settings.host}), found none; make one with "
        "`viflow-anomaly keys new --scope detect`, put its line into a file and name the file in VIFLOW_KEY_FILE (in a "
        "container: mount it, -v ./keys.txt:/keys.txt:ro -e VIFLOW_KEY_FILE=/keys.txt); or listen on 127.0.0.1; or say "
        "that everybody may ask: --insecure-no-keys, VIFLOW_INSECURE_NO_KEYS=true",
        code="keys_missing",
        field="key_file",
    )
