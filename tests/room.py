"""A box room with a pillar: sampled as a point cloud, and in closed form along every ray."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from worlds import make_world, write_euroc, write_lines

from viflow_anomaly.datasets.euroc import read_camera_on_body
from viflow_anomaly.geometry import pixel_grid, so3_exp, unproject_pixels
from viflow_anomaly.ground_truth.frame_poses import quaternion_of
from viflow_anomaly.sensor_data import PinholeCamera

Float64Array = NDArray[np.float64]

ROOM = ((-4.0, -4.5, 0.0), (4.0, 4.5, 3.5))
PILLAR = ((-0.2, 0.6, 0.0), (0.25, 1.0, 2.2))


def sample_box(box: tuple[tuple[float, ...], ...], per_m2: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Random points on the six faces, ``per_m2`` on a square metre."""
    low, high = np.array(box)
    size = high - low
    faces = []
    for axis in range(3):
        for side in (low, high):
            area = np.prod(np.delete(size, axis))
            points = low + rng.random((round(area * per_m2), 3)) * size
            points[:, axis] = side[axis]
            faces.append(points)
    return np.concatenate(faces).astype(np.float32)


def sample_room(per_m2: float, *, noise_m: float = 0.0, seed: int = 0) -> NDArray[np.float32]:
    """The room's and the pillar's faces, [N, 3]."""
    rng = np.random.default_rng(seed)
    points = np.concatenate([sample_box(ROOM, per_m2, rng), sample_box(PILLAR, per_m2, rng)])
    return (points + noise_m * rng.standard_normal(points.shape)).astype(np.float32)


def camera_pose(
    position: tuple[float, float, float], yaw: float, pitch: float = 0.0, roll: float = 0.0
) -> Float64Array:
    """T_world_cam of a camera that looks along +y at yaw 0, z of the world up."""
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    pose = np.eye(4)
    pose[:3, :3] = so3_exp(np.array([0, 0, yaw])) @ level @ so3_exp(np.array([pitch, 0, 0]))
    pose[:3, :3] = pose[:3, :3] @ so3_exp(np.array([0, 0, roll]))
    pose[:3, 3] = position
    return pose


def room_depth(camera: PinholeCamera, T_world_cam: Float64Array) -> Float64Array:
    """Depth [H, W] along the optical axis, exact: slabs method from inside the room and from outside the pillar."""
    rays_xy = unproject_pixels(camera, pixel_grid(camera.height, camera.width))
    directions = np.concatenate([rays_xy, np.ones((*rays_xy.shape[:2], 1))], axis=-1) @ T_world_cam[:3, :3].T
    origin = T_world_cam[:3, 3]
    with np.errstate(divide="ignore"):
        to_room = (np.array(ROOM)[:, None, None] - origin) / directions
        to_pillar = (np.array(PILLAR)[:, None, None] - origin) / directions
    room = to_room.max(axis=0).min(axis=-1)
    enter, leave = to_pillar.min(axis=0).max(axis=-1), to_pillar.max(axis=0).min(axis=-1)
    return np.asarray(np.where((enter < leave) & (enter > 0), np.minimum(room, enter), room))


def write_ply(path: Path, points: NDArray[np.float32], *, order: str = "binary_little_endian") -> None:
    """As EuRoC's: x y z intensity and a colour."""
    path.parent.mkdir(parents=True, exist_ok=True)
    properties = [("float", axis) for axis in "xyz"] + [("float", "intensity")]
    properties += [("uchar", name) for name in ("red", "green", "blue")]
    header = ["ply", f"format {order} 1.0", "comment a room", f"element vertex {len(points)}"]
    header += [f"property {kind} {name}" for kind, name in properties] + ["end_header", ""]
    byte_order = ">" if order == "binary_big_endian" else "<"
    rows = np.zeros(
        len(points), [(name, byte_order + ("f4" if kind == "float" else "u1")) for kind, name in properties]
    )
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    rows["red"] = 200
    data = rows.tobytes()
    if order == "ascii":
        data = "".join(" ".join(map(str, row)) + "\n" for row in rows.tolist()).encode()
    path.write_bytes("\n".join(header).encode() + data)


def room_flow(
    camera: PinholeCamera, T_world_source: Float64Array, T_world_target: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Where the room's points go, in closed form and without the library's flow: flow [H, W, 2] px, depth [H, W] m that
    they have in the target."""
    pixels = pixel_grid(camera.height, camera.width).astype(np.float64)
    rays = np.concatenate([unproject_pixels(camera, pixels), np.ones((*pixels.shape[:2], 1))], axis=-1)
    points = rays * room_depth(camera, T_world_source)[..., None]
    world = points @ T_world_source[:3, :3].T + T_world_source[:3, 3]
    there = (world - T_world_target[:3, 3]) @ T_world_target[:3, :3]
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    zero = np.zeros(3)
    there = np.where(there[..., 2:] > 0.01, there, (0.0, 0.0, 1.0))
    found, _ = cv2.projectPoints(there.reshape(-1, 3), zero, zero, K, np.array(camera.distortion_coeffs))
    return found.reshape(pixels.shape) - pixels, there[..., 2]


def write_room_recording(
    folder: Path, camera: PinholeCamera, poses: list[Float64Array], points: NDArray[np.float32]
) -> Path:
    """A recording in EuRoC layout with the cloud and a state at every frame; the pictures show nothing of the room."""
    world = make_world(frames=len(poses), width=camera.width, height=camera.height)
    write_euroc(folder, replace(world, camera=replace(camera, T_cam_imu=world.camera.T_cam_imu)))
    write_states(folder / "mav0", poses, world.frame_timestamps_ns.tolist())
    write_ply(folder / "mav0" / "pointcloud0" / "data.ply", points)
    return folder


def write_states(mav0: Path, poses: list[Float64Array], stamps: list[int]) -> None:
    """``state_groundtruth_estimate0/data.csv`` of camera poses."""
    mounting = read_camera_on_body(mav0 / "cam0" / "sensor.yaml")
    assert mounting is not None
    lines = ["#timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z"]
    for stamp, T_world_cam in zip(stamps, poses, strict=True):
        body = T_world_cam @ np.linalg.inv(mounting.T_body_cam)
        numbers = [*body[:3, 3], *quaternion_of(body[:3, :3])]
        lines.append(",".join([str(stamp), *(repr(float(number)) for number in numbers)]))
    write_lines(mav0 / "state_groundtruth_estimate0" / "data.csv", lines)
