"""Things that move on their own: tumbling objects in a drone's view; cars, cyclists and walkers on a road."""

from __future__ import annotations

import numpy as np

from viflow_anomaly.geometry import so3_exp
from viflow_anomaly.sensor_data import Float64Array, PinholeCamera
from viflow_anomaly.simulator.road import Road
from viflow_anomaly.simulator.scene import Mover, Solid
from viflow_anomaly.simulator.shapes import car, compound, cyclist, pedestrian, turned

WAYPOINT_S = 1.5
SPEED_M_S = (0.3, 3.0)
DISTANCES_M = (1.2, 8.0)
AIR_CLEARANCE_M = 0.6
ROAD_CLEARANCE_M = 4.5


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
            mover = _parked_ahead(mover, poses)
        movers.append(mover)
    return tuple(movers)


def _parked_ahead(mover: Mover, poses: Float64Array) -> Mover:
    """Last resort for a path that cannot avoid the camera: the same motion, lifted above the camera's."""
    lift = np.array(
        [0.0, 0.0, poses[:, 2, 3].max() + mover.radius_m() + AIR_CLEARANCE_M - mover.positions_m[:, 2].min()]
    )
    return Mover(mover.solids, mover.positions_m + lift, mover.rotations)


def _along(
    road: Road, s: Float64Array, lateral: Float64Array | float, backwards: bool
) -> tuple[Float64Array, Float64Array]:
    """Positions [F, 3] and rotations [F, 3, 3] of something that follows the road."""
    headings = road.heading(s) + (np.pi if backwards else 0.0)
    place = road.position(s, lateral)
    return np.column_stack([place, np.full(len(s), 0.02)]), np.stack([turned(float(h)) for h in headings])


def _road_user(
    rng: np.random.Generator,
    road: Road,
    arc_m: Float64Array,
    times_s: Float64Array,
    left_lane_m: float,
    edge_m: float,
    names: list[str],
) -> Mover:
    speed = float(np.ptp(arc_m) / max(np.ptp(times_s), 1e-6))
    meeting = rng.uniform(0.1, 0.95) * times_s[-1]  # when it is right before us
    arc_then = float(np.interp(meeting, times_s, arc_m))
    kind = rng.choice(5, p=(0.3, 0.3, 0.12, 0.16, 0.12))
    if kind == 0:  # ahead in our lane
        gap, relative = rng.uniform(8.0, 30.0), rng.normal(0, 1.5)
        s = arc_m + gap + relative * (times_s - times_s.mean())
        return Mover(car(rng, names), *_along(road, s, rng.normal(0, 0.2), False))
    if kind == 1:  # oncoming
        s = arc_then + rng.uniform(2.0, 40.0) - rng.uniform(0.5, 1.2) * max(speed, 4.0) * (times_s - meeting)
        return Mover(car(rng, names), *_along(road, s, left_lane_m + rng.normal(0, 0.2), True))
    if kind == 2:  # crossing ahead
        s_cross = arc_then + rng.uniform(14.0, 35.0)
        pace = rng.uniform(3.0, 9.0) * rng.choice((-1, 1))
        lateral = pace * (times_s - meeting) + rng.uniform(-5, 5)
        place, rotations = _along(road, np.full(len(times_s), s_cross), lateral, False)
        return Mover(car(rng, names), place, rotations @ turned(np.sign(pace) * np.pi / 2))
    walker = rng.random() < 0.6
    thing: tuple[Solid, ...] = pedestrian(rng, names) if walker else cyclist(rng, names)
    pace = rng.uniform(0.7, 2.2) if walker else rng.uniform(2.5, 6.0)
    if kind == 3:  # along the kerb
        side = rng.choice((-1, 1))
        s = arc_then + rng.uniform(6.0, 22.0) + side * -pace * (times_s - meeting)
        lateral_m = -edge_m - rng.uniform(0, 1.2) if side < 0 else 2 * left_lane_m - rng.uniform(-0.5, 0.8)
        return Mover(thing, *_along(road, s, lateral_m, bool(side > 0)))
    pace *= rng.choice((-1, 1))
    s_cross = arc_then + rng.uniform(9.0, 25.0)
    place, rotations = _along(
        road, np.full(len(times_s), s_cross), pace * (times_s - meeting) + rng.uniform(-3, 4), False
    )
    return Mover(thing, place, rotations @ turned(np.sign(pace) * np.pi / 2))


def road_movers(
    rng: np.random.Generator,
    count: int,
    road: Road,
    camera_path_m: Float64Array,
    arc_m: Float64Array,
    times_s: Float64Array,
    lanes_m: tuple[float, float],
    names: list[str],
) -> tuple[Mover, ...]:
    """``count`` road users that never come within 2.5 m of the camera.

    Args:
        camera_path_m: [F, 3]; arc_m: [F] where the camera is along the road; times_s: [F], first 0.
        lanes_m: middle of the oncoming lane to the left, edge of the road to the right (both positive).
    """
    movers: list[Mover] = []
    while len(movers) < count:
        for _ in range(40):
            mover = _road_user(rng, road, arc_m, times_s, *lanes_m, names)
            clear = all(
                float(np.linalg.norm((mover.positions_m - camera_path_m)[:, :2], axis=1).min()) > 2.5
                and _separate(mover, other)
                for other in (*movers, mover)
            )
            if clear and _keeps_ahead(mover, camera_path_m):
                break
        else:
            return tuple(movers)
        movers.append(mover)
    return tuple(movers)


def _keeps_ahead(mover: Mover, camera_path_m: Float64Array) -> bool:
    """Its solids, as boxes, stay clear of the camera by more than a bumper's length."""
    for frame in range(0, len(camera_path_m)):
        local = mover.rotations[frame].T @ (camera_path_m[frame] - mover.positions_m[frame])
        if any(solid.clearance_m(local[None]) < 1.5 for solid in mover.solids):
            return False
    return True


def _separate(mover: Mover, other: Mover) -> bool:
    if mover is other:
        return True
    gaps = np.linalg.norm((mover.positions_m - other.positions_m)[:, :2], axis=1)
    return bool(gaps.min() > 2.0)
