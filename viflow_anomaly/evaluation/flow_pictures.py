"""Flow as pictures: the colour wheel, and correspondences between two frames. Needs the extra ``plots``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.evaluation.flow_truth import BoolArray
from viflow_anomaly.evaluation.plot_style import PAGE_IN, SavedPicture, drawing, saved
from viflow_anomaly.geometry import Float32Array, pixel_grid
from viflow_anomaly.sensor_data import Uint8Array

SCALE_PERCENTILE = 95.0
"""The colours are full at this percentile of the true flow's length; longer flow looks alike."""
UNKNOWN_GRAY = 128
WHEEL_PX = 151
WHEEL_IN = 1.2
WIDE = 2.0
"""Images of this width over height lie two in a row and below each other, others three in a row and side by side."""
ARROWS_ACROSS = 14
GAP_PX = 6
LATTICE = (8, 4)
"""(columns, rows) of the points whose correspondences are drawn."""


def flow_colours(flow_px: Float32Array, scale_px: float) -> Uint8Array:
    """[H, W, 3] RGB: hue is the direction (red: right), white is no motion, full colour from ``scale_px`` on; gray
    where ``flow_px`` [H, W, 2] is not finite."""
    known: BoolArray = np.asarray(np.isfinite(flow_px).all(axis=-1))
    flow = np.where(known[..., None], flow_px, 0).astype(np.float32)
    turn = np.arctan2(flow[..., 1], flow[..., 0]) / (2 * np.pi) % 1.0
    length = np.minimum(np.linalg.norm(flow, axis=-1) / max(scale_px, 1e-6), 1.0)
    hsv = np.stack([360 * turn, length, 1 - 0.15 * length], axis=-1).astype(np.float32)
    rgb = np.asarray(np.rint(255 * cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)), dtype=np.uint8)
    rgb[~known] = UNKNOWN_GRAY
    return rgb


def flow_wheel_picture(
    source: Uint8Array, true_px: Float32Array, valid: BoolArray, flows: Mapping[str, Float32Array], stem: Path
) -> SavedPicture:
    """The source image, the true flow and what methods found, all in one scale, with the wheel as legend.

    Arrows on a lattice repeat the direction for who cannot tell the colours apart.

    Args:
        source: [H, W].
        true_px: [H, W, 2]; valid [H, W] where it is known.
        flows: method -> [H, W, 2], NaN where it has no estimate.
        stem: of the files.

    Raises:
        InvalidInputError: ``plot_empty`` without a valid pixel; as ``drawing``.
    """
    scale_px = _scale(true_px, valid)
    truth = np.where(valid[..., None], true_px, np.float32(np.nan))
    height, width = source.shape
    panels = {"ground truth": truth, **flows}
    columns = 2 if width >= WIDE * height else 3
    rows = len(panels) // columns + 1  # the source image is one more
    panel_width = (PAGE_IN - WHEEL_IN) / columns
    height_in = rows * (panel_width * height / width + 0.24) + 0.1
    with drawing(stem, width_in=PAGE_IN, height_in=max(height_in, 1.7)) as figure:
        grid = figure.add_gridspec(rows, columns + 1, width_ratios=(*[1.0] * columns, WHEEL_IN / panel_width))
        cells = [(row, column) for row in range(rows) for column in range(columns)]
        axes = figure.add_subplot(grid[cells[0]])
        axes.imshow(source, cmap="gray", vmin=0, vmax=255)
        _bare(axes, "source")
        for (name, flow), cell in zip(panels.items(), cells[1:], strict=False):
            axes = figure.add_subplot(grid[cell])
            axes.imshow(flow_colours(flow, scale_px), interpolation="nearest")
            _arrows(axes, flow)
            _bare(axes, name)
        _wheel(figure.add_subplot(grid[:, columns]), scale_px)
    return saved(stem)


