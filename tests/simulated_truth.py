"""Ground truth beside an EuRoC-style world, without a simulator."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from worlds import World, make_world, write_euroc

from viflow_anomaly.datasets.ground_truth_folder import OBJECT_COLUMNS
from viflow_anomaly.datasets.ground_truth_png import (
    read_depth_png,
    write_depth_png,
    write_flow_png,
    write_instances_png,
)


def add_ground_truth(
    folder: Path, world: World | None = None, *, shift_px: float = 2.0, valid: NDArray[np.bool_] | None = None
) -> Path:
    """A recording in EuRoC layout whose static world moves ``shift_px`` to the left a frame; returns its folder."""
    world = world or make_world(frames=3)
    write_euroc(folder, world)
    truth = folder / "mav0" / "groundtruth0"
    height, width = world.images[0].shape
    flow = np.zeros((height, width, 2), np.float32)
    flow[..., 0] = -shift_px
    known = np.ones((height, width), np.bool_) if valid is None else valid
    for name in ("depth", "static_flow"):
        (truth / name).mkdir(parents=True)
    stamps = world.frame_timestamps_ns.tolist()
    for stamp in stamps:
        write_depth_png(truth / "depth" / f"{stamp}.png", np.full((height, width), 10.0, np.float32))
    for stamp in stamps[:-1]:
        write_flow_png(truth / "static_flow" / f"{stamp}.png", flow, known)
    return folder


def add_movers(folder: Path, *, times: int = 1) -> Path:
    """Two movers in every frame of such a recording: number 1 shifts by 4 px, number 2 by half a pixel.

    Args:
        times: how many times as large they are, and as far from the corner.
    """
    truth = folder / "mav0" / "groundtruth0"
    (truth / "instances").mkdir()
    stamps = sorted(int(path.stem) for path in (truth / "depth").glob("*.png"))
    height, width = read_depth_png(truth / "depth" / f"{stamps[0]}.png").shape
    instances = np.zeros((height, width), np.uint8)
    lines = []
    for thing, flow_px, edges in ((1, 4.0, (30, 10, 44, 20)), (2, 0.5, (5, 30, 15, 40))):
        left, top, right, bottom = (times * edge for edge in edges)
        instances[top:bottom, left:right] = thing
        area_px = (right - left) * (bottom - top)
        lines.append(f"{thing},{area_px},{left},{top},{right - 1},{bottom - 1},{flow_px}")
    rows = [",".join(OBJECT_COLUMNS)]
    for stamp in stamps:
        write_instances_png(truth / "instances" / f"{stamp}.png", instances)
        rows += [f"{stamp},{line}" for line in lines]
    (truth / "objects.csv").write_text("\n".join(rows) + "\n")
    return folder
