"""A table of motor commands or speeds by time (``motor0/data.csv``), and what it says at each frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from viflow_anomaly.datasets.tables import check_increasing, csv_malformed, read_lines, read_stamped_numbers
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.sensor_data import Float64Array, Int64Array

MAX_AGE_NS = 1_000_000_000
"""An older command says nothing of what the platform does now."""


def read_motor(path: Path, frame_timestamps_ns: Int64Array) -> tuple[tuple[str, ...], Float64Array | None]:
    """Names of the numbers, and for each frame the latest row at or before it: [F, M].

    The first line is ``#timestamp [ns],<names...>``; the rows are in the IMU's clock.

    Args:
        path: the table; without one there are no names and no commands.
        frame_timestamps_ns: [F] in the IMU's clock.

    Raises:
        DatasetError: ``csv_malformed``, ``timestamps_not_increasing``, ``motor_not_covering`` (a frame without any row
            in the second before it), ``text_not_utf8``.
    """
    if not path.is_file():
        return (), None
    names = _names(path)
    stamps, values = read_stamped_numbers(path, ("timestamp", *names), header="comment")
    numbers = [line.number for line in read_lines(path) if not line.text.startswith("#")]
    check_increasing(path, stamps.tolist(), numbers)
    rows = np.searchsorted(stamps, frame_timestamps_ns, side="right") - 1
    ages = frame_timestamps_ns - stamps[rows.clip(0)]
    late = np.flatnonzero((rows < 0) | (ages > MAX_AGE_NS))
    if late.size:
        raise DatasetError(
            f"{path}: expected a row in the second before every frame, found none before frame {late[0]} "
            f"({frame_timestamps_ns[late[0]]}); the rows reach from {stamps[0]} to {stamps[-1]}",
            code="motor_not_covering",
        )
    return names, values[rows]


def _names(path: Path) -> tuple[str, ...]:
    first = next(iter(read_lines(path)), None)
    cells = [] if first is None else [cell.strip() for cell in first.text.split(",")]
    names = tuple(cells[1:])
    if not cells or not cells[0].startswith("#timestamp") or not names or "" in names or len(set(names)) < len(names):
        found = "an empty file" if first is None else repr(first.text[:120])
        problem = f"expected #timestamp [ns] and the names of the columns, each of its own, found {found}"
        raise csv_malformed(path, 1 if first is None else first.number, problem)
    return names
