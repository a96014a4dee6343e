"""Where a drone flies: a cluttered room, or the open with buildings and trees. Nothing stands in its way.

Things are placed after the path is known; one that comes nearer to it (or to a mover's path) than the clearance is
drawn again elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from viflow_anomaly.sensor_data import Float64Array
from viflow_anomaly.simulator import textures
from viflow_anomaly.simulator.motion import axis_rotations
from viflow_anomaly.simulator.scene import Material, Mover, Scene, Solid, draw_lights
from viflow_anomaly.simulator.shapes import UPRIGHT, box, compound, moved, raised, sizes, tree, turned

CLEARANCE_M = 0.5
MOVER_CLEARANCE_M = 0.1
OBJECT_TEXTURE_PX = 256
SURFACE_TEXTURE_PX = 512
TRIES = 12


@dataclass(frozen=True, eq=False)
class KeepClear:
    """Points [N, 3] and the distance [N] that everything keeps from each."""

    points_m: Float64Array
    distances_m: Float64Array

    @classmethod
    def around(cls, camera_path_m: Float64Array, movers: tuple[Mover, ...], *, clearance_m: float) -> KeepClear:
        paths = [camera_path_m, *(mover.positions_m for mover in movers)]
        distances = [clearance_m, *(mover.radius_m() + MOVER_CLEARANCE_M for mover in movers)]
        return cls(
            np.concatenate(paths),
            np.concatenate([np.full(len(p), d) for p, d in zip(paths, distances, strict=True)]),
        )

    def allows(self, solids: tuple[Solid, ...]) -> bool:
        for distance in np.unique(self.distances_m):
            points = self.points_m[self.distances_m == distance]
            if any(solid.clearance_m(points) < distance for solid in solids):
                return False
        return True


def spot_ahead(
    rng: np.random.Generator, camera_poses: Float64Array, *, nearest_m: float, farthest_m: float
) -> Float64Array:
    """[3] on the ground before one of the camera poses [F, 4, 4], near ones as often as far ones."""
    pose = camera_poses[int(rng.integers(len(camera_poses)))]
    distance = float(np.exp(rng.uniform(np.log(nearest_m), np.log(farthest_m))))
    ahead = pose[:3, :3] @ np.array([rng.uniform(-0.9, 0.9), 0.0, 1.0])
    bearing = float(np.arctan2(ahead[1], ahead[0]))
    return np.array([*(pose[:2, 3] + distance * np.array([np.cos(bearing), np.sin(bearing)])), 0.0])


def object_materials(rng: np.random.Generator, count: int) -> tuple[Material, ...]:
    return tuple(
        Material(
            f"object{index}",
            textures.any_texture(rng, OBJECT_TEXTURE_PX),
            specular=float(rng.uniform(0, 0.3)),
        )
        for index in range(count)
    )


def _surface(rng: np.random.Generator, name: str, size_m: tuple[float, float], *, ground: bool) -> Material:
    tile_m = rng.uniform(1.6, 4.0)
    image = (textures.ground_texture if ground else textures.any_texture)(rng, SURFACE_TEXTURE_PX)
    return Material(name, image, "tile", (size_m[0] / tile_m, size_m[1] / tile_m), specular=0.0)


def _facing(axis: int, sign: float) -> Float64Array:
    """Rotation whose z axis is the given world axis."""
    if axis == 2:
        return np.asarray(axis_rotations(0, np.array([0.0 if sign > 0 else np.pi]))[0])
    tilt = axis_rotations(1, np.array([np.pi / 2]))[0]  # z to x
    angle = {(0, 1.0): 0.0, (0, -1.0): np.pi, (1, 1.0): np.pi / 2, (1, -1.0): -np.pi / 2}[(axis, sign)]
    return np.asarray(turned(angle) @ tilt)


def _walls(rng: np.random.Generator, low: Float64Array, high: Float64Array) -> tuple[list[Material], list[Solid]]:
    """Six inward planes of the box low..high, each with its own surface."""
    materials, solids = [], []
    middle, half = (low + high) / 2, (high - low) / 2
    # Plane axes after _facing: on x walls local x is world z, on y walls too; local y is horizontal.
    half_sizes = ((half[2], half[1]), (half[2], half[0]), (half[0], half[1]))
    for axis in range(3):
        for sign in (1.0, -1.0):
            name = f"wall{axis}{'low' if sign > 0 else 'high'}"
            size = half_sizes[axis]
            materials.append(_surface(rng, name, (2 * size[0], 2 * size[1]), ground=axis == 2 and sign > 0))
            place = middle.copy()
            place[axis] = low[axis] if sign > 0 else high[axis]
            solids.append(Solid("plane", (size[0], size[1], 0.0), place, _facing(axis, sign), name))
    return materials, solids


def _poster(rng: np.random.Generator, low: Float64Array, high: Float64Array, material: str) -> tuple[Solid, ...]:
    axis, at_low = int(rng.integers(2)), bool(rng.random() < 0.5)
    width, height, thickness = rng.uniform(0.4, 1.6), rng.uniform(0.4, 1.4), rng.uniform(0.02, 0.3)
    place = rng.uniform(low, high)
    place[axis] = low[axis] + thickness / 2 if at_low else high[axis] - thickness / 2
    size = (thickness, width, height) if axis == 0 else (width, thickness, height)
    return (box(size, place, UPRIGHT, material),)


def _shelf(rng: np.random.Generator, place: Float64Array, names: list[str]) -> tuple[Solid, ...]:
    """Boards between two sides, with boxes on some of them."""
    width, depth, height = rng.uniform(0.8, 1.6), rng.uniform(0.3, 0.5), rng.uniform(1.0, 2.2)
    wood = str(rng.choice(names))
    parts = [box((0.04, depth, height), np.array([x, 0, height / 2]), UPRIGHT, wood) for x in (-width / 2, width / 2)]
    for level in np.linspace(0.1, height - 0.02, int(rng.integers(3, 5))):
        parts.append(box((width, depth, 0.04), np.array([0, 0, level]), UPRIGHT, wood))
        size = sizes(rng, (0.15, 0.1, 0.1), (0.5, 0.3, 0.32))
        across = rng.uniform(-0.3, 0.3) * width
        parts.append(box(size, np.array([across, 0, level + 0.02 + size[2] / 2]), UPRIGHT, str(rng.choice(names))))
    return moved(tuple(parts), place, turned(rng.uniform(0, 2 * np.pi)))


def _room_thing(rng: np.random.Generator, low: Float64Array, high: Float64Array, names: list[str]) -> tuple[Solid, ...]:
    kind = rng.choice(6, p=(0.34, 0.12, 0.1, 0.1, 0.16, 0.18))
    material = str(rng.choice(names))
    place = rng.uniform(low, high)
    if kind == 0:  # furniture on the floor
        size = sizes(rng, (0.2, 0.2, 0.2), (1.2, 1.0, 1.3))
        place[2] = low[2] + size[2] / 2
        return (box(size, place, turned(rng.uniform(0, np.pi)), material),)
    if kind == 1:  # a pole from floor to ceiling, or a barrel
        radius = rng.choice((rng.uniform(0.03, 0.12), rng.uniform(0.15, 0.35)))
        half = (high[2] - low[2]) / 2 if radius < 0.13 else rng.uniform(0.3, 0.7)
        place[2] = low[2] + half
        return (Solid("cylinder", (float(radius), float(half), 0.0), place, UPRIGHT, material),)
    if kind == 2:
        return _shelf(rng, np.array([place[0], place[1], low[2]]), names)
    if kind == 3:  # a leaning board
        rotation = turned(rng.uniform(0, np.pi)) @ axis_rotations(0, np.array([rng.uniform(-0.4, 0.4)]))[0]
        return (box((rng.uniform(0.1, 0.5), 0.04, rng.uniform(1.0, 2.2)), place, rotation, material),)
    if kind == 4:
        return _poster(rng, low, high, material)
    return moved(compound(rng, rng.uniform(0.2, 1.1), names), place, turned(rng.uniform(0, 2 * np.pi)))


def _fill(keep_clear: KeepClear, count: int, draw: Callable[[], tuple[Solid, ...]]) -> list[Solid]:
    """``count`` things from ``draw()``, each redrawn up to TRIES times until it stands clear."""
    solids: list[Solid] = []
    for _ in range(count):
        for _ in range(TRIES):
            thing = draw()
            if keep_clear.allows(thing):
                solids.extend(thing)
                break
    return solids


def room(
    rng: np.random.Generator, camera_path_m: Float64Array, movers: tuple[Mover, ...], names: tuple[Material, ...]
) -> Scene:
    """A closed, cluttered room around the path [N, 3] and the movers' paths."""
    paths = np.concatenate([camera_path_m, *(mover.positions_m for mover in movers)])
    low, high = paths.min(axis=0), paths.max(axis=0)
    low = low - np.array([*rng.uniform(0.9, 3.2, 2), 0.0])
    high = high + np.array([*rng.uniform(0.9, 3.2, 2), rng.uniform(0.7, 2.0)])
    low[2] = 0.0
    high = np.maximum(high, low + np.array([5.0, 5.0, 2.6]))
    wall_materials, solids = _walls(rng, low, high)
    area = float(np.prod((high - low)[:2]))
    count = int(min(rng.uniform(0.6, 1.5) * area, 110))
    object_names = [material.name for material in names]
    clear = KeepClear.around(camera_path_m, movers, clearance_m=CLEARANCE_M)
    solids += _fill(clear, count, lambda: _room_thing(rng, low, high, object_names))
    lights, ambient, headlight = draw_lights(rng, indoor=True, extent_m=float((high - low).max()))
    return Scene(
        materials=(*names, *wall_materials),
        solids=tuple(solids),
        lights=lights,
        ambient=ambient,
        headlight=headlight,
        far_m=100.0,
        movers=movers,
    )


