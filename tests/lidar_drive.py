"""A KITTI raw drive that goes straight ahead before a wall, scanned by LiDAR: everything in closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from worlds import World, car_world, write_kitti_raw, write_lines

from viflow_anomaly.datasets.kitti_files import read_calibration
from viflow_anomaly.sensor_data import PinholeCamera

EARTH_RADIUS_M = 6_378_137.0
LATITUDE = 49.0
SPEED_M = 0.8  # a frame, to the north
WALL_M, POST_M = 20.0, 8.0
CAMERA = PinholeCamera(fx=120.0, fy=120.0, cx=99.5, cy=29.5, width=200, height=60)


def drive_world(frames: int = 4) -> World:
    world = car_world(frames=frames, width=CAMERA.width, height=CAMERA.height)
    return replace(world, camera=replace(CAMERA, T_cam_imu=world.camera.T_cam_imu))


def write_drive(folder: Path, world: World, scans: dict[int, NDArray[np.float64]]) -> Path:
    """Drives north, the IMU's x ahead; ``scans``: frame -> points [N, 3] in that frame's camera."""
    drive = write_kitti_raw(folder, world)
    for k in range(len(world.images)):
        latitude = LATITUDE + np.degrees(k * SPEED_M / EARTH_RADIUS_M)
        values = np.full(30, 0.0)
        values[:6] = latitude, 8.4, 112.0, 0.0, 0.0, np.pi / 2
        values[13] = 9.81
        write_lines(drive / "oxts" / "data" / f"{k:010d}.txt", [" ".join(map(repr, values.tolist()))])
    for frame, points in scans.items():
        T_velo_cam = np.linalg.inv(mounting(drive, world))
        write_scan(drive, frame, points @ T_velo_cam[:3, :3].T + T_velo_cam[:3, 3])
    return drive


def mounting(drive: Path, world: World) -> NDArray[np.float64]:
    """T_cam_velo."""
    values = read_calibration(drive.parent / "calib_imu_to_velo.txt", {"R": 9, "T": 3})
    T_velo_imu = np.eye(4)
    T_velo_imu[:3, :3], T_velo_imu[:3, 3] = values["R"].reshape(3, 3), values["T"]
    assert world.camera.T_cam_imu is not None
    return np.asarray(world.camera.T_cam_imu @ np.linalg.inv(T_velo_imu))


def write_scan(drive: Path, frame: int, points: NDArray[np.float64]) -> None:
    path = drive / "velodyne_points" / "data" / f"{frame:010d}.bin"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(np.column_stack([points, np.zeros(len(points))]).astype("<f4").tobytes())


def scan_of(depth_m: float, half: tuple[float, float], *, beams: float = 0.007) -> NDArray[np.float64]:
    """Points [N, 3] in camera coordinates of a wall across the view, ``half`` (x/z, y/z) to each side, in rows."""
    x, y = np.meshgrid(np.arange(-half[0], half[0], 0.002), np.arange(-half[1], half[1], beams))
    return np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)]) * depth_m


def wall_and_post() -> NDArray[np.float64]:
    """A wall all over the picture, and a board before it that hides the middle: the scanner sees both."""
    return np.concatenate([scan_of(WALL_M, (0.9, 0.26)), scan_of(POST_M, (0.15, 0.15))])
