"""Small trees in the exact layout of KITTI's benchmarks and of the raw drives behind them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from worlds import START_NS, car_world, oxts_text, stamp_text, textured_image, turning_imu, write_lines, write_png

from viflow_anomaly.datasets.ground_truth_png import write_flow_png

DRIVE = "2011_09_30_drive_0016"
FRAME_NS = 103_500_000
IMU_NS = 10_000_000
LEAD_FRAMES = 3
"""``_extract`` drives begin some frames before ``_sync``."""


def frame_stamps(count: int) -> NDArray[np.int64]:
    """KITTI's camera turns at 9.66 Hz, not quite 10."""
    return START_NS + np.arange(count, dtype=np.int64) * FRAME_NS


def imu_stamps(frames: int) -> NDArray[np.int64]:
    """From 0.5 s before the first frame of ``_sync`` to 0.5 s after the last, 3 ms off the frames."""
    first, last = frame_stamps(frames)[[0, -1]]
    return np.arange(first - 497_000_000, last + 500_000_000, IMU_NS, dtype=np.int64)


def write_raw_drive(
    raw_data: Path,
    name: str = DRIVE,
    *,
    frames: int = 9,
    stamps: NDArray[np.int64] | None = None,
    image_stamps: bool = True,
) -> Path:
    """``_sync`` with stamps only and ``_extract`` with OXTS; in record k the speed is k / 10. Returns the day's folder.

    Args:
        stamps: of the IMU, in the order of its records; None: ``imu_stamps``.
        image_stamps: False: ``_sync`` has only the stamps of its OXTS.
    """
    day = raw_data / name[:10]
    sync, extract = day / f"{name}_sync", day / f"{name}_extract"
    lines = [stamp_text(stamp) for stamp in frame_stamps(frames)]
    for camera in ("image_00", "image_02") if image_stamps else ():
        write_lines(sync / camera / "timestamps.txt", lines)
    write_lines(sync / "oxts" / "timestamps.txt", lines)
    earlier = [stamp_text(START_NS - k * FRAME_NS) for k in range(LEAD_FRAMES, 0, -1)]
    write_lines(extract / "image_00" / "timestamps.txt", [*earlier, *lines])
    times = imu_stamps(frames) if stamps is None else stamps
    imu = turning_imu(times, 0.1, np.array([[0, -1.0, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]))
    assert imu.accel_m_s2 is not None
    for k in range(times.size):
        text = oxts_text(imu.gyro_rad_s[k], imu.accel_m_s2[k], k / 10)
        write_lines(extract / "oxts" / "data" / f"{k:010d}.txt", [text])
    write_lines(extract / "oxts" / "timestamps.txt", [stamp_text(stamp) for stamp in times])
    write_lines(day / "calib_imu_to_velo.txt", ["R: 1 0 0 0 1 0 0 0 1", "T: 1 2 3"])
    write_lines(day / "calib_velo_to_cam.txt", ["R: 0 -1 0 0 0 -1 1 0 0", "T: 0.1 0.2 0.3"])
    return day


def write_odometry(dataset: Path, sequence: str = "04", *, first: int = 2, count: int = 6) -> Path:
    """``sequences/04`` as published: images, times.txt, calib.txt; its frames are ``first`` onwards of the drive."""
    folder = dataset / "sequences" / sequence
    for k, image in enumerate(car_world(frames=count).images):
        write_png(folder / "image_0" / f"{k:06d}.png", image)
    times = (frame_stamps(first + count)[first:] - frame_stamps(first + 1)[first]) / 1e9
    write_lines(folder / "times.txt", [f"{time:.6e}" for time in times])
    P = "80 0 47.5 {} 0 80 31.5 0 0 0 1 0"
    lines = [f"P{k}: {P.format(x)}" for k, x in enumerate((0, -40, 5, -37))]
    write_lines(folder / "calib.txt", [*lines, "Tr: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3"])
    return folder


def write_sceneflow(root: Path, mapping: list[str], *, moved_px: tuple[float, float] = (2.5, -1.0)) -> Path:
    """``training/`` for as many images as the mapping has lines, and the devkit's mapping."""
    training = root / "training"
    mask = np.zeros((64, 96), np.uint8)
    mask[10:20, 10:30] = 1
    for k in range(len(mapping)):
        for name in ("10", "11"):
            image = textured_image(96, 64, seed=10 * k + int(name))
            write_png(training / "image_2" / f"{k:06d}_{name}.png", cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
        flow = np.broadcast_to(np.array(moved_px, np.float32) + k, (64, 96, 2))
        for kind, valid in (("occ", mask == 0), ("noc", np.zeros_like(mask, dtype=bool))):
            (training / f"flow_{kind}").mkdir(parents=True, exist_ok=True)
            write_flow_png(training / f"flow_{kind}" / f"{k:06d}_10.png", flow, valid)
        write_png(training / "obj_map" / f"{k:06d}_10.png", mask)
        lines = [
            "S_rect_02: 96 64",
            "R_rect_00: 1 0 0 0 1 0 0 0 1",
            f"P_rect_02: {80 + k} 0 47.5 8 0 80 31.5 0 0 0 1 0",
        ]
        write_lines(training / "calib_cam_to_cam" / f"{k:06d}.txt", lines)
    write_lines(root / "devkit" / "mapping" / "train_mapping.txt", mapping)
    return root