def correspondence_picture(
    source: Uint8Array,
    target: Uint8Array,
    true_px: Float32Array,
    valid: BoolArray,
    predicted_px: Float32Array,
    stem: Path,
    *,
    label: str = "predicted",
) -> SavedPicture:
    """Both frames, and where points of a lattice go: true (circles, solid) against predicted (crosses, dashed).

    Args:
        source, target: [H, W].
        true_px, predicted_px: [H, W, 2]; valid [H, W] where the true one is known.
        stem: of the files.
        label: of the predicted flow.

    Raises:
        InvalidInputError: ``plot_empty`` when no point of the lattice has both; as ``drawing``.
    """
    height, width = source.shape
    side_by_side = width < WIDE * height
    points = _lattice(valid & np.isfinite(predicted_px).all(axis=-1), skewed_rows=side_by_side)
    if not len(points):
        raise InvalidInputError(
            "correspondences: expected a lattice point with true and predicted flow, found none", code="plot_empty"
        )
    shift = np.array((width + GAP_PX, 0) if side_by_side else (0, height + GAP_PX))
    canvas = np.full((height + int(shift[1]), width + int(shift[0])), 255, np.uint8)
    canvas[:height, :width] = source
    canvas[int(shift[1]) :, int(shift[0]) :] = target
    starts = points.astype(np.float64)
    flow_at = (true_px[points[:, 1], points[:, 0]], predicted_px[points[:, 1], points[:, 0]])
    with drawing(stem, width_in=PAGE_IN, height_in=PAGE_IN * canvas.shape[0] / canvas.shape[1] + 0.5) as figure:
        axes = figure.add_subplot()
        axes.imshow(canvas, cmap="gray", vmin=0, vmax=255)
        # The true line is the wider one, and shows beside and between the dashes of the other.
        styles = (("true", "#56B4E9", "-", "o", 1.8, 6.0), (label, "#D55E00", "--", "x", 0.9, 4.5))
        for flow, (name, color, line, marker, width_pt, size) in zip(flow_at, styles, strict=True):
            ends = starts + flow + shift
            for start, end in zip(starts, ends, strict=True):
                axes.plot(*zip(start, end, strict=True), color=color, ls=line, lw=width_pt)
            marked: dict[str, Any] = {"color": color, "marker": marker, "mfc": "none", "ms": size, "mew": 1.4}
            axes.plot(*ends.T, ls="none", **marked)
            axes.plot([], [], ls=line, lw=width_pt, label=name, **marked)
        axes.plot(*starts.T, color="#CC79A7", ls="none", marker=".", ms=4, label="source")
        axes.set_xlim(-0.5, canvas.shape[1] - 0.5)
        axes.set_ylim(canvas.shape[0] - 0.5, -0.5)
        _bare(axes, None)
        figure.legend(loc="outside upper center", ncols=3)
    return saved(stem)


def _scale(true_px: Float32Array, valid: BoolArray) -> float:
    if not valid.any():
        raise InvalidInputError("flow: expected a pixel with true flow, found none", code="plot_empty")
    return max(float(np.percentile(np.linalg.norm(true_px[valid], axis=-1), SCALE_PERCENTILE)), 0.1)


def _lattice(usable: BoolArray, *, skewed_rows: bool) -> np.ndarray[Any, np.dtype[np.int64]]:
    """[N, 2] (u, v) of usable points on a skewed lattice: lines to the other frame do not cover each other."""
    height, width = usable.shape
    columns, rows = LATTICE
    column, row = np.meshgrid(np.arange(columns), np.arange(rows))
    if skewed_rows:
        u, v = (column + 0.5) / columns, (row + (column + 0.5) / columns) / rows
    else:
        u, v = (column + (row + 0.5) / rows) / columns, (row + 0.5) / rows
    points = np.stack([u * width, v * height], axis=-1).reshape(-1, 2).astype(np.int64)
    return np.asarray(points[usable[points[:, 1], points[:, 0]]])


def _arrows(axes: Any, flow: Float32Array) -> None:
    step = max(1, flow.shape[1] // ARROWS_ACROSS)
    at = pixel_grid(*flow.shape[:2])[step // 2 :: step, step // 2 :: step].reshape(-1, 2)
    vectors = flow[step // 2 :: step, step // 2 :: step].reshape(-1, 2)
    known = np.isfinite(vectors).all(axis=-1)
    lengths = np.linalg.norm(vectors[known], axis=-1, keepdims=True)
    unit = vectors[known] / np.maximum(lengths, 1e-6) * np.minimum(lengths, 1.0) * 0.7 * step
    axes.quiver(
        *at[known].T, *unit.T, angles="xy", scale_units="xy", scale=1, width=0.003, color="#303030", pivot="mid"
    )


def _wheel(axes: Any, scale_px: float) -> None:
    middle = (WHEEL_PX - 1) / 2
    flow = (pixel_grid(WHEEL_PX, WHEEL_PX) - np.float32(middle)) / np.float32(middle) * np.float32(scale_px)
    colours = flow_colours(flow, scale_px)
    colours[np.linalg.norm(flow, axis=-1) > scale_px] = 255
    axes.imshow(colours, interpolation="nearest")
    axes.annotate("", (WHEEL_PX - 1, middle), (middle, middle), arrowprops={"arrowstyle": "->", "lw": 0.8})
    axes.set_xlabel(f"radius: {scale_px:.1f} px\nlonger: the same")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(visible=False)
    for side in axes.spines.values():
        side.set_visible(False)


def _bare(axes: Any, title: str | None) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(visible=False)
    if title is not None:
        axes.set_title(title)
