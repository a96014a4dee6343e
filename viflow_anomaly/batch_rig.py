"""``rig_estimate.jsonl``: what each pair of a batch run said of the rig, so that a resumed run knows it again.

The estimate itself is a function of these lines in time order. A line is written ahead of the pair's detection, so that
a killed run leaves none without. The file is there only where the detector tells how the camera turned.
"""

from __future__ import annotations

import json
from pathlib import Path

from viflow_anomaly.batch_files import Stamps
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.rig_estimate import TurnObservation


class RigJournal:
    """The observations of an earlier run, and where new ones go.

    Opening it drops what stands behind the first line that is cut or unreadable.

    What a line says stays on disk: only where it stands is in memory, however long the recording.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lines: dict[Stamps, tuple[int, int]] = {}  # offset, length
        if not path.exists():
            return
        end = 0
        with path.open("r+b") as file:
            for raw in file:
                entry = _parse_line(raw)
                if entry is None:
                    break
                self._lines[entry[0]] = end, len(raw)
                end += len(raw)
            file.truncate(end)

    def lacks(self, stamps: Stamps) -> bool:
        """Whether others were written down and this one was lost (a power cut): its pair is judged once more."""
        return bool(self._lines) and stamps not in self._lines

    def __len__(self) -> int:
        return len(self._lines)

    def observation(self, stamps: Stamps) -> TurnObservation | None:
        """What that pair said; None: nothing, or it is not there."""
        if stamps not in self._lines:
            return None
        offset, length = self._lines[stamps]
        with self._path.open("rb") as file:
            file.seek(offset)
            entry = _parse_line(file.read(length))
        return None if entry is None else entry[1]

    def append(self, stamps: Stamps, observation: TurnObservation | None) -> None:
        """Add one pair's; it survives a killed process at once."""
        told = None if observation is None else observation.to_json()
        line = {"source_timestamp_ns": stamps[0], "target_timestamp_ns": stamps[1], "observation": told}
        raw = json.dumps(line).encode() + b"\n"
        with self._path.open("ab") as file:
            self._lines[stamps] = file.tell(), len(raw)
            file.write(raw)


def _parse_line(raw: bytes) -> tuple[Stamps, TurnObservation | None] | None:
    """None for a line that was cut or that is none of ours."""
    if not raw.endswith(b"\n"):
        return None
    try:
        values = json.loads(raw)
        stamps = int(values["source_timestamp_ns"]), int(values["target_timestamp_ns"])
        told = values["observation"]
        return stamps, None if told is None else TurnObservation.from_json(stamps, told)
    except (ValueError, KeyError, TypeError, InvalidInputError):
        return None
