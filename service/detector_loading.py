"""From settings to a detector, and what makes its first pair as fast as any later one."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from importlib import import_module
from typing import Final

import numpy as np

from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.pair_detector import PairDetector
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples, PinholeCamera
from viflow_anomaly_service.settings import ServiceSettings, WarmUpCamera

logger = logging.getLogger(__name__)

DetectorLoader = Callable[[ServiceSettings], PairDetector]

IMU_STEP_NS: Final = 5_000_000
INTERVAL_NS: Final = 50_000_000
PRELOADED: Final = ("cv2", "skimage.measure", "viflow_anomaly.configured_detector")
"""What a detection imports and what starts no thread."""


def load_bundled_or_configured(settings: ServiceSettings) -> PairDetector:
    """The detector that the settings name; sets how many threads the network and OpenCV use in this process.

    Raises:
        CheckpointError: the checkpoint cannot be used.
        ConfigError: the calibration cannot be read, or was made with something else.
    """
    from viflow_anomaly.configured_detector import load_configured  # noqa: PLC0415 - heavy

    return load_configured(settings)


def preload() -> None:
    """Import what ``load_bundled_or_configured`` will need, so that processes made by a fork share its memory."""
    for name in PRELOADED:
        import_module(name)


def warm_up(detector: PairDetector, camera: WarmUpCamera) -> None:
    """Judge one made-up pair: networks are compiled for a size when they first meet it, and modules are imported.

    A model that does not take such a pair (one with a motor input) stays cold; that is no fault.
    """
    started = time.perf_counter()
    try:
        detector.detect(example_pair(camera))
    except InvalidInputError as err:
        logger.warning("not_warmed_up", extra={"camera": str(camera), "reason": err.message})
        return
    spent_ms = round((time.perf_counter() - started) * 1e3, 1)
    logger.info("warmed_up", extra={"camera": str(camera), "duration_ms": spent_ms})


def example_pair(camera: WarmUpCamera) -> FramePair:
    """Texture that moves by a pixel, and an IMU at rest."""
    width, height = camera.width, camera.height
    coarse = np.random.default_rng(0).integers(60, 196, (height // 8 + 2, width // 8 + 2), dtype=np.uint8)
    texture = np.kron(coarse, np.ones((8, 8), dtype=np.uint8))
    images = (np.ascontiguousarray(texture[:height, shift : width + shift]) for shift in (0, 1))
    source, target = (Frame(number * INTERVAL_NS, image) for number, image in enumerate(images, start=20))
    stamps = np.arange(0, 40 * INTERVAL_NS, IMU_STEP_NS, dtype=np.int64)
    at_rest = np.tile((0.0, 0.0, 9.81), (len(stamps), 1))
    imu = ImuSamples(timestamps_ns=stamps, gyro_rad_s=np.zeros((len(stamps), 3)), accel_m_s2=at_rest)
    seen_by = None
    if (focal_px := camera.focal_px) is not None:
        cx, cy = (width - 1) / 2, (height - 1) / 2
        seen_by = PinholeCamera(fx=focal_px, fy=focal_px, cx=cx, cy=cy, width=width, height=height)
    return FramePair(source=source, target=target, imu=imu, camera=seen_by)
