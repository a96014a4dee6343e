"""How pictures look: legible in print and by the colour-blind, the same bytes for the same data.

matplotlib is an extra and is imported when a picture is made. pyplot is never used, so that no backend is chosen and no
figure is registered in the user's process; settings hold while a picture is made.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from viflow_anomaly.checkpoint_record import write_atomically
from viflow_anomaly.errors import MissingDependencyError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMN_IN, PAGE_IN = 3.5, 7.16
"""Widths of a column and of a page in a two-column paper, in inches."""
PNG_DPI = 200

# Okabe and Ito 2008, black first; gray stands for their yellow, whose lines vanish on white paper.
OKABE_ITO = ("#000000", "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00", "#CC79A7", "#7F7F7F")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")
LINES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)), (0, (8, 2)))

SETTINGS: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#D0D0D0",
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.2,
    "lines.markersize": 5,
    "pdf.fonttype": 42,
    "text.usetex": False,
}
"""8 pt is the smallest text, at the width that a picture is made for."""


class Look(NamedTuple):
    """Colour, marker and line of one series; two series differ in all three."""

    color: str
    marker: str
    line: Any


def look(index: int) -> Look:
    """The look of the index-th series."""
    return Look(OKABE_ITO[index % len(OKABE_ITO)], MARKERS[index % len(MARKERS)], LINES[index % len(LINES)])


def require_matplotlib() -> None:
    """Find out before a long measurement that pictures cannot be made.

    Raises:
        MissingDependencyError: ``plots_unavailable``.
    """
    if find_spec("matplotlib") is None:
        raise MissingDependencyError(
            "plots: expected matplotlib, found it missing: pip install 'viflow-anomaly[plots]'",
            code="plots_unavailable",
            field="plots",
        )


class SavedPicture(NamedTuple):
    """The two files of a picture."""

    png: Path
    pdf: Path


@contextmanager
def drawing(stem: Path, *, width_in: float = COLUMN_IN, height_in: float = 2.4) -> Iterator[Figure]:
    """An empty figure; when the block ends it is written to ``stem`` + ``.png`` and ``.pdf``, atomically.

    Raises:
        MissingDependencyError: as ``require_matplotlib``.
        OSError: as ``write_atomically``.
    """
    require_matplotlib()
    from matplotlib import rc_context, rcdefaults, rcParams  # noqa: PLC0415  # an extra
    from matplotlib.figure import Figure  # noqa: PLC0415

    with rc_context():
        rcdefaults()  # the user's own matplotlibrc must not change the bytes
        cast("dict[str, Any]", rcParams).update(SETTINGS)
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        yield figure
        _write(figure, saved(stem))


def file_name(text: str) -> str:
    """What is safe in a file's name on any system."""
    return "".join(character if character.isalnum() or character in "-_.+" else "_" for character in text)


def saved(stem: Path) -> SavedPicture:
    """Where ``drawing(stem)`` writes."""
    return SavedPicture(stem.with_name(stem.name + ".png"), stem.with_name(stem.name + ".pdf"))


def _write(figure: Figure, paths: SavedPicture) -> None:
    png, pdf = io.BytesIO(), io.BytesIO()
    figure.savefig(png, format="png", dpi=PNG_DPI, metadata={"Software": None})
    figure.savefig(pdf, format="pdf", metadata={"CreationDate": None, "Producer": None, "Creator": None})
    write_atomically(paths.png, png.getvalue())
    write_atomically(paths.pdf, pdf.getvalue())
