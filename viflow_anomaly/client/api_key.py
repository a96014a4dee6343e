"""The key that a client shows, from a file that holds nothing else."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from viflow_anomaly.errors import ConfigError

_KEY: Final = re.compile(r"[!-~]{1,512}", re.ASCII)
_MAX_BYTES: Final = 4096


def read_api_key(path: Path) -> str:
    """The one line of a file.

    Raises:
        ConfigError: ``api_key_unreadable``, ``api_key_invalid``.
    """
    try:
        with path.open("rb") as file:
            text = file.read(_MAX_BYTES).decode("utf-8", "replace").strip()
    except OSError as err:
        raise ConfigError(
            f"{path}: expected a file that holds an API key, found: {err.strerror}",
            code="api_key_unreadable",
            field="key_file",
        ) from err
    if " sha256:" in text:
        raise ConfigError(
            f"{path}: expected the API key itself, found a line of the service's key file, which holds its hash",
            code="api_key_invalid",
            field="key_file",
        )
    return require_api_key(text, str(path))


def require_api_key(key: str, where: str) -> str:
    """``key``, which can stand in a header; the message never quotes it.

    Raises:
        ConfigError: ``api_key_invalid``.
    """
    if not _KEY.fullmatch(key):
        raise ConfigError(
            f"{where}: expected an API key of up to 512 printable ASCII characters, found {len(key)} characters that "
            "are none",
            code="api_key_invalid",
            field="api_key",
        )
    return key
