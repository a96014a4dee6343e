"""Who a WebSocket is for: its key may come in the handshake or in the first message, and is asked for again later."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

PROTOCOL: Final = "viflow.v1"
"""The subprotocol that the service speaks; browsers that offer a key offer this one beside it."""
_KEY_PROTOCOL: Final = "viflow.key."
_OPENED_BY_MESSAGE: Final = "/streams/"


def offered_key(subprotocols: Sequence[str]) -> str | None:
    """The key that a browser, which cannot set headers, hides among the subprotocols; it is never sent back."""
    return next((one.removeprefix(_KEY_PROTOCOL) for one in subprotocols if one.startswith(_KEY_PROTOCOL)), None)


def may_come_later(path: str) -> bool:
    """Whether what answers there asks for the key itself; the others are closed to who shows none."""
    return path.startswith(_OPENED_BY_MESSAGE)


class SocketAccess:
    """The right to go on, in ``scope["viflow_access"]``.

    Args:
        charge: checks a key and counts a request (True: a detection); raises Problem.
        key: that was shown in the handshake, None: none.
        pending: one is needed and was not shown yet.
    """

    def __init__(self, charge: Callable[[str | None, bool], None], *, key: str | None, pending: bool) -> None:
        self._charge = charge
        self._key = key
        self.pending = pending

    def admit(self, key: str | None) -> None:
        """Take the key of the first message.

        Raises:
            Problem: 401, 403 or 429.
        """
        self._charge(key, False)
        self._key = key
        self.pending = False

    def charge_detection(self) -> None:
        """Count a message.

        Raises:
            Problem: 401 for a key that was taken away; 429.
        """
        self._charge(self._key, True)
