"""Synthetic recordings for tests: a textured panorama seen by a camera that turns right, with the IMU that feels it.

One ``World`` is written in any layout that the readers know. By default everything moves 2 px to the left a frame.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.datasets.camera_json import camera_to_mapping
from viflow_anomaly.datasets.recording import FileRecording
from viflow_anomaly.imu_log import ImuLog
from viflow_anomaly.sensor_data import PinholeCamera

REAL_DATA = Path(os.environ.get("VIFLOW_REAL_DATA", Path(__file__).resolve().parents[1] / ".." / "shared" / "data"))

# cam0 of EuRoC MAV, as its sensor.yaml has it.
EUROC = PinholeCamera(
    fx=458.654,
    fy=457.296,
    cx=367.215,
    cy=248.375,
    width=752,
    height=480,
    distortion_model="radtan",
    distortion_coeffs=(-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
)

START_NS = 1_403_715_285_262_142_976
GRAVITY_M_S2 = 9.81

# IMU x right, y front, z top: nothing is left where it was, so that a forgotten rotation shows.
T_CAM_IMU_PERMUTED = np.array([[1.0, 0, 0, 0.1], [0, 0, -1.0, 0.02], [0, 1.0, 0, -0.05], [0, 0, 0, 1.0]])
# KITTI: IMU x front, y left, z top.
T_CAM_IMU_CAR = np.array([[0, -1.0, 0, -0.32], [0, 0, -1.0, 0.72], [1.0, 0, 0, -1.08], [0, 0, 0, 1.0]])


@dataclass(frozen=True, eq=False)
class World:
    """What a recording is made of; images are [H, W] uint8, the IMU is in its own axes."""

    images: list[NDArray[np.uint8]]
    frame_timestamps_ns: NDArray[np.int64]
    imu: ImuLog
    camera: PinholeCamera
    yaw_rate_rad_s: float


def textured_image(width: int, height: int, *, seed: int = 0) -> NDArray[np.uint8]:
    """Smooth noise over the whole gray range, [H, W] uint8."""
    noise = np.random.default_rng(seed).standard_normal((height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5) + 3.0 * cv2.GaussianBlur(noise, (0, 0), 6.0)
    low, high = float(smooth.min()), float(smooth.max())
    return np.round((smooth - low) * (255.0 / (high - low))).astype(np.uint8)


def make_world(
    *,
    frames: int = 6,
    width: int = 96,
    height: int = 64,
    frame_rate_hz: int = 20,
    imu_rate_hz: int = 200,
    shift_px: int = 2,
    square_px: int = 0,
    start_ns: int = START_NS,
    margin_s: float = 0.5,
    T_cam_imu: NDArray[np.float64] = T_CAM_IMU_PERMUTED,
    time_offset_s: float = 0.0,
    seed: int = 0,
) -> World:
    """A turning camera; ``square_px`` > 0 adds a square that moves 3 px to the right a frame by itself."""
    camera = PinholeCamera(
        fx=80.0,
        fy=80.0,
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
        width=width,
        height=height,
        T_cam_imu=T_cam_imu,
        time_offset_s=time_offset_s,
    )
    panorama = textured_image(width + shift_px * frames, height, seed=seed)
    images = [panorama[:, k * shift_px : k * shift_px + width].copy() for k in range(frames)]
    if square_px:
        patch = textured_image(square_px, square_px, seed=seed + 1)
        for k, image in enumerate(images):
            left, top = width // 4 + 3 * k, (height - square_px) // 2
            image[top : top + square_px, left : left + square_px] = patch
    stamps = start_ns + np.arange(frames, dtype=np.int64) * (10**9 // frame_rate_hz)
    yaw_rate = shift_px * frame_rate_hz / camera.fx
    offset_ns = round(time_offset_s * 1e9)
    first, last = int(stamps[0]) - round(margin_s * 1e9), int(stamps[-1]) + round(margin_s * 1e9)
    imu_stamps = np.arange(first + offset_ns, last + offset_ns + 1, 10**9 // imu_rate_hz, dtype=np.int64)
    return World(images, stamps, turning_imu(imu_stamps, yaw_rate, T_cam_imu), camera, yaw_rate)


def turning_imu(stamps: NDArray[np.int64], yaw_rate_rad_s: float, T_cam_imu: NDArray[np.float64]) -> ImuLog:
    """A level camera that turns right about its y (down) axis, in IMU axes, with a little deterministic noise."""
    R_imu_cam = T_cam_imu[:3, :3].T
    rng = np.random.default_rng(7)
    gyro = R_imu_cam @ (0.0, yaw_rate_rad_s, 0.0) + rng.normal(0.0, 1e-3, (stamps.size, 3))
    accel = R_imu_cam @ (0.0, -GRAVITY_M_S2, 0.0) + rng.normal(0.0, 1e-2, (stamps.size, 3))
    return ImuLog(stamps, gyro, accel)


def in_memory(world: World, folder: Path) -> FileRecording:
    """A recording of the world without any table: the images are written, the rest stays in memory."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = tuple(folder / f"{k}.png" for k in range(len(world.images)))
    for path, image in zip(paths, world.images, strict=True):
        write_png(path, image)
    return FileRecording("world", folder, "plain", world.camera, world.imu, world.frame_timestamps_ns, paths)