def _outdoor_thing(rng: np.random.Generator, centre: Float64Array, names: list[str]) -> tuple[Solid, ...]:
    distance, bearing = 1.2 + 34.0 * rng.random() ** 1.6, rng.uniform(0, 2 * np.pi)
    place = np.array([centre[0] + distance * np.cos(bearing), centre[1] + distance * np.sin(bearing), 0.0])
    rotation, material = turned(rng.uniform(0, 2 * np.pi)), str(rng.choice(names))
    if distance > 12 and rng.random() < 0.5:
        size = sizes(rng, (4, 4, 3), (12, 9, 12))
        return (box(size, raised(place, size[2] / 2), rotation, "facade"),)
    kind = rng.choice(4, p=(0.3, 0.3, 0.15, 0.25))
    if kind == 0:
        return moved(tree(rng, material, names), place, rotation)
    if kind == 1:
        size = sizes(rng, (0.3, 0.3, 0.3), (2.0, 1.6, 2.2))
        return (box(size, raised(place, size[2] / 2), rotation, material),)
    if kind == 2:
        half = rng.uniform(1.2, 3.5)
        return (Solid("cylinder", (float(rng.uniform(0.04, 0.2)), half, 0.0), raised(place, half), UPRIGHT, material),)
    extent = rng.uniform(0.4, 1.8)
    return moved(compound(rng, extent, names), raised(place, extent * 0.4 + rng.choice((0.0, 1.0))), rotation)


