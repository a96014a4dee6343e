"""Road users: cars ahead, oncoming and crossing, cyclists and walkers along the kerb or crossing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from viflow_anomaly.sensor_data import Float64Array
from viflow_anomaly.simulator.road import Road
from viflow_anomaly.simulator.scene import Mover, Solid
from viflow_anomaly.simulator.shapes import car, cyclist, pedestrian, turned

TRIES = 40
CAMERA_CLEARANCE_M = 1.5
SEPARATION_M = 2.0
CAMERA_DISTANCE_M = 2.5


@dataclass(frozen=True, eq=False)
class Traffic:
    """Draws road users that the camera car meets.

    Args:
        camera_path_m: [F, 3] camera positions; arc_m: [F] where it is along the road; times_s: [F], first 0.
        oncoming_lane_m: middle of that lane, to the left of the driven line; edge_m: the road's edge to the right.
        materials: names to choose from.
    """

    rng: np.random.Generator
    road: Road
    camera_path_m: Float64Array
    arc_m: Float64Array
    times_s: Float64Array
    oncoming_lane_m: float
    edge_m: float
    materials: list[str]

    def draw(self, count: int) -> tuple[Mover, ...]:
        """``count`` road users, or as many as fit, clear of the camera and of each other."""
        movers: list[Mover] = []
        for _ in range(count):
            for _ in range(TRIES):
                mover = self._road_user()
                if self._is_clear(mover) and all(_separate(mover, other) for other in movers):
                    movers.append(mover)
                    break
            else:
                break
        return tuple(movers)

    def _road_user(self) -> Mover:
        rng = self.rng
        meeting_s = rng.uniform(0.1, 0.95) * self.times_s[-1]  # when it is right before us
        arc_then = float(np.interp(meeting_s, self.times_s, self.arc_m))
        since_meeting_s = self.times_s - meeting_s
        kind = rng.choice(5, p=(0.3, 0.3, 0.12, 0.16, 0.12))
        if kind == 0:
            return self._car_ahead()
        if kind == 1:
            return self._oncoming_car(arc_then, since_meeting_s)
        if kind == 2:
            return self._crossing_car(arc_then, since_meeting_s)
        walks = rng.random() < 0.6
        thing = pedestrian(rng, self.materials) if walks else cyclist(rng, self.materials)
        pace = rng.uniform(0.7, 2.2) if walks else rng.uniform(2.5, 6.0)
        if kind == 3:
            return self._along_the_kerb(thing, pace, arc_then, since_meeting_s)
        return self._crossing(thing, pace, arc_then, since_meeting_s)

    def _car_ahead(self) -> Mover:
        gap, relative = self.rng.uniform(8.0, 30.0), self.rng.normal(0, 1.5)
        s = self.arc_m + gap + relative * (self.times_s - self.times_s.mean())
        return Mover(car(self.rng, self.materials), *self._along(s, self.rng.normal(0, 0.2), backwards=False))

    def _oncoming_car(self, arc_then: float, since_meeting_s: Float64Array) -> Mover:
        rng = self.rng
        speed = max(float(np.ptp(self.arc_m) / max(np.ptp(self.times_s), 1e-6)), 4.0)
        s = arc_then + rng.uniform(2.0, 40.0) - rng.uniform(0.5, 1.2) * speed * since_meeting_s
        solids = car(rng, self.materials)
        return Mover(solids, *self._along(s, self.oncoming_lane_m + rng.normal(0, 0.2), backwards=True))

    def _crossing_car(self, arc_then: float, since_meeting_s: Float64Array) -> Mover:
        rng = self.rng
        s_cross = arc_then + rng.uniform(14.0, 35.0)
        pace = rng.uniform(3.0, 9.0) * rng.choice((-1, 1))
        return self._across(s_cross, pace * since_meeting_s + rng.uniform(-5, 5), pace, car(rng, self.materials))

    def _along_the_kerb(
        self, thing: tuple[Solid, ...], pace: float, arc_then: float, since_meeting_s: Float64Array
    ) -> Mover:
        rng = self.rng
        side = rng.choice((-1, 1))
        s = arc_then + rng.uniform(6.0, 22.0) - side * pace * since_meeting_s
        to_the_right = side < 0
        lateral = (
            -self.edge_m - rng.uniform(0, 1.2) if to_the_right else 2 * self.oncoming_lane_m - rng.uniform(-0.5, 0.8)
        )
        return Mover(thing, *self._along(s, lateral, backwards=not to_the_right))

    def _crossing(self, thing: tuple[Solid, ...], pace: float, arc_then: float, since_meeting_s: Float64Array) -> Mover:
        velocity = pace * self.rng.choice((-1, 1))
        s_cross = arc_then + self.rng.uniform(9.0, 25.0)
        return self._across(s_cross, velocity * since_meeting_s + self.rng.uniform(-3, 4), velocity, thing)

    def _across(self, s_m: float, lateral_m: Float64Array, velocity: float, thing: tuple[Solid, ...]) -> Mover:
        """Something that crosses the road at s, lateral [F], heading where it goes."""
        place, rotations = self._along(np.full(len(self.times_s), s_m), lateral_m, backwards=False)
        return Mover(thing, place, rotations @ turned(np.sign(velocity) * np.pi / 2))

    def _along(
        self, s: Float64Array, lateral_m: Float64Array | float, *, backwards: bool
    ) -> tuple[Float64Array, Float64Array]:
        """Positions [F, 3] and rotations [F, 3, 3] of something that follows the road at s [F]."""
        headings = self.road.heading(s) + (np.pi if backwards else 0.0)
        place = self.road.position(s, lateral_m)
        return np.column_stack([place, np.full(len(s), 0.02)]), np.stack([turned(float(h)) for h in headings])

    def _is_clear(self, mover: Mover) -> bool:
        """Its middle and, as boxes, its solids keep their distances from the camera at every frame."""
        offsets = self.camera_path_m - mover.positions_m
        if np.linalg.norm(offsets[:, :2], axis=1).min() <= CAMERA_DISTANCE_M:
            return False
        local = np.einsum("fji,fj->fi", mover.rotations, offsets)
        return all(solid.clearance_m(local) >= CAMERA_CLEARANCE_M for solid in mover.solids)


def _separate(mover: Mover, other: Mover) -> bool:
    gaps = np.linalg.norm((mover.positions_m - other.positions_m)[:, :2], axis=1)
    return bool(gaps.min() > SEPARATION_M)
