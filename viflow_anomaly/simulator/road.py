"""A road as a plane curve of given heading: exact in heading and curvature, integrated in position."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from viflow_anomaly.sensor_data import Float64Array
from viflow_anomaly.simulator.harmonics import Harmonics

NODE_SPACING_M = 0.5
MAX_YAW_RATE_RAD_S = 0.4
MAX_LATERAL_ACCELERATION_M_S2 = 3.5
MIN_RADIUS_M = 9.0


@dataclass(frozen=True, eq=False)
class Bend:
    """heading += angle * (1 + tanh((s - at) / length)) / 2: a turn at a junction."""

    angle_rad: float
    at_m: float
    length_m: float

    def heading(self, s: Float64Array) -> Float64Array:
        return np.asarray(self.angle_rad * 0.5 * (1 + np.tanh((s - self.at_m) / self.length_m)))

    def curvature(self, s: Float64Array) -> Float64Array:
        return np.asarray(self.angle_rad * 0.5 / self.length_m / np.cosh((s - self.at_m) / self.length_m) ** 2)


class Road:
    """The curve that the vehicle follows, by arc length s (metres); s = 0 at the first frame.

    Args:
        winding: heading as a sum of sinusoids in s.
        bends: sharper turns.
        start_m, end_m: the range of s that is tabulated; beyond it the road goes straight on.
    """

    def __init__(self, winding: Harmonics, bends: tuple[Bend, ...], start_m: float, end_m: float) -> None:
        self._winding = winding
        self._bends = bends
        self.start_m = start_m
        self.end_m = end_m
        self._nodes = np.arange(start_m, end_m + NODE_SPACING_M, NODE_SPACING_M)
        steps = self._integral(self._nodes[:-1], self._nodes[1:])
        self._node_positions = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])

    def heading(self, s: Float64Array) -> Float64Array:
        """[N] -> [N] rad, anticlockwise from world x."""
        s = np.clip(s, self.start_m, self.end_m)
        return self._winding.at(s) + sum((bend.heading(s) for bend in self._bends), np.zeros_like(s))

    def curvature(self, s: Float64Array) -> Float64Array:
        """[N] -> [N] 1/m, positive to the left."""
        inside = (s >= self.start_m) & (s <= self.end_m)
        total = self._winding.at(s, 1) + sum((bend.curvature(s) for bend in self._bends), np.zeros_like(s))
        return np.where(inside, total, 0.0)

    def _integral(self, first: Float64Array, last: Float64Array) -> Float64Array:
        """Gauss-Legendre integral of the tangent from first [N] to last [N]: [N, 2]; steps of half a metre."""
        nodes, weights = np.polynomial.legendre.leggauss(5)
        half = 0.5 * (last - first)
        points = half[:, None] * nodes + 0.5 * (first + last)[:, None]
        headings = self.heading(points.ravel()).reshape(points.shape)
        return np.stack([(np.cos(headings) @ weights) * half, (np.sin(headings) @ weights) * half], axis=-1)

    def position(self, s: Float64Array, lateral: Float64Array | float = 0.0) -> Float64Array:
        """World x, y [N, 2] at arc length s [N], ``lateral`` metres to the left."""
        inside = np.clip(s, self._nodes[0], self._nodes[-1])
        index = np.clip(((inside - self.start_m) / NODE_SPACING_M).astype(int), 0, len(self._nodes) - 2)
        heading = self.heading(s)
        tangent = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
        base = self._node_positions[index] + self._integral(self._nodes[index], inside)
        return np.asarray(base + tangent * (s - inside)[:, None] + normal * np.reshape(lateral, (-1, 1)))


def draw_road(rng: np.random.Generator, speed_m_s: float, driven_m: float) -> Road:
    """A road that a vehicle of that speed can follow within the yaw rate and lateral acceleration limits."""
    limit = min(MAX_YAW_RATE_RAD_S / speed_m_s, MAX_LATERAL_ACCELERATION_M_S2 / speed_m_s**2, 1.0 / MIN_RADIUS_M)
    start, end = -40.0, driven_m + 160.0
    s = np.arange(start, end, 1.0)
    winding = Harmonics.random(rng, frequencies_hz=(1 / 400, 1 / 60), count=4)
    peak = max(float(np.abs(winding.at(s, 1)).max()), 1e-9)
    winding = winding.scaled(rng.uniform(0.05, 0.5) * limit / peak)
    bends = []
    if rng.random() < 0.45:
        angle = float(rng.uniform(0.5, 1.5) * rng.choice((-1, 1)))
        length = abs(angle) / (2 * limit * rng.uniform(0.6, 1.0))
        bends.append(Bend(angle, float(rng.uniform(0.0, driven_m + 20.0)), length))
    road = Road(winding, tuple(bends), start, end)
    worst = float(np.abs(road.curvature(s)).max()) / limit
    if worst > 1:
        winding = winding.scaled(1 / worst)
        bends = [Bend(bend.angle_rad / worst, bend.at_m, bend.length_m) for bend in bends]
        road = Road(winding, tuple(bends), start, end)
    return road
