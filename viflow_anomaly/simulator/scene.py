"""What a world is made of: materials, solids, strips of ground, lights, and things that move on their own.

World axes: z up, metres. A scene is plain data; ``rendering`` turns it into a MuJoCo model.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from viflow_anomaly.sensor_data import Float64Array, Uint8Array

Shape = Literal["box", "sphere", "capsule", "cylinder", "ellipsoid", "plane"]


@dataclass(frozen=True, eq=False)
class Material:
    """A gray texture [S, S]; ``wrap`` shrinks it round a solid, ``tile`` repeats it over a plane or strip."""

    name: str
    image: Uint8Array
    mapping: Literal["wrap", "tile"] = "wrap"
    repeat: tuple[float, float] = (1.0, 1.0)
    specular: float = 0.1


@dataclass(frozen=True, eq=False)
class Solid:
    """A primitive. ``size_m`` as MuJoCo takes it: half sizes of a box or ellipsoid; radius, half length of a capsule
    or cylinder along z; radius of a sphere; half width, half height of a plane (facing its z)."""

    shape: Shape
    size_m: tuple[float, float, float]
    position_m: Float64Array
    rotation: Float64Array
    material: str

    def half_extents_m(self) -> Float64Array:
        """[3] half sizes of the box around the solid, along its own axes."""
        a, b, c = self.size_m
        if self.shape == "sphere":
            return np.array([a, a, a])
        if self.shape == "capsule":
            return np.array([a, a, a + b])
        if self.shape == "cylinder":
            return np.array([a, a, b])
        return np.array([a, b, 0.0 if self.shape == "plane" else c])

    def clearance_m(self, points: Float64Array) -> float:
        """Least distance from points [N, 3] to the box around the solid; 0 inside."""
        local = (points - self.position_m) @ self.rotation
        outside = np.maximum(np.abs(local) - self.half_extents_m(), 0.0)
        return float(np.sqrt((outside**2).sum(axis=1).min()))


@dataclass(frozen=True, eq=False)
class Strip:
    """A triangle mesh of ground: vertices [N, 3], faces [M, 3] (seen from above), texture coordinates [N, 2]."""

    vertices_m: Float64Array
    faces: Float64Array
    texture_coordinates: Float64Array
    material: str


@dataclass(frozen=True, eq=False)
class Light:
    """A white light; ``direction`` where it shines, ``position_m`` None makes it directional."""

    direction: Float64Array
    diffuse: float
    position_m: Float64Array | None = None


@dataclass(frozen=True, eq=False)
class Mover:
    """An independently moving thing: solids in its own frame, and its pose at every frame.

    ``positions_m`` [F, 3], ``rotations`` [F, 3, 3] (own frame to world).
    """

    solids: tuple[Solid, ...]
    positions_m: Float64Array
    rotations: Float64Array

    def radius_m(self) -> float:
        """Of the sphere about its origin that contains it."""
        return max(
            float(np.linalg.norm(solid.position_m) + np.linalg.norm(solid.half_extents_m())) for solid in self.solids
        )


@dataclass(frozen=True, eq=False)
class Scene:
    materials: tuple[Material, ...]
    solids: tuple[Solid, ...]
    lights: tuple[Light, ...]
    ambient: float
    headlight: float
    far_m: float
    sky: Uint8Array | None = None
    strips: tuple[Strip, ...] = ()
    movers: tuple[Mover, ...] = field(default=())


def draw_lights(rng: np.random.Generator, *, indoor: bool, extent_m: float) -> tuple[tuple[Light, ...], float, float]:
    """One to three lights, the ambient level and the headlight's strength."""
    lights = []
    for index in range(int(rng.integers(1, 4))):
        direction = np.array([*rng.uniform(-1, 1, 2), -rng.uniform(0.4, 1.5)])
        direction /= np.linalg.norm(direction)
        strength = float(rng.uniform(0.4, 0.8) if index == 0 else rng.uniform(0.1, 0.3))
        positional = indoor and rng.random() < 0.6
        place = np.array([*rng.uniform(-0.5, 0.5, 2) * extent_m, rng.uniform(2.0, 4.0)]) if positional else None
        lights.append(Light(direction, strength, place))
    headlight = float(rng.uniform(0.0, 0.25)) if indoor else 0.0
    return tuple(lights), float(rng.uniform(0.35, 0.6)), headlight
