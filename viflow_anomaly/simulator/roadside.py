"""What stands beside a road: houses, trees, parked cars, poles and signs, bushes, fences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from viflow_anomaly.sensor_data import Float64Array
from viflow_anomaly.simulator.road import Road
from viflow_anomaly.simulator.scene import Solid
from viflow_anomaly.simulator.shapes import UPRIGHT, box, car, compound, moved, raised, sizes, tree, turned

FACADES = 4
KERB_TOP_M = 0.08


@dataclass(frozen=True)
class Layout:
    """Edges in metres to the left of the driven line, the kerb's width, and how likely each thing is at a place."""

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


@dataclass(frozen=True, eq=False)
class Roadside:
    """One place along the road at arc length ``s`` (m) on one side (+1 left, -1 right)."""

    rng: np.random.Generator
    road: Road
    s: float
    side: float
    layout: Layout
    materials: list[str]

    def things(self) -> Iterator[tuple[Solid, ...]]:
        """What stands there: for each kind a coin is tossed, in a fixed order."""
        layout = self.layout
        kinds = (
            (layout.houses, self._house),
            (layout.trees, self._street_tree),
            (layout.parked, self._parked_car),
            (layout.poles, self._pole),
            (0.35, self._object),
            (0.9 - 0.6 * layout.houses, self._greenery),
            (0.25, self._fence),
        )
        for probability, draw in kinds:
            if self.rng.random() < probability:
                yield from draw()

    @property
    def _edge_m(self) -> float:
        return self.layout.left_edge if self.side > 0 else -self.layout.right_edge

    @property
    def _walk_end_m(self) -> float:
        return self._edge_m + self.layout.kerb_width

    def _at(
        self, lateral_m: float, along_m: float = 0.0, turn_rad: float = 0.0, height_m: float = KERB_TOP_M
    ) -> tuple[Float64Array, Float64Array]:
        """A place [3] that far beside the driven line, and the road's direction there, turned [3, 3]."""
        heading = float(self.road.heading(np.array([self.s]))[0])
        place = self.road.position(np.array([self.s + along_m]), self.side * lateral_m)[0]
        return np.array([*place, height_m]), turned(heading + turn_rad)

    def _material(self) -> str:
        return str(self.rng.choice(self.materials))

    def _house(self) -> Iterator[tuple[Solid, ...]]:
        size = sizes(self.rng, (6.0, 6.0, 3.5), (14.0, 12.0, 14.0))
        place, rotation = self._at(self._walk_end_m + size[1] / 2 + self.rng.uniform(0.2, 5.0))
        yield (box(size, raised(place, size[2] / 2), rotation, f"facade{self.rng.integers(FACADES)}"),)

    def _street_tree(self) -> Iterator[tuple[Solid, ...]]:
        rng = self.rng
        beside = rng.uniform(0.6, 1.0) * self.layout.kerb_width + rng.choice((0.0, 2.0, 8.0))
        place, rotation = self._at(self._edge_m + beside, rng.uniform(-4, 4))
        yield moved(tree(rng, self._material(), self.materials), place, rotation)

    def _parked_car(self) -> Iterator[tuple[Solid, ...]]:
        rng = self.rng
        turn = 0.0 if rng.random() < 0.6 else np.pi
        beside, along = rng.uniform(-1.0, 1.2), rng.uniform(-2, 2)
        place, rotation = self._at(self._edge_m + beside, along, turn + rng.normal(0, 0.04), 0.02)
        yield moved(car(rng, self.materials), place, rotation)

    def _pole(self) -> Iterator[tuple[Solid, ...]]:
        rng = self.rng
        half, radius = rng.uniform(1.2, 3.5), rng.uniform(0.04, 0.15)
        place, rotation = self._at(self._edge_m + rng.uniform(0.3, 0.8), rng.uniform(-4, 4))
        pole = Solid("cylinder", (radius, half, 0.0), raised(place, half), UPRIGHT, self._material())
        sign = box((0.05, *rng.uniform(0.4, 0.9, 2)), raised(place, 2 * half), rotation, self._material())
        yield (pole, sign) if rng.random() < 0.5 else (pole,)

    def _object(self) -> Iterator[tuple[Solid, ...]]:
        rng = self.rng
        beside, along = rng.uniform(-1.0, 3.0), rng.uniform(-4, 4)
        place, rotation = self._at(self._walk_end_m + beside, along, rng.uniform(0, np.pi))
        extent = rng.uniform(0.5, 2.0)
        yield moved(compound(rng, extent, self.materials), raised(place, extent * 0.35), rotation)

    def _greenery(self) -> Iterator[tuple[Solid, ...]]:
        """A tree further off, and a bush."""
        rng = self.rng
        place, rotation = self._at(self._walk_end_m + rng.uniform(4.0, 35.0), rng.uniform(-5, 5))
        yield moved(tree(rng, self._material(), self.materials), place, rotation)
        radii = sizes(rng, (0.4, 0.4, 0.4), (1.8, 1.8, 1.8))
        place, rotation = self._at(self._walk_end_m + rng.uniform(0.5, 14.0), rng.uniform(-5, 5))
        yield (Solid("ellipsoid", radii, raised(place, 0.5 * radii[2]), rotation, self._material()),)

    def _fence(self) -> Iterator[tuple[Solid, ...]]:
        size = (8.0, 0.12, self.rng.uniform(0.6, 2.2))
        place, rotation = self._at(self._walk_end_m + self.rng.uniform(0.0, 0.4))
        yield (box(size, raised(place, size[2] / 2), rotation, self._material()),)
