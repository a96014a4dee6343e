"""The formats that can be read, and which of them a folder is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from viflow_anomaly.config import ImageLimits
from viflow_anomaly.datasets import euroc, kitti_odometry, kitti_odometry_raw, kitti_raw, plain
from viflow_anomaly.datasets.recording import FileRecording, Recording
from viflow_anomaly.errors import DatasetError


class OpenRecording(Protocol):
    """Reads the folder that the format's ``find_root`` returned."""

    def __call__(self, root: Path, *, camera: str | None, limits: ImageLimits) -> FileRecording: ...


@dataclass(frozen=True)
class Reader:
    """One format.

    Args:
        find_root: the folder to read for a path, or None when the path is not of this format.
        open: reads that folder.
        needs: what makes a folder one of this format, for messages.
    """

    find_root: Callable[[Path], Path | None]
    open: OpenRecording
    needs: str


# A folder that fits several formats is read as the first of them.
READERS: dict[str, Reader] = {
    "euroc": Reader(euroc.find_root, euroc.open_euroc, euroc.NEEDS),
    "kitti_raw": Reader(kitti_raw.find_root, kitti_raw.open_kitti_raw, kitti_raw.NEEDS),
    "kitti_odometry": Reader(kitti_odometry.find_root, kitti_odometry.open_kitti_odometry, kitti_odometry.NEEDS),
    "kitti_odometry_raw": Reader(
        kitti_odometry_raw.find_root, kitti_odometry_raw.open_kitti_odometry_raw, kitti_odometry_raw.NEEDS
    ),
    "plain": Reader(plain.find_root, plain.open_plain, plain.NEEDS),
}


def recognise(path: Path | str) -> str:
    """The format of a folder, by its content; the first of ``READERS`` that fits.

    Raises:
        DatasetError: ``directory_missing``, ``not_a_directory``, ``layout_unknown``.
    """
    folder = _directory(path)
    for name, reader in READERS.items():
        if reader.find_root(folder) is not None:
            return name
    raise _unknown(folder, READERS)


def open_recording(
    path: Path | str,
    *,
    format: str | None = None,  # noqa: A002 - the name of the command-line option
    camera: str | None = None,
    limits: ImageLimits | None = None,
) -> Recording:
    """Open a recording; its tables are read and checked now, its images when they are asked for.

    Args:
        path: a folder; for EuRoC ``mav0`` or its parent.
        format: a key of ``READERS``; None recognises it by content.
        camera: which of several cameras (EuRoC ``cam1``, KITTI ``image_03``); None takes the format's default.
        limits: on every image; None for the defaults.

    Raises:
        DatasetError: ``directory_missing``, ``not_a_directory``, ``layout_unknown``, ``format_unknown``, and what the
            reader raises; each names the file, the line and the reason.
    """
    folder = _directory(path)
    name = recognise(folder) if format is None else format
    if name not in READERS:
        raise DatasetError(
            f"format: expected one of {', '.join(READERS)}, found {name!r}", code="format_unknown", field="format"
        )
    root = READERS[name].find_root(folder)
    if root is None:
        raise _unknown(folder, {name: READERS[name]})
    return READERS[name].open(root, camera=camera, limits=limits or ImageLimits())


def _directory(path: Path | str) -> Path:
    folder = Path(path)
    if folder.is_dir():
        return folder
    if folder.exists():
        raise DatasetError(f"{folder}: expected a directory, found a file", code="not_a_directory")
    raise DatasetError(f"{folder}: expected a directory, found nothing there", code="directory_missing")


def _unknown(folder: Path, wanted: dict[str, Reader]) -> DatasetError:
    needs = "; ".join(f"{name} needs {reader.needs}" for name, reader in wanted.items())
    names = sorted(entry.name + ("/" if entry.is_dir() else "") for entry in folder.iterdir())
    found = ", ".join(names[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "")
    return DatasetError(
        f"{folder}: expected a known layout ({needs}), found {found or 'an empty directory'}", code="layout_unknown"
    )
