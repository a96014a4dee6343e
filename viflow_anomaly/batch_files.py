"""The files of one batch run, and how they survive a power cut.

::

    OUT/detections.jsonl          one ROI JSON object a line, in time order; appears whole or not at all
    OUT/detections.jsonl.partial  the journal of a run that has not ended; a line for each pair that is done
    OUT/run.json                  configuration, model, versions, counts, failures ("state": running or done)
    OUT/rig_estimate.jsonl        what each pair said of the IMU and its mounting; see batch_rig.py
    OUT/overlays/<source_ns>.png  on request
    OUT/overlay.mp4               on request; its frames wait in OUT/overlay.mp4.partial/
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

from viflow_anomaly.detection_reading import detection_from_json
from viflow_anomaly.errors import InvalidInputError

DETECTIONS_NAME = "detections.jsonl"
JOURNAL_NAME = "detections.jsonl.partial"
RUN_NAME = "run.json"
RIG_NAME = "rig_estimate.jsonl"
OVERLAYS_NAME = "overlays"
VIDEO_NAME = "overlay.mp4"
VIDEO_FRAMES_NAME = "overlay.mp4.partial"
_SYNC_EVERY_S = 2.0

Stamps = tuple[int, int]


@dataclass(frozen=True)
class JournalLine:
    """Where a finished detection stands in the journal, and its status (``ok`` or ``abstained``)."""

    offset: int
    length: int
    status: str


class Journal:
    """Append-only work file: each line is the finished detection of one pair, in the order in which they ended.

    Opening it recovers what an earlier run left: everything up to the first line that is cut or unreadable is kept,
    the rest is dropped. It is locked, so that two runs cannot write into one directory.

    Attributes:
        lines: (source, target) stamps -> the line of that pair.

    Raises:
        InvalidInputError: ``output_in_use``.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("a+b")
        if not _is_alone(self._file, path):
            self._file.close()
            raise InvalidInputError(
                f"{path.parent}: expected to be the only run that writes there, found another one at work",
                code="output_in_use",
                field="out",
            )
        self.lines: dict[Stamps, JournalLine] = {}
        self._end = self._recover()
        self._synced_at = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def _recover(self) -> int:
        self._file.seek(0)
        end = 0
        for raw in self._file:
            entry = _parse_line(raw)
            if entry is None:
                break
            stamps, status = entry
            self.lines[stamps] = JournalLine(end, len(raw), status)
            end += len(raw)
        self._file.truncate(end)
        return end

    def append(self, stamps: Stamps, status: str, text: str) -> None:
        """Add one detection. It survives a killed process at once, a power cut two seconds later."""
        raw = text.encode() + b"\n"
        self._file.write(raw)
        self._file.flush()
        self.lines[stamps] = JournalLine(self._end, len(raw), status)
        self._end += len(raw)
        if time.monotonic() - self._synced_at > _SYNC_EVERY_S:
            os.fsync(self._file.fileno())
            self._synced_at = time.monotonic()

    def clear(self) -> None:
        """Forget every line."""
        self._file.truncate(0)
        self._end = 0
        self.lines.clear()

    def text(self, stamps: Stamps) -> bytes:
        """The line of one pair, with its newline."""
        line = self.lines[stamps]
        self._file.seek(line.offset)
        return self._file.read(line.length)

    def publish(self, destination: Path, finish: Callable[[Iterator[bytes]], Iterable[bytes]] = iter) -> None:
        """Write all lines to ``destination`` (whole or not at all).

        Args:
            destination: of the lines.
            finish: given all lines in time order, says what is written in their place.
        """
        temporary = destination.with_name(f".{destination.name}.sorted")
        with temporary.open("wb") as sorted_file:
            sorted_file.writelines(finish(self.text(stamps) for stamps in sorted(self.lines)))
            sorted_file.flush()
            os.fsync(sorted_file.fileno())
        temporary.replace(destination)

    def remove(self) -> None:
        """Remove the journal, as the last act of a run: until then nobody else may begin one there."""
        self._path.unlink()


def _is_alone(file: BinaryIO, path: Path) -> bool:
    """Lock the file; False where another run has, or has just removed it since it was opened."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except (BlockingIOError, FileNotFoundError):
        return False


def _parse_line(raw: bytes) -> tuple[Stamps, str] | None:
    """Stamps and status of a whole line, None for one that was cut."""
    if not raw.endswith(b"\n"):
        return None
    try:
        detection = detection_from_json(raw)
    except InvalidInputError:
        return None
    return (detection.source_timestamp_ns, detection.target_timestamp_ns), detection.status


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write an indented JSON file; a reader sees the old one or the new one, never a part."""
    temporary = path.with_name(f".{path.name}.new")
    with temporary.open("w", encoding="utf-8") as file:
        json.dump(values, file, indent=2)
        file.write("\n")
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def read_run(out_dir: Path) -> dict[str, Any] | None:
    """``run.json`` of an earlier run, or None where there is none.

    Raises:
        InvalidInputError: ``resume_run_unreadable``.
    """
    path = out_dir / RUN_NAME
    try:
        run = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except ValueError as err:
        raise InvalidInputError(
            f"{path}: expected the record of an earlier run, found no JSON document: {err}",
            code="resume_run_unreadable",
            field="out",
        ) from err
    if not isinstance(run, dict):
        raise InvalidInputError(
            f"{path}: expected the record of an earlier run, found a JSON {type(run).__name__}",
            code="resume_run_unreadable",
            field="out",
        )
    return run


def clear_results(out_dir: Path) -> None:
    """Remove what a batch run writes (its journal aside), and nothing else that may lie there."""
    for name in (DETECTIONS_NAME, RUN_NAME, RIG_NAME, VIDEO_NAME):
        (out_dir / name).unlink(missing_ok=True)
    for name, pattern in ((OVERLAYS_NAME, "*.png"), (VIDEO_FRAMES_NAME, "*.png")):
        folder = out_dir / name
        for picture in folder.glob(pattern):
            if picture.stem.isdigit():
                picture.unlink()
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def reopen_results(out_dir: Path) -> None:
    """Make the results of a run that ended the start of a new journal, unless a journal is there already."""
    finished, journal = out_dir / DETECTIONS_NAME, out_dir / JOURNAL_NAME
    if finished.exists() and not journal.exists():
        temporary = out_dir / f".{JOURNAL_NAME}.new"
        shutil.copyfile(finished, temporary)
        temporary.replace(journal)
