"""A made-up pair of any size, so that a measurement needs no files: a camera that turns in front of a texture, and
patches that move by themselves. It is for clocks, not for judging quality.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.config import ImageLimits
from viflow_anomaly.datasets.recording import FileRecording, Recording
from viflow_anomaly.imu_log import ImuLog
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples, PinholeCamera, Uint8Array

FRAME_INTERVAL_NS = 50_000_000
IMU_INTERVAL_NS = 5_000_000
MARGIN_NS = 250_000_000
FIRST_NS = 1_500_000_000_000_000_000
GRAVITY_M_S2 = 9.81
YAW_RATE_RAD_S = 0.2
OWN_SPEED_PX = 0.02
"""Of a patch between two frames, as a share of the image's diagonal."""


def make_pair(width: int, height: int, *, patches: int = 3, seed: int = 0) -> FramePair:
    """Two frames of a camera that turns to the right, and ``patches`` squares that move down beside that."""
    camera = make_camera(width, height)
    images = make_images(2, camera, patches=patches, seed=seed)
    source, target = (Frame(FIRST_NS + k * FRAME_INTERVAL_NS, image) for k, image in enumerate(images))
    log = _make_imu(2)
    imu = ImuSamples(log.timestamps_ns, log.gyro_rad_s, log.accel_m_s2)
    return FramePair(source=source, target=target, imu=imu, camera=camera)


def make_camera(width: int, height: int) -> PinholeCamera:
    """About 60 degrees wide; the IMU's axes are the camera's."""
    focal_px = 0.85 * width
    return PinholeCamera(
        fx=focal_px,
        fy=focal_px,
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
        width=width,
        height=height,
        T_cam_imu=np.eye(4),
    )


def make_images(frames: int, camera: PinholeCamera, *, patches: int, seed: int) -> list[Uint8Array]:
    """[H, W] uint8 each: the texture as the turn shifts it (its middle: a distant world), with the patches on it."""
    width, height = camera.width, camera.height
    rng = np.random.default_rng(seed)
    shift_px = camera.fx * YAW_RATE_RAD_S * FRAME_INTERVAL_NS * 1e-9
    margin = int(np.ceil(shift_px * frames)) + 2
    panorama = _texture(width + margin, height, rng)
    side = max(8, round(0.12 * min(width, height)))
    cover = _texture(side, side, rng)
    columns = np.ceil(np.sqrt(patches * width / height)) if patches else 0
    fall_px = OWN_SPEED_PX * np.hypot(width, height)
    images = []
    for k in range(frames):
        offset = np.array([[1, 0, -k * shift_px], [0, 1, 0]])
        image = np.asarray(cv2.warpAffine(panorama, offset, (width, height), flags=cv2.INTER_LINEAR), dtype=np.uint8)
        for patch in range(patches):
            column, row = patch % columns, patch // columns
            left = round((column + 0.5) * width / columns - side / 2 - k * shift_px)
            top = round((row + 0.5) * height / np.ceil(patches / columns) - side / 2 + k * fall_px)
            top, left = max(0, top), max(0, left)
            seen = image[top : top + side, left : left + side]
            seen[...] = cover[: seen.shape[0], : seen.shape[1]]
        images.append(image)
    return images


def _texture(width: int, height: int, rng: np.random.Generator) -> Uint8Array:
    """Noise at several scales over most of the gray range."""
    image = np.zeros((height, width), np.float32)
    for sigma_px, weight in ((1.2, 1.0), (5.0, 4.0), (20.0, 14.0)):
        noise = rng.standard_normal((height, width)).astype(np.float32)
        image += weight * np.asarray(cv2.GaussianBlur(noise, (0, 0), sigma_px), dtype=np.float32)
    image -= image.mean()
    return np.asarray(np.clip(128 + 45 / max(float(image.std()), 1e-6) * image, 0, 255), dtype=np.uint8)


def _make_imu(frames: int) -> ImuLog:
    """A level camera that turns to the right, with the noise of a small IMU."""
    last_ns = FIRST_NS + (frames - 1) * FRAME_INTERVAL_NS
    stamps = np.arange(FIRST_NS - MARGIN_NS, last_ns + MARGIN_NS + 1, IMU_INTERVAL_NS, dtype=np.int64)
    rng = np.random.default_rng(1)
    gyro = np.array([0.0, YAW_RATE_RAD_S, 0.0]) + rng.normal(0, 1e-3, (stamps.size, 3))
    accel = np.array([0.0, -GRAVITY_M_S2, 0.0]) + rng.normal(0, 2e-2, (stamps.size, 3))
    return ImuLog(stamps, gyro, accel)


def make_recording(folder: Path, frames: int, width: int, height: int, *, distinct: int = 12) -> FileRecording:
    """``frames`` frames of the scene; only ``distinct`` images are written, the camera turns back and forth over them.

    The gyro says so, but for the turning points themselves.
    """
    camera = make_camera(width, height)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for k, image in enumerate(make_images(min(distinct, frames), camera, patches=3, seed=0)):
        paths.append(folder / f"{k:04d}.png")
        cv2.imwrite(str(paths[-1]), image)
    period = max(1, 2 * (len(paths) - 1))
    place = np.arange(frames) % period
    shown = np.minimum(place, period - place)
    stamps = FIRST_NS + np.arange(frames, dtype=np.int64) * FRAME_INTERVAL_NS
    imu = _make_imu(frames)
    since = np.clip((imu.timestamps_ns - FIRST_NS) // FRAME_INTERVAL_NS, 0, None) % period
    gyro = np.where((since >= period / 2)[:, None], -imu.gyro_rad_s, imu.gyro_rad_s)
    imu = replace(imu, gyro_rad_s=gyro)
    return FileRecording(
        "made", folder, "plain", camera, imu, stamps, tuple(paths[k] for k in shown.tolist()), limits=ImageLimits()
    )


def repeated(recording: Recording, frames: int) -> FileRecording:
    """A recording played again and again until it has ``frames`` frames; its last frame is followed by its first."""
    stamps = recording.frame_timestamps_ns
    span_ns = int(stamps[-1] - stamps[0] + np.median(np.diff(stamps)))
    rounds = -(-frames // len(recording))
    log = recording.imu
    offset_ns = 0 if recording.camera is None else round(recording.camera.time_offset_s * 1e9)
    start_ns = int(stamps[0]) + offset_ns
    once = (log.timestamps_ns >= start_ns) & (log.timestamps_ns < start_ns + span_ns)
    before, after = log.timestamps_ns < start_ns, log.timestamps_ns >= start_ns + span_ns

    def again(column: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([column[before], *[column[once]] * rounds, column[after]])

    ticks = [log.timestamps_ns[once] + k * span_ns for k in range(rounds)]
    tail = log.timestamps_ns[after] + (rounds - 1) * span_ns
    imu = ImuLog(
        np.concatenate([log.timestamps_ns[before], *ticks, tail]),
        again(log.gyro_rad_s),
        None if log.accel_m_s2 is None else again(log.accel_m_s2),
    )
    shown = np.arange(frames) % len(recording)
    return FileRecording(
        recording.name,
        recording.root,
        recording.format,
        recording.camera,
        imu,
        np.concatenate([stamps + k * span_ns for k in range(rounds)])[:frames],
        tuple(recording.frame_path(k) for k in shown.tolist()),
        limits=ImageLimits(),
    )
