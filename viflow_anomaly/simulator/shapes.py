"""Solids and compound things, in a frame that stands on the ground (z = 0) or around a centre."""

from __future__ import annotations

import numpy as np

from viflow_anomaly.sensor_data import Float64Array
from viflow_anomaly.simulator.motion import axis_rotations
from viflow_anomaly.simulator.scene import Shape, Solid

UPRIGHT = np.eye(3)
PRIMITIVES: tuple[Shape, ...] = ("box", "sphere", "capsule", "cylinder", "ellipsoid")


def turned(angle_rad: float) -> Float64Array:
    """[3, 3] rotation about z."""
    return np.asarray(axis_rotations(2, np.array([angle_rad]))[0])


def sizes(
    rng: np.random.Generator, low: tuple[float, float, float], high: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Three sizes in metres, each uniform within its range."""
    first, second, third = rng.uniform(low, high)
    return float(first), float(second), float(third)


def raised(place_m: Float64Array, by_m: float) -> Float64Array:
    """[3], the same place higher up."""
    return np.asarray(place_m + np.array([0.0, 0.0, by_m]))


def box(size_m: tuple[float, float, float], centre_m: Float64Array, rotation: Float64Array, material: str) -> Solid:
    """A box of full size ``size_m``."""
    half = (size_m[0] / 2, size_m[1] / 2, size_m[2] / 2)
    return Solid("box", half, np.asarray(centre_m, dtype=np.float64), rotation, material)


def primitive(rng: np.random.Generator, extent_m: float, material: str) -> Solid:
    """A primitive about the origin whose largest full size is about ``extent_m``."""
    shape = PRIMITIVES[int(rng.choice(len(PRIMITIVES), p=(0.4, 0.12, 0.12, 0.2, 0.16)))]
    half = extent_m / 2
    a, b, c = half * rng.uniform(0.45, 1.0, 3)
    sizes = {
        "box": (a, b, c),
        "ellipsoid": (a, b, c),
        "sphere": (half, 0.0, 0.0),
        "capsule": (half * 0.45, half * 0.55, 0.0),
        "cylinder": (half * rng.uniform(0.4, 0.9), c, 0.0),
    }
    return Solid(shape, sizes[shape], np.zeros(3), UPRIGHT, material)


def compound(rng: np.random.Generator, extent_m: float, materials: list[str]) -> tuple[Solid, ...]:
    """One to three primitives that overlap."""
    parts = [primitive(rng, extent_m, str(rng.choice(materials)))]
    for _ in range(int(rng.choice(3, p=(0.5, 0.3, 0.2)))):
        part = primitive(rng, extent_m * rng.uniform(0.4, 0.7), str(rng.choice(materials)))
        parts.append(moved((part,), rng.uniform(-0.35, 0.35, 3) * extent_m, UPRIGHT)[0])
    return tuple(parts)


def moved(solids: tuple[Solid, ...], position_m: Float64Array, rotation: Float64Array) -> tuple[Solid, ...]:
    """The same solids carried to another place."""
    return tuple(
        Solid(
            solid.shape,
            solid.size_m,
            rotation @ solid.position_m + position_m,
            rotation @ solid.rotation,
            solid.material,
        )
        for solid in solids
    )


def car(rng: np.random.Generator, materials: list[str]) -> tuple[Solid, ...]:
    """A car, van or lorry heading along x, wheels on z = 0."""
    kind = rng.choice(3, p=(0.65, 0.2, 0.15))
    length, width = ((4.3, 1.8), (5.2, 2.0), (8.0, 2.4))[kind]
    length, width = length * rng.uniform(0.9, 1.1), width * rng.uniform(0.95, 1.05)
    body_material, cabin_material, wheel_material = (str(rng.choice(materials)) for _ in range(3))
    if kind == 0:
        parts = [
            box((length, width, 0.65), np.array([0, 0, 0.65]), UPRIGHT, body_material),
            box((length * 0.5, width * 0.88, 0.55), np.array([-0.06 * length, 0, 1.22]), UPRIGHT, cabin_material),
        ]
    else:
        height = (1.8, 2.7)[kind - 1] * rng.uniform(0.9, 1.1)
        parts = [
            box(
                (length * 0.76, width, height), np.array([-0.12 * length, 0, 0.4 + height / 2]), UPRIGHT, body_material
            ),
            box(
                (length * 0.23, width, height * 0.7),
                np.array([0.38 * length, 0, 0.4 + height * 0.35]),
                UPRIGHT,
                cabin_material,
            ),
        ]
    across = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    for x in (-0.32 * length, 0.32 * length):
        for y in (-0.46 * width, 0.46 * width):
            parts.append(Solid("cylinder", (0.34, 0.11, 0.0), np.array([x, y, 0.34]), across, wheel_material))
    return tuple(parts)


def pedestrian(rng: np.random.Generator, materials: list[str]) -> tuple[Solid, ...]:
    """A capsule body with a head, feet on z = 0."""
    height, girth = rng.uniform(1.5, 1.95), rng.uniform(0.18, 0.28)
    body = Solid(
        "capsule",
        (girth, height * 0.43 - girth, 0.0),
        np.array([0, 0, height * 0.43]),
        UPRIGHT,
        str(rng.choice(materials)),
    )
    head = Solid("sphere", (0.12, 0.0, 0.0), np.array([0, 0, height - 0.12]), UPRIGHT, str(rng.choice(materials)))
    return (body, head)


def cyclist(rng: np.random.Generator, materials: list[str]) -> tuple[Solid, ...]:
    """Two wheels, a frame and a rider, heading along x."""
    across = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    frame, rider = str(rng.choice(materials)), str(rng.choice(materials))
    wheels = [Solid("cylinder", (0.34, 0.03, 0.0), np.array([x, 0, 0.34]), across, frame) for x in (-0.5, 0.5)]
    return (
        *wheels,
        box((1.0, 0.06, 0.12), np.array([0, 0, 0.65]), UPRIGHT, frame),
        Solid("capsule", (0.2, 0.35, 0.0), np.array([-0.1, 0, 1.2]), UPRIGHT, rider),
        Solid("sphere", (0.13, 0.0, 0.0), np.array([0.0, 0, 1.78]), UPRIGHT, rider),
    )


def tree(rng: np.random.Generator, bark: str, leaves: list[str]) -> tuple[Solid, ...]:
    """A trunk on z = 0 with two to four ellipsoid crowns."""
    height, girth = rng.uniform(2.0, 5.0), rng.uniform(0.1, 0.3)
    parts = [Solid("cylinder", (girth, height / 2, 0.0), np.array([0, 0, height / 2]), UPRIGHT, bark)]
    for _ in range(int(rng.integers(2, 5))):
        radii = sizes(rng, (0.7, 0.7, 0.7), (1.8, 1.8, 1.8))
        place = np.array([*rng.uniform(-0.9, 0.9, 2), height + rng.uniform(-0.3, 1.2)])
        parts.append(Solid("ellipsoid", radii, place, turned(rng.uniform(0, np.pi)), str(rng.choice(leaves))))
    return tuple(parts)
