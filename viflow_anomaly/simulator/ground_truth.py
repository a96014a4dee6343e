"""Exact flow of the static world and of the movers, and what each mover shows in a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.geometry import rigid_motion_flow
from viflow_anomaly.sensor_data import Float64Array, PinholeCamera, Uint8Array
from viflow_anomaly.simulator.motion import inverse_rigid
from viflow_anomaly.simulator.scene import Mover

Float32Array = NDArray[np.float32]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class FlowTruth:
    """Flow from one frame to the next: [H, W, 2] px and validity [H, W], for the static world and for everything."""

    static_flow: Float32Array
    static_valid: BoolArray
    flow: Float32Array
    valid: BoolArray


@dataclass(frozen=True)
class VisibleObject:
    """One mover in one frame; the box is inclusive; the flow is the median |flow - static flow| over its pixels."""

    instance_id: int
    area_px: int
    u_min: int
    v_min: int
    u_max: int
    v_max: int
    independent_flow_px: float


def _pose(mover: Mover, frame: int) -> Float64Array:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = mover.rotations[frame], mover.positions_m[frame]
    return pose


def _cropped(camera: PinholeCamera, top: int, left: int, height: int, width: int) -> PinholeCamera:
    return PinholeCamera(
        fx=camera.fx, fy=camera.fy, cx=camera.cx - left, cy=camera.cy - top, width=width, height=height
    )


def flow_truth(
    camera: PinholeCamera,
    depth_m: Float32Array,
    instances: Uint8Array,
    movers: tuple[Mover, ...],
    frame: int,
    T_world_source: Float64Array,
    T_world_target: Float64Array,
) -> FlowTruth:
    """Flow from ``frame`` to the next one.

    Args:
        depth_m: [H, W] (inf: sky); instances: [H, W], 0 static, k the k-th of ``movers``.
        T_world_source, T_world_target: [4, 4] camera poses of the two frames.
    """
    T_target_world = inverse_rigid(T_world_target)
    static_flow, static_valid = rigid_motion_flow(camera, depth_m, T_target_world @ T_world_source)
    flow, valid = static_flow.copy(), static_valid.copy()
    for number, mover in enumerate(movers, start=1):
        rows, columns = np.nonzero(instances == number)
        if not rows.size:
            continue
        top, bottom, left, right = rows.min(), rows.max() + 1, columns.min(), columns.max() + 1
        part = (slice(top, bottom), slice(left, right))
        carried = _pose(mover, frame + 1) @ inverse_rigid(_pose(mover, frame))
        part_camera = _cropped(camera, int(top), int(left), int(bottom - top), int(right - left))
        part_flow, part_valid = rigid_motion_flow(part_camera, depth_m[part], T_target_world @ carried @ T_world_source)
        mask = instances[part] == number
        flow[part][mask] = part_flow[mask]
        valid[part][mask] = part_valid[mask]
    return FlowTruth(static_flow, static_valid, flow, valid)


def visible_objects(instances: Uint8Array, truth: FlowTruth, count: int) -> list[VisibleObject]:
    """The movers that show at least one pixel, in order of their number."""
    found = []
    difference = np.linalg.norm(truth.flow - truth.static_flow, axis=-1)
    for number in range(1, count + 1):
        mask = instances == number
        rows, columns = np.nonzero(mask)
        if rows.size:
            found.append(
                VisibleObject(
                    instance_id=number,
                    area_px=int(rows.size),
                    u_min=int(columns.min()),
                    v_min=int(rows.min()),
                    u_max=int(columns.max()),
                    v_max=int(rows.max()),
                    independent_flow_px=float(np.median(difference[mask])),
                )
            )
    return found
