"""One detection as it is stored: its JSON, and beside it what can be asked for."""

from __future__ import annotations

import json
import secrets
import threading
import time
from dataclasses import dataclass, field
from typing import Final

from viflow_anomaly.detection import SCORE_DECIMALS, Detection

ROW_BYTES: Final = 512
"""What a row takes beside its JSON, in both tables and their indexes (measured: 400 to 500)."""
_HEX: Final = 16


class IdMaker:
    """Ids of 32 hexadecimal digits: nanoseconds of the clock, then chance. Later ones of a process are greater."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last_ns = 0

    def __call__(self) -> str:
        with self._lock:
            self._last_ns = max(time.time_ns(), self._last_ns + 1)
            return f"{self._last_ns:0{_HEX}x}{secrets.token_hex(_HEX // 2)}"


def stored_at_ns(detection_id: str) -> int:
    """When the id was made: Unix time in nanoseconds."""
    return int(detection_id[:_HEX], 16)


def first_id_at(time_ns: int) -> str:
    """What all ids made at or after a time are not less than."""
    return f"{max(time_ns, 0):0{_HEX}x}"


@dataclass(frozen=True)
class Record:
    """A row to be.

    Attributes:
        id: see ``IdMaker``.
        body: the detection's JSON, the very text that was answered.
        top_scores: label -> highest score of its regions, as the JSON has it.
        stream_id, session_id: None for ``POST /detect``.
        thumbnail: an image file; None: there is none.
    """

    id: str
    source_timestamp_ns: int
    target_timestamp_ns: int
    body: str
    top_scores: dict[str, float] = field(default_factory=dict)
    stream_id: str | None = None
    session_id: str | None = None
    thumbnail: bytes | None = None

    @property
    def size_bytes(self) -> int:
        return len(self.body.encode()) + ROW_BYTES


@dataclass(frozen=True)
class StoredDetection:
    """A row as it is read."""

    id: str
    stream_id: str | None
    session_id: str | None
    body: str

    def to_json(self) -> str:
        """One line: what is known of the detection, and the detection as it was answered."""
        known = {
            "id": self.id,
            "stored_at_ns": stored_at_ns(self.id),
            "stream_id": self.stream_id,
            "session_id": self.session_id,
        }
        return f'{json.dumps(known, separators=(",", ":"))[:-1]},"detection":{self.body}}}'


def record_of(
    detection: Detection,
    body: str,
    new_id: str,
    *,
    stream_id: str | None = None,
    session_id: str | None = None,
    thumbnail: bytes | None = None,
) -> Record:
    """What is stored of a detection whose JSON is ``body``."""
    top_scores: dict[str, float] = {}
    for roi in detection.rois:
        score = round(float(roi.score), SCORE_DECIMALS)
        top_scores[roi.label] = max(score, top_scores.get(roi.label, score))
    return Record(
        id=new_id,
        source_timestamp_ns=detection.source_timestamp_ns,
        target_timestamp_ns=detection.target_timestamp_ns,
        body=body,
        top_scores=top_scores,
        stream_id=stream_id,
        session_id=session_id,
        thumbnail=thumbnail,
    )
