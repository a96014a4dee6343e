"""Thin things at several depths: railings, bare trees, rows of poles, wires, scaffolds, leaning bars.

Where a model's depth is a little wrong, or smoother than the world, their edges leave narrow residuals; none of them
moves. Off by default (``SimulatorConfig.thin_structures``), drawn from a generator of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from viflow_anomaly.sensor_data import Float64Array
from viflow_anomaly.simulator import street, surroundings
from viflow_anomaly.simulator.motion import axis_rotations
from viflow_anomaly.simulator.road import Road
from viflow_anomaly.simulator.roadside import KERB_TOP_M, Layout
from viflow_anomaly.simulator.scene import Mover, Solid
from viflow_anomaly.simulator.shapes import UPRIGHT, box, moved, turned
from viflow_anomaly.simulator.surroundings import KeepClear

TRIES = 12
NEAREST_M, FARTHEST_M = 1.2, 16.0
BEYOND_THE_DRIVE_M = 45.0
LIE_ALONG_X = axis_rotations(1, np.array([np.pi / 2]))[0]


def beside_the_path(
    rng: np.random.Generator, count: int, camera_poses: Float64Array, movers: tuple[Mover, ...], materials: list[str]
) -> tuple[Solid, ...]:
    """``count`` things in what a drone sees: before a camera pose of [F, 4, 4], near ones as often as far ones."""

    def place() -> tuple[Float64Array, Float64Array]:
        spot = surroundings.spot_ahead(rng, camera_poses, nearest_m=NEAREST_M, farthest_m=FARTHEST_M)
        return spot, turned(float(rng.uniform(0, 2 * np.pi)))

    clear = KeepClear.around(camera_poses[:, :3, 3], movers, clearance_m=surroundings.CLEARANCE_M)
    return _placed(rng, count, place, clear, materials)


def along_the_road(
    rng: np.random.Generator,
    count: int,
    road: Road,
    layout: Layout,
    arc_m: Float64Array,
    camera_path_m: Float64Array,
    movers: tuple[Mover, ...],
    materials: list[str],
) -> tuple[Solid, ...]:
    """``count`` things on both sides of the road, from where the car starts to beyond where it ends.

    ``arc_m`` [F] and ``camera_path_m`` [F, 3] say where the car is along the road and its camera in the world.
    """
    driven = np.arange(arc_m[0], arc_m[-1] + BEYOND_THE_DRIVE_M, 1.0)

    def place() -> tuple[Float64Array, Float64Array]:
        s = np.array([rng.uniform(driven[0] + 3.0, driven[-1])])
        left = rng.random() < 0.5
        edge = layout.left_edge if left else -layout.right_edge
        lateral = edge + 0.3 + 10.0 * rng.random() ** 2
        spot = road.position(s, lateral if left else -lateral)[0]
        turn = float(rng.choice((0.0, rng.normal(0, 0.1), rng.uniform(0, np.pi))))
        return np.array([*spot, KERB_TOP_M]), turned(float(road.heading(s)[0]) + turn)

    line = np.column_stack([road.position(driven), np.ones(len(driven))])
    clear = KeepClear.around(np.concatenate([line, camera_path_m]), movers, clearance_m=street.CLEARANCE_M)
    return _placed(rng, count, place, clear, materials)


def _placed(
    rng: np.random.Generator,
    count: int,
    place: Callable[[], tuple[Float64Array, Float64Array]],
    clear: KeepClear,
    materials: list[str],
) -> tuple[Solid, ...]:
    """Each kind in turn, drawn again elsewhere until it stands clear."""
    solids: list[Solid] = []
    for index in range(count):
        for _ in range(TRIES):
            thing = moved(KINDS[index % len(KINDS)](rng, str(rng.choice(materials))), *place())
            if clear.allows(thing):
                solids.extend(thing)
                break
    return tuple(solids)


def _upright(radius_m: float, height_m: float, x_m: float, material: str, *, y_m: float = 0.0) -> Solid:
    centre = np.array([x_m, y_m, height_m / 2])
    return Solid("cylinder", (radius_m, height_m / 2, 0.0), centre, UPRIGHT, material)


def _lying(radius_m: float, length_m: float, height_m: float, material: str) -> Solid:
    return Solid("cylinder", (radius_m, length_m / 2, 0.0), np.array([0, 0, height_m]), LIE_ALONG_X, material)


def _between(start_m: Float64Array, end_m: Float64Array, radius_m: float, material: str) -> Solid:
    """A round bar from one point to another."""
    along = end_m - start_m
    length = float(np.linalg.norm(along))
    tilt = axis_rotations(1, np.array([np.arccos(along[2] / length)]))[0]
    rotation = turned(float(np.arctan2(along[1], along[0]))) @ tilt
    return Solid("cylinder", (radius_m, length / 2, 0.0), (start_m + end_m) / 2, rotation, material)


def railing(rng: np.random.Generator, material: str) -> tuple[Solid, ...]:
    """Posts and two to four rails; half of them have balusters."""
    length, height, radius = rng.uniform(2.0, 6.0), rng.uniform(0.8, 1.3), rng.uniform(0.015, 0.04)
    posts = [_upright(radius, height, x, material) for x in np.linspace(-length / 2, length / 2, int(length) + 1)]
    rails = [_lying(radius * 0.7, length, h, material) for h in np.linspace(height, 0.15, int(rng.integers(2, 5)))]
    spacing = rng.uniform(0.12, 0.3) if rng.random() < 0.5 else length
    at = np.arange(-length / 2, length / 2, spacing)[1:]
    return (*posts, *rails, *(_upright(radius * 0.4, height, x, material) for x in at))


def bare_tree(rng: np.random.Generator, material: str) -> tuple[Solid, ...]:
    """A trunk, branches and a twig on each."""
    height, girth = rng.uniform(1.5, 4.5), rng.uniform(0.04, 0.14)
    parts = [_upright(girth, height, 0.0, material)]
    for _ in range(int(rng.integers(6, 13))):
        bearing, rise, length = rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 1.2), rng.uniform(0.4, 1.8)
        start = np.array([0.0, 0.0, rng.uniform(0.4, 1.0) * height])
        along = length * np.array([np.cos(bearing) * np.cos(rise), np.sin(bearing) * np.cos(rise), np.sin(rise)])
        radius = girth * rng.uniform(0.15, 0.45)
        parts.append(_between(start, start + along, radius, material))
        twig = 0.5 * length * np.array([np.cos(bearing + 0.8), np.sin(bearing + 0.8), rng.uniform(0.1, 1.0)])
        parts.append(_between(start + 0.6 * along, start + 0.6 * along + twig, radius * 0.5, material))
    return tuple(parts)


def pole_row(rng: np.random.Generator, material: str) -> tuple[Solid, ...]:
    """Two to five poles in a line."""
    height, radius, spacing = rng.uniform(1.2, 5.0), rng.uniform(0.02, 0.08), rng.uniform(0.4, 2.0)
    count = int(rng.integers(2, 6))
    return tuple(_upright(radius, height, (k - (count - 1) / 2) * spacing, material) for k in range(count))


def wires(rng: np.random.Generator, material: str) -> tuple[Solid, ...]:
    """One to three wires between two poles."""
    length, height = rng.uniform(3.0, 12.0), rng.uniform(1.8, 5.0)
    poles = [_upright(float(rng.uniform(0.03, 0.08)), height, x, material) for x in (-length / 2, length / 2)]
    heights = height - rng.uniform(0.2, 0.5) * np.arange(int(rng.integers(1, 4)))
    return (*poles, *(_lying(float(rng.uniform(0.006, 0.02)), length, float(h), material) for h in heights))


def scaffold(rng: np.random.Generator, material: str) -> tuple[Solid, ...]:
    """A lattice of uprights, ledgers and diagonal braces."""
    bays, levels = int(rng.integers(1, 4)), int(rng.integers(1, 4))
    width, rise, radius = rng.uniform(0.6, 1.6), rng.uniform(0.6, 1.4), float(rng.uniform(0.012, 0.035))
    xs = width * (np.arange(bays + 1) - bays / 2)
    parts = [_upright(radius, levels * rise, float(x), material) for x in xs]
    for level in range(levels):
        parts.append(_lying(radius, bays * width, (level + 1) * rise, material))
        for left, right in pairwise(xs):
            ends = (np.array([left, 0, level * rise]), np.array([right, 0, (level + 1) * rise]))
            parts.append(_between(*ends, radius * 0.8, material))
    return tuple(parts)


def leaning_bars(rng: np.random.Generator, material: str) -> tuple[Solid, ...]:
    """Three to seven laths, each leaning its own way: diagonal in the image."""
    parts = []
    for _ in range(int(rng.integers(3, 8))):
        length, lean = rng.uniform(0.8, 2.6), rng.uniform(-1.0, 1.0)
        rotation = turned(rng.uniform(0, 2 * np.pi)) @ axis_rotations(0, np.array([lean]))[0]
        centre = np.array([*rng.uniform(-0.8, 0.8, 2), 0.5 * length * np.cos(lean)])
        parts.append(box((rng.uniform(0.03, 0.1), 0.02, length), centre, rotation, material))
    return tuple(parts)


KINDS = (railing, bare_tree, pole_row, wires, scaffold, leaning_bars)