def open_air(
    rng: np.random.Generator, camera_path_m: Float64Array, movers: tuple[Mover, ...], names: tuple[Material, ...]
) -> Scene:
    """Ground, sky, trees, boxes and buildings around the path [N, 3]."""
    centre = camera_path_m.mean(axis=0)
    tile_m, side_m = rng.uniform(2.0, 4.0), 160.0
    ground = Material(
        "ground", textures.ground_texture(rng, SURFACE_TEXTURE_PX), "tile", (side_m / tile_m, side_m / tile_m), 0.0
    )
    facade = Material("facade", textures.facade(rng, SURFACE_TEXTURE_PX))
    floor = Solid("plane", (side_m / 2, side_m / 2, 0.0), np.array([centre[0], centre[1], 0.0]), UPRIGHT, "ground")
    object_names = [material.name for material in names]
    clear = KeepClear.around(camera_path_m, movers, clearance_m=CLEARANCE_M)
    count = int(rng.integers(60, 120))
    things = _fill(clear, count, lambda: _outdoor_thing(rng, centre, object_names))
    lights, ambient, headlight = draw_lights(rng, indoor=False, extent_m=30.0)
    return Scene(
        materials=(*names, ground, facade),
        solids=(floor, *things),
        lights=lights,
        ambient=ambient,
        headlight=headlight,
        far_m=200.0,
        sky=textures.sky_texture(rng, 256),
        movers=movers,
    )
