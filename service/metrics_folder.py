"""The folder in which several processes keep their numbers; those that a killed service has left behind are removed."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

MEMORY_FOLDER: Final = "/dev/shm"  # noqa: S108 - the folder made in it is the process's own
PREFIX: Final = "viflow-metrics-"
HELD_FILE: Final = "held"
"""Locked as long as the service or one of its processes lives."""
MAKING_SECONDS: Final = 60.0
"""A folder that is younger may be about to be locked."""


@contextlib.contextmanager
def metrics_folder() -> Iterator[str]:
    """A new folder until the block ends. Processes that are forked inside hold it, too."""
    place = _memory_folder() or tempfile.gettempdir()
    _remove_abandoned(Path(place))
    with tempfile.TemporaryDirectory(prefix=PREFIX, dir=place) as folder, (Path(folder) / HELD_FILE).open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        yield folder


def _memory_folder() -> str | None:
    """In memory, which can be written to in a read-only container, too."""
    return MEMORY_FOLDER if os.access(MEMORY_FOLDER, os.W_OK) else None


def _remove_abandoned(place: Path) -> None:
    """What a service whose parent was killed could not remove; of other users nothing can be."""
    for held in place.glob(f"{PREFIX}*/{HELD_FILE}"):
        with contextlib.suppress(OSError), held.open("r+") as lock:
            if time.time() - held.stat().st_mtime > MAKING_SECONDS:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(held.parent)