def write_png(path: Path, image: NDArray[np.generic]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode(".png", image))


def encode(suffix: str, image: NDArray[np.generic]) -> bytes:
    """The bytes of a PNG or JPEG file."""
    done, data = cv2.imencode(suffix, image)
    assert done
    return data.tobytes()


def write_plain(folder: Path, world: World | None = None, *, camera: bool = True, accel: bool = True) -> Path:
    """``frames.csv``, ``imu.csv``, ``camera.json`` and ``images/``."""
    world = world or make_world()
    names = [f"images/{k:04d}.png" for k in range(len(world.images))]
    for name, image in zip(names, world.images, strict=True):
        write_png(folder / name, image)
    rows = [f"{stamp},{name}" for stamp, name in zip(world.frame_timestamps_ns, names, strict=True)]
    write_lines(folder / "frames.csv", ["timestamp_ns,filename", *rows])
    header = "timestamp_ns,gyro_x,gyro_y,gyro_z" + (",accel_x,accel_y,accel_z" if accel else "")
    write_lines(folder / "imu.csv", [header, *imu_rows(world.imu, accel=accel)])
    if camera:
        (folder / "camera.json").write_text(json.dumps(camera_to_mapping(world.camera)))
    return folder


def imu_rows(imu: ImuLog, *, accel: bool = True) -> list[str]:
    values = np.hstack([imu.gyro_rad_s, imu.accel_m_s2]) if accel and imu.accel_m_s2 is not None else imu.gyro_rad_s
    return [
        ",".join([str(stamp), *map(repr, row)]) for stamp, row in zip(imu.timestamps_ns, values.tolist(), strict=True)
    ]


