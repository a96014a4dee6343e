"""Where a car drives: a road that follows its path, kerbs, houses, trees, poles, fences and parked cars beside it."""

from __future__ import annotations

import numpy as np

from viflow_anomaly.sensor_data import Float64Array
from viflow_anomaly.simulator import textures
from viflow_anomaly.simulator.road import Road
from viflow_anomaly.simulator.roadside import FACADES, Layout, Roadside
from viflow_anomaly.simulator.scene import Material, Mover, Scene, Solid, Strip, draw_lights
from viflow_anomaly.simulator.shapes import UPRIGHT
from viflow_anomaly.simulator.surroundings import OBJECT_TEXTURE_PX, SURFACE_TEXTURE_PX, KeepClear

CLEARANCE_M = 2.2


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
            for thing in Roadside(rng, road, s, side, layout, object_names).things():
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
