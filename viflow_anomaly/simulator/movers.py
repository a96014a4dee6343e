"""Things that move on their own in a drone's view. For road users see ``traffic``."""

from __future__ import annotations

import numpy as np

from viflow_anomaly.geometry import so3_exp
from viflow_anomaly.sensor_data import Float64Array, PinholeCamera
from viflow_anomaly.simulator.scene import Mover
from viflow_anomaly.simulator.shapes import compound

WAYPOINT_S = 1.5
SPEED_M_S = (0.3, 3.0)
DISTANCES_M = (1.2, 8.0)
AIR_CLEARANCE_M = 0.6


def _catmull_rom(knots: Float64Array, at: Float64Array) -> Float64Array:
    """Smooth curve through knots [K, 3] at parameters 0..K-1: [N] -> [N, 3]."""
    padded = np.concatenate([2 * knots[:1] - knots[1:2], knots, 2 * knots[-1:] - knots[-2:-1]])
    index = np.clip(at.astype(int), 0, len(knots) - 2)
    t = (at - index)[:, None]
    p0, p1, p2, p3 = (padded[index + k] for k in range(4))
    return np.asarray(
        0.5 * (2 * p1 + (p2 - p0) * t + (2 * p0 - 5 * p1 + 4 * p2 - p3) * t**2 + (3 * p1 - p0 - 3 * p2 + p3) * t**3)
    )


def _point_in_view(
    rng: np.random.Generator, camera: PinholeCamera, T_world_cam: Float64Array, distances_m: tuple[float, float]
) -> Float64Array:
    """A world point that projects into the middle nine tenths of the image."""
    u = rng.uniform(0.05, 0.95) * camera.width
    v = rng.uniform(0.1, 0.9) * camera.height
    ray = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
    depth = np.exp(rng.uniform(*np.log(distances_m)))
    return np.asarray(T_world_cam[:3, :3] @ (ray * depth) + T_world_cam[:3, 3])


def _waypoints(
    rng: np.random.Generator,
    camera: PinholeCamera,
    poses: Float64Array,
    frames: Float64Array,
    step_s: float,
    low_m: float,
) -> Float64Array:
    """One point in view at each of the given frames, each within reach of the one before."""
    points: list[Float64Array] = []
    fastest = float(np.exp(rng.uniform(np.log(2 * SPEED_M_S[0]), np.log(SPEED_M_S[1]))))
    for frame in frames:
        pose = poses[int(frame)]
        candidates = np.stack([_point_in_view(rng, camera, pose, DISTANCES_M) for _ in range(24)])
        candidates[:, 2] = np.maximum(candidates[:, 2], low_m)
        if not points:
            points.append(candidates[0])
            continue
        travel = candidates - points[-1]
        speeds = np.linalg.norm(travel, axis=1) / step_s
        reachable = np.flatnonzero((speeds >= SPEED_M_S[0]) & (speeds <= fastest))
        if reachable.size:
            points.append(candidates[reachable[0]])
        else:
            best = int(np.argmin(speeds))
            points.append(points[-1] + travel[best] * min(1.0, fastest / max(speeds[best], 1e-9)))
    return np.stack(points)


def _tumble(rng: np.random.Generator, times_s: Float64Array) -> Float64Array:
    """[F, 3, 3] turning about a fixed axis, most often the vertical."""
    axis = np.array([0.0, 0.0, 1.0]) if rng.random() < 0.6 else rng.standard_normal(3)
    rate = rng.normal(0, 0.9)
    start = so3_exp(rng.uniform(-np.pi, np.pi) * axis / np.linalg.norm(axis))
    return np.stack([so3_exp(rate * t * axis / np.linalg.norm(axis)) @ start for t in times_s])


def airborne_movers(
    rng: np.random.Generator,
    count: int,
    camera: PinholeCamera,
    poses: Float64Array,
    times_s: Float64Array,
    names: list[str],
) -> tuple[Mover, ...]:
    """``count`` things of 0.2-1.5 m moving at about 0.3-3 m/s, most of the time in view.

    Args:
        poses: [F, 4, 4] T_world_cam at the frames; times_s: [F].
        names: materials to choose from.
    """
    duration = float(times_s[-1] - times_s[0])
    knots = max(2, int(np.ceil(duration / WAYPOINT_S)) + 1)
    key_frames = np.linspace(0, len(times_s) - 1, knots).round()
    step_s = max(duration / (knots - 1), 1e-3)
    parameters = np.linspace(0, knots - 1, len(times_s))
    movers: list[Mover] = []
    while len(movers) < count:
        extent = float(np.exp(rng.uniform(np.log(0.2), np.log(1.5))))
        solids = compound(rng, extent, names)
        for attempt in range(40):
            shrunk = solids if attempt < 20 else compound(rng, 0.2, names)
            path = _catmull_rom(_waypoints(rng, camera, poses, key_frames, step_s, extent * 0.6), parameters)
            mover = Mover(shrunk, path, _tumble(rng, times_s))
            distances = np.linalg.norm(path - poses[:, :3, 3], axis=1)
            if distances.min() > mover.radius_m() + AIR_CLEARANCE_M:
                break
        else:
            mover = _lifted_over(mover, poses)
        movers.append(mover)
    return tuple(movers)


def _lifted_over(mover: Mover, poses: Float64Array) -> Mover:
    """Last resort for a path that cannot avoid the camera: the same motion, lifted above the camera's."""
    lift = np.array(
        [0.0, 0.0, poses[:, 2, 3].max() + mover.radius_m() + AIR_CLEARANCE_M - mover.positions_m[:, 2].min()]
    )
    return Mover(mover.solids, mover.positions_m + lift, mover.rotations)