def write_lines(path: Path, lines: Sequence[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_euroc(folder: Path, world: World | None = None, *, cameras: Sequence[str] = ("cam0",)) -> Path:
    """``mav0/`` in ``folder``; the body frame is the IMU's turned by a quarter, as a test of ``T_BS``."""
    world = world or make_world()
    root = folder / "mav0"
    for name in cameras:
        for stamp, image in zip(world.frame_timestamps_ns, world.images, strict=True):
            write_png(root / name / "data" / f"{stamp}.png", image)
        rows = [f"{stamp},{stamp}.png" for stamp in world.frame_timestamps_ns]
        write_lines(root / name / "data.csv", ["#timestamp [ns],filename", *rows])
        T_BS_imu = np.array([[0, -1.0, 0, 0.2], [1.0, 0, 0, 0], [0, 0, 1.0, 0.1], [0, 0, 0, 1.0]])
        write_euroc_sensor(root / name / "sensor.yaml", world.camera, T_BS_imu)
        write_lines(root / "imu0" / "sensor.yaml", ["%YAML:1.0", "sensor_type: imu", *_matrix_yaml(T_BS_imu)])
    header = "#timestamp [ns],w_x [rad s^-1],w_y [rad s^-1],w_z [rad s^-1],a_x [m s^-2],a_y [m s^-2],a_z [m s^-2]"
    write_lines(root / "imu0" / "data.csv", [header, *imu_rows(world.imu)])
    return folder


def write_euroc_sensor(path: Path, camera: PinholeCamera, T_BS_imu: NDArray[np.float64]) -> None:
    names = {"none": "none", "radtan": "radial-tangential", "equidistant": "equidistant"}
    assert camera.T_cam_imu is not None
    lines = [
        "sensor_type: camera",
        *_matrix_yaml(T_BS_imu @ np.linalg.inv(camera.T_cam_imu)),
        "rate_hz: 20",
        f"resolution: [{camera.width}, {camera.height}]",
        "camera_model: pinhole",
        f"intrinsics: [{camera.fx}, {camera.fy}, {camera.cx}, {camera.cy}] #fu, fv, cu, cv",
        f"distortion_model: {names[camera.distortion_model]}",
        f"distortion_coefficients: {list(camera.distortion_coeffs)}",
    ]
    if camera.time_offset_s:
        lines.append(f"timeshift_cam_imu: {camera.time_offset_s!r}")
    write_lines(path, lines)


def _matrix_yaml(matrix: NDArray[np.float64]) -> list[str]:
    return ["T_BS:", "  cols: 4", "  rows: 4", f"  data: {matrix.reshape(-1).tolist()}"]


def car_world(*, frames: int = 6, imu_rate_hz: int = 100, **kwargs: object) -> World:
    """A world at KITTI's 10 Hz with the IMU mounted as KITTI's is."""
    values: dict[str, object] = {"frame_rate_hz": 10, "imu_rate_hz": imu_rate_hz, "T_cam_imu": T_CAM_IMU_CAR}
    return make_world(frames=frames, **(values | kwargs))  # type: ignore[arg-type]


def stamp_text(stamp_ns: int) -> str:
    """KITTI's text of a stamp."""
    seconds, nanoseconds = divmod(int(stamp_ns), 10**9)
    return f"{np.datetime64(seconds, 's')}".replace("T", " ") + f".{nanoseconds:09d}"


def oxts_text(gyro: NDArray[np.float64], accel: NDArray[np.float64], speed: float) -> str:
    values = np.full(30, 0.125)
    values[8], values[11:14], values[17:20] = speed, accel, gyro
    return " ".join(map(repr, values.tolist()))


def write_kitti_raw(folder: Path, world: World | None = None, *, kind: str = "sync", camera: str = "image_02") -> Path:
    """A drive below ``folder/2011_09_26`` with calibration files; returns the drive.

    ``sync``: one OXTS record a frame and no image stamps. ``extract``: the world's IMU and image stamps.
    """
    world = world or car_world()
    drive = folder / "2011_09_26" / f"2011_09_26_drive_0001_{kind}"
    for k, image in enumerate(world.images):
        write_png(drive / camera / "data" / f"{k:010d}.png", image)
    stamps, imu = world.frame_timestamps_ns, world.imu
    rows = np.arange(len(imu))
    if kind == "sync":
        rows = np.array([int(np.argmin(np.abs(imu.timestamps_ns - stamp))) for stamp in stamps])
        write_lines(drive / "oxts" / "timestamps.txt", [stamp_text(stamp) for stamp in stamps])
    else:
        write_lines(drive / camera / "timestamps.txt", [stamp_text(stamp) for stamp in stamps])
        write_lines(drive / "oxts" / "timestamps.txt", [stamp_text(stamp) for stamp in imu.timestamps_ns])
    assert imu.accel_m_s2 is not None
    for k, row in enumerate(rows):
        text = oxts_text(imu.gyro_rad_s[row], imu.accel_m_s2[row], 10.0 + k)
        write_lines(drive / "oxts" / "data" / f"{k:010d}.txt", [text])
    write_kitti_calibration(drive.parent, world.camera)
    return drive


def write_kitti_calibration(folder: Path, camera: PinholeCamera) -> None:
    """The three files; every factor of T_cam_imu is a different rotation or translation."""
    assert camera.T_cam_imu is not None
    K = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    T_velo_imu = _rigid((0.01, -0.02, 0.03), (-0.8, 0.3, -0.8))
    T_rect_cam0 = _rigid((0.02, 0.01, -0.01), (0.0, 0.0, 0.0))
    T_cam_rect = _rigid((0.0, 0.0, 0.0), (0.06, 0.01, 0.003))
    T_cam0_velo = np.linalg.inv(T_cam_rect @ T_rect_cam0) @ camera.T_cam_imu @ np.linalg.inv(T_velo_imu)
    P = np.array(K).reshape(3, 3) @ T_cam_rect[:3]
    lines = [f"S_rect_0{k}: {camera.width} {camera.height}" for k in range(4)]
    lines += [f"P_rect_0{k}: {_text(P)}" for k in range(4)]
    write_lines(folder / "calib_cam_to_cam.txt", ["calib_time: x", f"R_rect_00: {_text(T_rect_cam0[:3, :3])}", *lines])
    for name, matrix in (("velo_to_cam", T_cam0_velo), ("imu_to_velo", T_velo_imu)):
        write_lines(folder / f"calib_{name}.txt", [f"R: {_text(matrix[:3, :3])}", f"T: {_text(matrix[:3, 3])}"])


def _rigid(rotation_vector: Sequence[float], translation: Sequence[float]) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, :3] = cv2.Rodrigues(np.array(rotation_vector, dtype=np.float64))[0]
    matrix[:3, 3] = translation
    return matrix


def _text(values: NDArray[np.float64]) -> str:
    return " ".join(map(repr, np.asarray(values).reshape(-1).tolist()))


def write_kitti_odometry(
    folder: Path, world: World | None = None, *, imu: str = "perframe", times: str = "oxts"
) -> Path:
    """A sequence: ``imu`` is ``perframe`` (10 a frame) or ``plain``; ``times`` is ``oxts`` or ``times``."""
    world = world or car_world(start_ns=0 if times == "times" else START_NS)
    for k, image in enumerate(world.images):
        write_png(folder / "image_0" / f"{k:06d}.png", image)
    stamps = world.frame_timestamps_ns
    if times == "oxts":
        write_lines(folder / "oxts_timestamps.txt", [stamp_text(stamp) for stamp in stamps])
    else:
        write_lines(folder / "times.txt", [f"{stamp / 1e9:.6e}" for stamp in stamps])
    if imu == "perframe":
        between = world.imu.timestamps_ns
        inside = np.flatnonzero((between >= stamps[0]) & (between <= stamps[-1]))
        assert world.imu.accel_m_s2 is not None
        values = np.hstack([world.imu.accel_m_s2[inside], world.imu.gyro_rad_s[inside]])
        rows = [",".join([str(k), *map(repr, row)]) for k, row in enumerate(values.tolist())]
        write_lines(folder / "imu_10perframe.csv", ["sample,ax,ay,az,wx,wy,wz", *rows])
    else:
        write_lines(
            folder / "imu.csv", ["timestamp_ns,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z", *imu_rows(world.imu)]
        )
    camera = world.camera
    P = f"{camera.fx} 0 {camera.cx} 0 0 {camera.fy} {camera.cy} 0 0 0 1 0"
    write_lines(folder / "calib.txt", [f"P{k}: {P}" for k in range(4)])
    return folder


# Every layout, for tests that hold for all of them: name -> writer that returns the folder to open.
WRITERS: dict[str, Callable[[Path], Path]] = {
    "euroc": write_euroc,
    "kitti_raw_sync": write_kitti_raw,
    "kitti_raw_extract": lambda folder: write_kitti_raw(folder, kind="extract"),
    "kitti_odometry_perframe": write_kitti_odometry,
    "kitti_odometry_plain_imu": lambda folder: write_kitti_odometry(folder, imu="plain", times="times"),
    "plain": write_plain,
}


def with_stamps(imu: ImuLog, stamps: Sequence[int]) -> ImuLog:
    """The same samples at other times, in whatever order."""
    return replace(imu, timestamps_ns=np.array(stamps, dtype=np.int64))
