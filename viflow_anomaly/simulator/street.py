"""Where a car drives: a road that follows its path, kerbs, houses, trees, poles, fences and parked cars beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from viflow_anomaly.sensor_data import Float64Array
from viflow_anomaly.simulator import textures
from viflow_anomaly.simulator.road import Road
from viflow_anomaly.simulator.scene import Material, Mover, Scene, Solid, Strip, draw_lights
from viflow_anomaly.simulator.shapes import UPRIGHT, box, car, compound, moved, tree, turned
from viflow_anomaly.simulator.surroundings import OBJECT_TEXTURE_PX, SURFACE_TEXTURE_PX, KeepClear

CLEARANCE_M = 2.2
FACADES = 4


@dataclass(frozen=True)
class Layout:
    """Lateral positions in metres to the left of the driven line."""

    right_edge: float
    left_edge: float
    kerb_width: float
    houses: float
    trees: float
    parked: float
    poles: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Layout:
        lane, beside = rng.uniform(2.8, 3.6), rng.uniform(0.5, 2.8)
        return cls(
            right_edge=-lane / 2 - beside,
            left_edge=1.5 * lane + beside,
            kerb_width=rng.uniform(1.5, 4.0),
            houses=rng.choice((0.0, 0.5, 0.9)),
            trees=rng.uniform(0.1, 0.7),
            parked=rng.choice((0.0, 0.3, 0.7)),
            poles=rng.uniform(0.2, 0.8),
        )


def _ribbon(
    road: Road, lateral_m: tuple[float, float], height_m: float, tile_m: float, material: str, *, dash_m: float = 0.0
) -> Strip:
    """The ground between two lateral positions (right, left) along the whole road; dashes if ``dash_m``."""
    step = dash_m or 2.0
    s = np.arange(road.start_m, road.end_m, step)
    right, left = road.position(s, lateral_m[0]), road.position(s, lateral_m[1])
    heights = np.full(len(s), height_m)
    rows = np.stack([np.column_stack([right, heights]), np.column_stack([left, heights])], axis=1)
    texture_rows = np.stack(
        [np.column_stack([np.full(len(s), lateral) / tile_m, s / tile_m]) for lateral in lateral_m], axis=1
    )
    first = 2 * np.arange(0, len(s) - 1, 2 if dash_m else 1)
    faces = np.concatenate(
        [np.stack([first, first + 2, first + 1]), np.stack([first + 2, first + 3, first + 1])], axis=1
    )
    return Strip(rows.reshape(-1, 3), faces.T[:, [0, 1, 2]], texture_rows.reshape(-1, 2), material)


def _ground(rng: np.random.Generator, road: Road, layout: Layout) -> tuple[list[Material], list[Solid], list[Strip]]:
    side_m, tile_m = 700.0, rng.uniform(3.0, 6.0)
    image = textures.ground_texture(rng, SURFACE_TEXTURE_PX)
    materials = [
        Material("ground", image, "tile", (side_m / tile_m, side_m / tile_m), 0.0),
        Material("asphalt", textures.asphalt(rng, SURFACE_TEXTURE_PX), "tile", specular=0.0),
        Material("kerb", textures.ground_texture(rng, OBJECT_TEXTURE_PX), "tile", specular=0.0),
        Material("paint", np.asarray(rng.integers(215, 250, (32, 32)), dtype=np.uint8), "tile", specular=0.0),
    ]
    centre = road.position(np.array([(road.start_m + road.end_m) / 2]))[0]
    ground = Solid("plane", (side_m / 2, side_m / 2, 0.0), np.array([*centre, -0.03]), UPRIGHT, "ground")
    right, left = layout.right_edge, layout.left_edge
    lane_line = (right + left) / 2
    strips = [
        _ribbon(road, (right, left), 0.0, rng.uniform(3.0, 5.0), "asphalt"),
        _ribbon(road, (left, left + layout.kerb_width), 0.08, rng.uniform(1.5, 3.0), "kerb"),
        _ribbon(road, (right - layout.kerb_width, right), 0.08, rng.uniform(1.5, 3.0), "kerb"),
        _ribbon(road, (lane_line - 0.07, lane_line + 0.07), 0.015, 1.0, "paint", dash_m=rng.uniform(2.0, 4.0)),
    ]
    if rng.random() < 0.6:
        strips.append(_ribbon(road, (right + 0.2, right + 0.33), 0.015, 1.0, "paint"))
        strips.append(_ribbon(road, (left - 0.33, left - 0.2), 0.015, 1.0, "paint"))
    return materials, [ground], strips


def _beside(
    rng: np.random.Generator, road: Road, s: float, side: float, layout: Layout, names: list[str]
) -> list[tuple[Solid, ...]]:
    """The things at one place along one side (+1 left, -1 right)."""
    edge = layout.left_edge if side > 0 else -layout.right_edge
    heading = float(road.heading(np.array([s]))[0])

    def at(lateral: float, along: float = 0.0, turn: float = 0.0, z: float = 0.08) -> tuple[Float64Array, Float64Array]:
        place = road.position(np.array([s + along]), side * lateral)[0]
        return np.array([*place, z]), turned(heading + turn)

    things: list[tuple[Solid, ...]] = []
    walk = edge + layout.kerb_width
    if rng.random() < layout.houses:
        size = (rng.uniform(6, 14), rng.uniform(6, 12), rng.uniform(3.5, 14))
        place, rotation = at(walk + size[1] / 2 + rng.uniform(0.2, 5.0))
        things.append((box(size, place + (0, 0, size[2] / 2), rotation, f"facade{rng.integers(FACADES)}"),))
    if rng.random() < layout.trees:
        place, rotation = at(
            edge + rng.uniform(0.6, 1.0) * layout.kerb_width + rng.choice((0.0, 2.0, 8.0)), rng.uniform(-4, 4)
        )
        things.append(moved(tree(rng, str(rng.choice(names)), names), place, rotation))
    if rng.random() < layout.parked:
        turn = 0.0 if rng.random() < 0.6 else np.pi
        place, rotation = at(edge + rng.uniform(-1.0, 1.2), rng.uniform(-2, 2), turn + rng.normal(0, 0.04), 0.02)
        things.append(moved(car(rng, names), place, rotation))
    if rng.random() < layout.poles:
        half, radius = rng.uniform(1.2, 3.5), rng.uniform(0.04, 0.15)
        place, rotation = at(edge + rng.uniform(0.3, 0.8), rng.uniform(-4, 4))
        pole = Solid("cylinder", (radius, half, 0.0), place + (0, 0, half), UPRIGHT, str(rng.choice(names)))
        sign = box((0.05, *rng.uniform(0.4, 0.9, 2)), place + (0, 0, 2 * half), rotation, str(rng.choice(names)))
        things.append((pole, sign) if rng.random() < 0.5 else (pole,))
    if rng.random() < 0.35:
        place, rotation = at(walk + rng.uniform(-1.0, 3.0), rng.uniform(-4, 4), rng.uniform(0, np.pi))
        extent = rng.uniform(0.5, 2.0)
        things.append(moved(compound(rng, extent, names), place + (0, 0, extent * 0.35), rotation))
    if rng.random() < 0.9 - 0.6 * layout.houses:  # a tree line, bushes
        place, rotation = at(walk + rng.uniform(4.0, 35.0), rng.uniform(-5, 5))
        things.append(moved(tree(rng, str(rng.choice(names)), names), place, rotation))
        radii = tuple(float(r) for r in rng.uniform(0.4, 1.8, 3))
        place, rotation = at(walk + rng.uniform(0.5, 14.0), rng.uniform(-5, 5))
        things.append((Solid("ellipsoid", radii, place + (0, 0, 0.5 * radii[2]), rotation, str(rng.choice(names))),))
    if rng.random() < 0.25:
        size = (8.0, 0.12, rng.uniform(0.6, 2.2))
        place, rotation = at(walk + rng.uniform(0.0, 0.4))
        things.append((box(size, place + (0, 0, size[2] / 2), rotation, str(rng.choice(names))),))
    return things


def street(
    rng: np.random.Generator,
    road: Road,
    layout: Layout,
    camera_path_m: Float64Array,
    movers: tuple[Mover, ...],
    names: tuple[Material, ...],
) -> Scene:
    """A street along the road; nothing static comes within 2.2 m of the road's line or touches a mover's path."""
    materials, solids, strips = _ground(rng, road, layout)
    facades = [Material(f"facade{k}", textures.facade(rng, SURFACE_TEXTURE_PX)) for k in range(FACADES)]
    line = road.position(np.arange(road.start_m, road.end_m, 1.0))
    driven = np.column_stack([line, np.full(len(line), 1.0)])
    clear = KeepClear.around(np.concatenate([driven, camera_path_m]), movers, clearance_m=CLEARANCE_M)
    object_names = [material.name for material in names]
    for side in (1.0, -1.0):
        s = road.start_m + 25.0
        while s < road.end_m - 10.0:
            for thing in _beside(rng, road, s, side, layout, object_names):
                if clear.allows(thing):
                    solids.extend(thing)
            s += rng.uniform(6.0, 12.0)
    lights, ambient, headlight = draw_lights(rng, indoor=False, extent_m=30.0)
    return Scene(
        materials=(*names, *materials, *facades),
        solids=tuple(solids),
        lights=lights,
        ambient=ambient,
        headlight=headlight,
        far_m=250.0,
        sky=textures.sky_texture(rng, 256),
        strips=tuple(strips),
        movers=movers,
    )
