"""Leaves: tree crowns, bushes and grass as clouds of small two-sided triangles.

Their depth changes from pixel to pixel, no depth map follows it, and one patch of a measured flow sees several depths
at once: what a detector must learn not to take for motion. Off by default (``SimulatorConfig.foliage``), drawn from a
generator of its own.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from viflow_anomaly.sensor_data import Float64Array
from viflow_anomaly.simulator import street, surroundings, textures
from viflow_anomaly.simulator.road import Road
from viflow_anomaly.simulator.roadside import KERB_TOP_M, Layout
from viflow_anomaly.simulator.scene import Material, Mover, Solid, Strip
from viflow_anomaly.simulator.shapes import UPRIGHT, raised
from viflow_anomaly.simulator.surroundings import KeepClear

TRIES = 12
NEAREST_M, FARTHEST_M = 1.5, 22.0
BEYOND_THE_DRIVE_M = 70.0
LEAF_TEXTURE_PX = 128
MATERIALS = 3


def leaf_materials(rng: np.random.Generator) -> tuple[Material, ...]:
    """Few, because every leaf takes a small piece of one: bright and dark leaves come from the same picture."""
    return tuple(
        Material(f"leaves{k}", textures.leaves(rng, LEAF_TEXTURE_PX), "tile", specular=0.0) for k in range(MATERIALS)
    )


def beside_the_path(
    rng: np.random.Generator, count: int, camera_poses: Float64Array, movers: tuple[Mover, ...]
) -> tuple[tuple[Solid, ...], tuple[Strip, ...]]:
    """``count`` plants in what a drone sees, before a camera pose of [F, 4, 4]: trunks, and leaves."""

    def place() -> Float64Array:
        return surroundings.spot_ahead(rng, camera_poses, nearest_m=NEAREST_M, farthest_m=FARTHEST_M)

    clear = KeepClear.around(camera_poses[:, :3, 3], movers, clearance_m=surroundings.CLEARANCE_M)
    return _planted(rng, count, place, clear)


def along_the_road(
    rng: np.random.Generator,
    count: int,
    road: Road,
    layout: Layout,
    arc_m: Float64Array,
    camera_path_m: Float64Array,
    movers: tuple[Mover, ...],
) -> tuple[tuple[Solid, ...], tuple[Strip, ...]]:
    """``count`` plants on both sides of the road; ``arc_m`` [F] and ``camera_path_m`` [F, 3] say where the car is."""
    driven = np.arange(arc_m[0], arc_m[-1] + BEYOND_THE_DRIVE_M, 1.0)

    def place() -> Float64Array:
        s = np.array([rng.uniform(driven[0] + 3.0, driven[-1])])
        left = rng.random() < 0.5
        edge = layout.left_edge if left else -layout.right_edge
        lateral = edge + 0.5 + 14.0 * rng.random() ** 2
        return np.array([*road.position(s, lateral if left else -lateral)[0], KERB_TOP_M])

    line = np.column_stack([road.position(driven), np.ones(len(driven))])
    clear = KeepClear.around(np.concatenate([line, camera_path_m]), movers, clearance_m=street.CLEARANCE_M)
    return _planted(rng, count, place, clear)


def _planted(
    rng: np.random.Generator, count: int, place: Callable[[], Float64Array], clear: KeepClear
) -> tuple[tuple[Solid, ...], tuple[Strip, ...]]:
    """Each kind in turn, drawn again elsewhere until it stands clear."""
    solids: list[Solid] = []
    strips: list[Strip] = []
    for index in range(count):
        for _ in range(TRIES):
            spot = place()
            trunks, crown = KINDS[index % len(KINDS)](rng, spot)
            around = Solid("ellipsoid", tuple(np.ptp(crown, axis=0) / 2 + 1e-3), crown.mean(axis=0), UPRIGHT, "leaves0")
            if clear.allows((*trunks, around)):
                solids.extend(trunks)
                strips.append(_leaves(rng, crown))
                break
    return tuple(solids), tuple(strips)


def _leafy_tree(rng: np.random.Generator, spot: Float64Array) -> tuple[tuple[Solid, ...], Float64Array]:
    """A trunk and a crown of several clusters, sparse enough to look through."""
    height, girth, width = rng.uniform(1.8, 5.0), rng.uniform(0.06, 0.3), rng.uniform(0.6, 2.6)
    trunk = Solid("cylinder", (girth, height / 2, 0.0), raised(spot, height / 2), UPRIGHT, "leaves0")
    clusters = int(rng.integers(3, 9))
    middles = rng.normal(0, 0.45, (clusters, 3)) * width + np.array([0, 0, height + 0.3 * width])
    return (trunk,), spot + _clustered(rng, middles, int(rng.integers(700, 2200)), 0.24 * width)


def _bush(rng: np.random.Generator, spot: Float64Array) -> tuple[tuple[Solid, ...], Float64Array]:
    length, height = rng.uniform(0.5, 3.5), rng.uniform(0.4, 1.8)
    clusters = int(rng.integers(2, 8))
    middles = np.column_stack(
        [rng.uniform(-length / 2, length / 2, clusters), rng.normal(0, 0.3, clusters), np.full(clusters, height / 2)]
    )
    return (), spot + _above_ground(_clustered(rng, middles, int(rng.integers(400, 1200)), height / 3.5))


def _grass(rng: np.random.Generator, spot: Float64Array) -> tuple[tuple[Solid, ...], Float64Array]:
    size = rng.uniform(1.0, 5.0, 2)
    count = int(rng.integers(500, 1600))
    tall = rng.uniform(0.04, 0.35)
    places = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)) * size, rng.uniform(0.0, tall, count)])
    return (), spot + places


KINDS = (_leafy_tree, _grass, _bush)


def _clustered(rng: np.random.Generator, middles: Float64Array, count: int, spread_m: float) -> Float64Array:
    """[count, 3] around the middles [K, 3]."""
    return np.asarray(middles[rng.integers(len(middles), size=count)] + rng.normal(0, spread_m, (count, 3)))


def _above_ground(points: Float64Array) -> Float64Array:
    return np.column_stack([points[:, :2], np.abs(points[:, 2])])


def _leaves(rng: np.random.Generator, places_m: Float64Array) -> Strip:
    """A triangle at each place, turned at random; its back is a triangle of its own, so that both sides are lit."""
    count, size = len(places_m), rng.uniform(0.04, 0.15)
    corners = rng.normal(0, 1, (count, 3, 3))
    corners *= size * rng.uniform(0.6, 1.4, (count, 1, 1)) / np.linalg.norm(corners, axis=2, keepdims=True)
    front = places_m[:, None] + corners
    vertices = np.concatenate([front, front[:, ::-1]]).reshape(-1, 3)
    corner_uv = rng.uniform(0, 1, (count, 1, 2)) + rng.uniform(-0.06, 0.06, (count, 3, 2))
    coordinates = np.concatenate([corner_uv, corner_uv[:, ::-1]]).reshape(-1, 2)
    faces = np.arange(2.0 * 3 * count).reshape(-1, 3)
    return Strip(vertices, faces, coordinates, f"leaves{rng.integers(MATERIALS)}")
